"""The level of a unit, over which its line is watched."""

import numpy as np

from driftlab.family.basis import STEP
from driftlab.family.mixed_model import fit_family
from driftlab.family.unit_information import UnitInformation
from driftlab.production.family import _levels
from driftlab.soak.blocks import SoakRows


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
