"""The loop, end to end, on units whose undeclared effects are made by code that shares nothing with the plugins."""

import shutil

import h5py
import numpy as np
import pytest
from closed_loops import AUXILIARY, TOLD, assert_same_coast, kinds, left_out, loop
from doses import draws
from threadpoolctl import threadpool_limits
from units_with_effects import CONFIG, make_unit

from driftlab.commands.explain import explain
from driftlab.config import load_config
from driftlab.identification.config_edit import with_map
from driftlab.identification.records import gather
from driftlab.identification.search import search
from driftlab.maps.fit import fit_map
from fusion_core.faults import Faults


@pytest.mark.parametrize(
    "effects",
    [("periodic", "turn_on"), ("thermal_lag", "drift", "channel")],
    ids="+".join,
)
def test_what_is_missing_is_named_and_the_error_falls(tmp_path, effects):
    """The error after is at most 1.15 times that of a model told the truth, on a recording that was not fitted."""
    closed, error = loop(tmp_path, 7, effects)
    assert kinds(closed) == sorted(effects)
    assert closed.verdict.word == "explained"
    assert np.all(error["after"] < 1.15 * TOLD)
    assert np.linalg.norm(error["after"]) < 0.5 * np.linalg.norm(error["before"])


def test_a_second_thermometer_is_a_gradient(tmp_path):
    closed, error = loop(tmp_path, 7, ("gradient",), (*AUXILIARY, "temperature_case"))
    assert kinds(closed) == ["thermal_gradient"]
    assert np.all(error["after"] < 1.15 * TOLD)


def test_a_square_is_a_channel_with_itself(tmp_path):
    closed, error = loop(tmp_path, 7, ("square",))
    assert [(e["kind"], e["channel"]) for e in closed.content["effects"]] == [("interaction", "flow*flow")]
    assert np.all(error["after"] < 1.15 * TOLD)


def test_what_no_effect_represents_is_reported_with_its_channel(tmp_path):
    """A channel that acts in bands of temperature: no effect has that form, and none is put in its place."""
    closed, error = loop(tmp_path, 8, ("bands",))
    assert closed.verdict.word == "unexplained"
    assert closed.content["effects"] == []
    (left,) = [s for s in closed.content["unexplained"] if s["channel"] == "voltage"]
    assert left["description"] == "voltage, with an influence that changes with temperature"
    np.testing.assert_allclose(error["after"], error["before"], rtol=1e-6)


def test_jumps_that_follow_nothing_are_unexplained(tmp_path):
    closed, _ = loop(tmp_path, 7, ("telegraph",))
    assert closed.verdict.word == "unexplained"
    assert any("jumps" in s["description"] for s in closed.content["unexplained"])


def test_two_channels_that_move_together_are_ambiguous(tmp_path):
    closed, error = loop(tmp_path, 7, ("channel",), (*AUXILIARY, "twin"))
    (effect,) = closed.content["effects"]
    assert closed.verdict.word == "ambiguous"
    assert {effect["channel"], *(name.rpartition(" ")[2] for name in effect["indistinguishable_from"])} == {
        "voltage",
        "twin",
    }
    best = closed.content["experiments"][0]
    assert "alone" in best["description"]
    assert best["expected_gain_nats"] > 10
    assert np.all(error["after"] < 1.15 * TOLD)  # either predicts as well, as long as they move together


def test_a_unit_that_was_only_ever_warmed_up_is_to_be_recorded_otherwise(tmp_path):
    """Time and temperature are one there: nothing is added, and a recording is asked for that parts them."""
    closed, _ = loop(tmp_path, 7, ("drift",), (), once=True, hours=(3.0, 2.2, 2.2))
    assert closed.content["effects"] == []
    assert closed.verdict.word == "unexplained"
    (experiment,) = closed.content["experiments"]
    assert "up and down" in experiment["description"]
    assert experiment["expected_gain_nats"] > 10
    assert any("another recording would tell" in line for line in closed.lines)


def test_nothing_is_added_where_nothing_is_missing(tmp_path):
    """No false addition in units with decoy channels: four here, 12 in `make statistics`; `make loop` has more."""
    false = []
    for seed in range(draws(4, 12)):
        folder = tmp_path / str(seed)
        folder.mkdir()
        make_unit(folder, 1000 + seed, (), AUXILIARY, hours=(0.7, 0.6, 0.05))
        config = load_config(folder / "declared.yaml")
        soak, train = str(folder / "soak.h5"), str(folder / "train.h5")
        fit_map(config, [soak], None, Faults()).save(folder / "map.json")
        evidence = gather(with_map(config, path=folder / "map.json"), [soak], [train], lambda text: None)
        T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
        basis = config.maps()[0].basis((float(T.min()), float(T.max())))
        with threadpool_limits(1):
            found = search(evidence, basis, lambda text: None)
        if found.model:
            false.append((seed, [term.effect.kind for term in found.model]))
        shutil.rmtree(folder)
    assert not false


