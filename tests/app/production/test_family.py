"""The level of a unit, over which its line is watched; and units in doubt, which are no part of their family."""

from pathlib import Path

import family as example
import numpy as np
import other_families as made

from driftlab.config import load_config
from driftlab.family.basis import STEP
from driftlab.family.mixed_model import fit_family
from driftlab.family.partitions import in_partitions
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_records import UnitRecords
from driftlab.production.family import _levels, analyse
from driftlab.production.units_pass import FleetStatus
from driftlab.soak.blocks import SoakRows

CONFIG = load_config(Path(example.__file__).parent / "family.yaml")
SIZE = 1e-4


def test_the_level_of_a_unit_is_the_mean_of_its_bias_over_the_range():
    rng, T = np.random.default_rng(3), np.linspace(0.0, 40.0, 161)
    t, levels, units = np.arange(161) * 10.0, [], []
    for k in range(12):
        level, slope = rng.normal(size=2) * [50.0, 2.0] + [0.0, 1.0]
        bias = level + slope * (T - 20.0)  # whose mean over 0 to 40 degC is the level
        rows = SoakRows(t, T, (bias + 0.1 * rng.normal(size=161))[:, None], np.full(161, 10.0), {})
        levels.append(level)
        units.append((UnitInformation.of(f"{k}", ("x",), [rows], np.array([0.3]), np.array([1e-3]), STEP), "L0"))
    found = _levels(fit_family(units), units)
    assert np.all(np.abs(found[:, 0] - levels) < 0.5)


def test_a_unit_in_doubt_is_judged_by_a_family_that_does_not_know_it():
    units, records = made.deal("polynomial", 21, 24, size=SIZE), UnitRecords()
    for unit in units:
        of_unit = unit.record(24, ("x",)).model_copy(update={"channel": "gyro", "bias_unit": "rad/s"})
        records[unit.name] = of_unit.model_copy(update={"doubts": ["x copies y"] if unit is units[-1] else []})
    pairs = [(unit.soaked(24, ("x",)), unit.lot) for unit in units[:-1]]
    own = units[-1].soaked(24, ("x",)).recordings
    rows = [SoakRows(part.t, part.T, 1e-3 * part.bias, part.span) for part in own]
    small = UnitInformation.of(units[-1].name, ("x",), rows, 1e-3 * units[-1].noise, 1e-3 * units[-1].walk, 2.5)
    status = FleetStatus(records.of([unit.name for unit in units]))
    assert (len(status.done), status.doubted.units) == (21, [units[-1].name])
    doubted = in_partitions([(small, units[-1].lot)])
    told = analyse(in_partitions(pairs), doubted, status, CONFIG, None, lambda stage: None)
    alone = fit_family(pairs, channel="gyro", bias_unit="rad/s")
    assert told.family is not None
    assert told.family.units == 20
    assert np.array_equal(told.family.mu, alone.mu)
    assert np.array_equal(told.family.Sigma, alone.Sigma)
    assert units[-1].name not in told.line.units
    first, *others = told.reasons[units[-1].name]
    assert first == "in doubt: x copies y"
    assert any("times what is usual: scale" in text for text in others)
    assert any(text.startswith("1 unit in doubt: not in the family") for text in told.lines)
    few = analyse(in_partitions(pairs[:1]), doubted, status, CONFIG, None, lambda stage: None)
    assert few.family is None
    assert few.reasons == {units[-1].name: ["in doubt: x copies y"]}