@pytest.mark.recordings
@pytest.mark.parametrize(("unit", "expected"), [("a", ["hysteresis"]), ("b", ["channel"]), ("c", [])])
def test_recordings_with_undeclared_effects(recordings, tmp_path, unit, expected):
    """Units made by others: the effect is named, and the error is that of a model told the truth."""
    folder = recordings / "blind" / unit
    auxiliary = {"a": "", "b": "voltage pressure", "c": "voltage pressure temperature_case magnetic"}[unit]
    units = {"voltage": "V", "pressure": "hPa", "temperature_case": "degC", "magnetic": "uT"}
    named = "\n".join(f"    {name}: {{path: {name}, unit: {units[name]}}}" for name in auxiliary.split())
    path = tmp_path / "declared.yaml"
    path.write_text(CONFIG.format(channels=named).replace("accel, unit: m/s^2", "accel, unit: g"))
    names = [[str(folder / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    closed = explain(load_config(path), *names, out=tmp_path / "out").closed
    assert kinds(closed) == expected
    truth = np.load(folder / "holdout_bias_truth.npy")
    with h5py.File(tmp_path / "out" / "prediction.h5") as file, h5py.File(folder / "holdout.h5") as holdout:
        group = file["holdout"]
        true = np.stack([np.interp(group["t"][()], holdout["time"][()], axis) for axis in truth.T], axis=1)
        error = np.std(group["after"][()] - true, axis=0)
    assert np.all(error < 1.15 * TOLD)


RAMPS = ("::0:9300", "::9300:18300", "::18300:")
HELD = """
source:
  kind: csv
  channels:
    time: {path: time, unit: s}
    resistance: {path: ppm, unit: ppm}
    temperature: {path: oven, unit: degC}
    ambient: {path: ambient, unit: degC}
filter:
  kind: held
  channel: resistance
  update_interval: 5 s
  align: 5 min
  noise: 0.2 ppm/sqrt(Hz)
  bias: {kind: thermal_derivative, walk: 2e-3 ppm/sqrt(s), map: {kind: polynomial, order: 3, outside: clamp}}
"""


@pytest.mark.recordings
def test_a_resistor_that_lags_behind_its_thermometer_is_explained_in_its_own_unit(recordings, tmp_path):
    """A measured relaxation from an unknown start, in ppm all the way, of which 1 is 1e-6.

    The coast is as the loop says of what it leaves out, and its error a third of the declared model's at most.
    """
    path = tmp_path / "declared.yaml"
    path.write_text(HELD)
    names = [[f"{recordings / 'data' / 'oven_resistors' / 'lagging.csv'}{ramp}"] for ramp in RAMPS]
    closed = explain(load_config(path), *names, out=tmp_path / "out").closed
    content = closed.content
    assert kinds(closed) == ["relaxation"]
    assert closed.search.model[0].free
    (o,) = closed.outcomes
    assert np.nanstd(o.after - o.reference) < np.nanstd(o.before - o.reference) / 3
    t, errors, rate = left_out((tmp_path / "out", closed), load_config(path), *names)
    assert_same_coast(tmp_path / "out" / "prediction.h5", t, errors, rate)
    assert content["unit"] == "1"
    assert content["effects"][0]["unit"] == "1/K"
    assert content["after"]["coast_rmse"] < 0.6 * content["before"]["coast_rmse"]
    assert not [key for key in content["before"] if key.endswith("rad_s")]
    assert any("ppm)" in line for line in closed.lines)
    assert not [line for line in closed.lines if "deg/h" in line]
    with h5py.File(tmp_path / "out" / "prediction.h5") as file:
        (group,) = file.values()
        assert group["after"].attrs["unit"] == "1"
        measured = group["reference"][()]
    assert 1e-7 < np.nanstd(measured) < 1e-4  # a few ppm, as a fraction
    bias = load_config(tmp_path / "out" / "explained.yaml").filter.tracked.bias
    assert "ppm" in bias.walk[0].text
    (effect,) = bias.effects
    assert effect.initial[0] > 0
    report = (tmp_path / "out" / "report.html").read_text()
    assert "[ppm]" in report
    assert "deg/h" not in report
