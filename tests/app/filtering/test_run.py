"""Whole runs over units whose true bias is known, and over data that is not as it should be."""

from typing import Literal

import numpy as np
import pytest
from units_at_rest import OMEGA_IE, thermal_bias, unit_at_rest

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read
from fusion_core.chunk import Chunk
from fusion_core.contracts import Source, ThermalMap
from fusion_core.errors import ConfigError, MissingChannel, NotAtRest, OutsideDomain
from fusion_core.host.registry import registry

GYRO = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}}
ACCEL = {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}}


STILL = {"attitude": "1e-8 rad", "velocity": "1e-8 m/s"}  # as the simulated unit is


class StandIn(Source):
    kind: Literal["stand_in"] = "stand_in"

    def chunks(self, size, faults):
        return iter(())


def config(**filter_settings):
    sections = {"gyro": GYRO, "accel": ACCEL, **filter_settings}
    return Config.model_validate({"latitude": "40.9 deg", "heading": "0 deg", "filter": sections})


def go(settings, unit, size=100_000, journal=None):
    """Run over a unit in chunks of `size` samples; return the journal and the joined arrays."""
    journal = journal or RunLog()
    whole = Chunk(unit.t, unit.channels())
    parts = (whole.part(k, min(k + size, len(whole))) for k in range(0, len(whole), size))
    out = list(Run(settings, journal).over(epochs(parts, settings.filter.update_interval)))
    arrays = {
        "t": np.concatenate([s.epochs.t for s in out]),
        "x": np.concatenate([s.estimates.x for s in out]),
        "nis": np.concatenate([s.estimates.nis for s in out]),
        "used": np.concatenate([s.estimates.used for s in out]),
        "tau": np.concatenate([s.epochs["tau"] for s in out]),
        **{name: np.concatenate([getattr(s, name) for s in out]) for name in ("rate", "bias", "sigma", "coast")},
    }
    arrays["truth"] = unit.bias[np.searchsorted(unit.t, arrays["t"] - 1e-6)]
    return journal, arrays


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A cubic map of the units' thermal curve, as file."""
    T = np.linspace(-20, 60, 2000)
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 7})
    path = tmp_path_factory.mktemp("maps") / "map.json"
    settings.fit(T, thermal_bias(T), {}).save(path)
    return str(path)


def test_estimates_are_as_good_as_they_say():
    errors, nis = [], []
    for seed in range(6):
        _, got = go(config(rest=STILL), unit_at_rest(seconds=400, seed=seed))
        late = got["t"] > 60
        errors.append((got["bias"] - got["truth"])[late] / got["sigma"][late])
        nis.append(got["nis"][late] / 6)
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    assert np.all((rms > 0.75) & (rms < 1.25))
    assert np.mean(np.concatenate(nis)) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("bias", [
    GYRO["bias"],
    {"kind": "gauss_markov", "sigma": "10 deg/h", "tau": "300 s"},
    {"kind": "constant"},
    {"kind": "thermal_derivative", "walk": "1e-5 deg/s/sqrt(s)", "repeatability": "1 deg/s", "effects": [
        {"kind": "relaxation", "tau": "90 s", "coefficients": [1e-5, 0.0, -1e-5], "initial": [1e-4, 1e-4, 0.0]},
        {"kind": "hysteresis", "width": "2 K", "coefficients": [1e-5, 0.0, -1e-5], "initial": [1e-5, 1e-5, 1e-5]}]},
], ids=lambda b: b["kind"])  # fmt: skip
def test_any_split_gives_the_same_run(bias):
    settings = config(gyro={**GYRO, "bias": bias})
    unit = unit_at_rest(seconds=300, temperature=lambda t: 25 + t / 100)
    unit.gyro[4000:4040] += 0.02  # motion
    unit.t[5000:] += 77.7  # a gap
    journal, whole = go(settings, unit)
    for size in (5999, 997, 130):
        again, split = go(settings, unit, size)
        for name in ("t", "used"):
            np.testing.assert_array_equal(split[name], whole[name])
        for name in ("bias", "coast", "x"):
            # the methods join at other samples: equal to rounding, 1e-12 of the values and of their deviation
            scale = 1e-12 * (np.nanmax(np.abs(whole[name])) + np.nanmax(whole["sigma"]))
            np.testing.assert_allclose(split[name], whole[name], rtol=0, atol=scale)
        assert again.moving == journal.moving


@pytest.mark.parametrize("form", ["difference", "slope"])
@pytest.mark.parametrize("rate", ["regression", "kalman"])
def test_tczupt_follows_a_ramp(maps, form, rate):
    """A standard filter without a map lags a 2 K/min ramp; the thermal derivative removes that, also while coasting."""
    unit = unit_at_rest(seconds=700, walk=1e-7, temperature=lambda t: 27.28 + np.clip(t - 120, 0, 200) / 30)
    bias = {"kind": "thermal_derivative", "walk": "1e-5 deg/s/sqrt(s)", "form": form}
    bias |= {"map": {"kind": "polynomial", "path": maps}}
    _, with_map = go(config(gyro={**GYRO, "bias": bias}, temperature_rate={"kind": rate}), unit)
    plain = {"kind": "random_walk", "walk": "1e-5 deg/s/sqrt(s)"}
    _, without = go(config(gyro={**GYRO, "bias": plain}), unit)

    def error(got, name):
        late = got["t"] > 150
        return np.sqrt(np.mean((got[name] - got["truth"])[late] ** 2, axis=0))

    # the paper's form integrates an estimated rate, which lags where the ramp starts and ends
    share, coast_share = (0.25, 0.1) if form == "difference" else (0.5, 0.3)
    assert np.all(error(with_map, "bias") < share * error(without, "bias"))
    assert np.all(error(with_map, "coast") < coast_share * error(without, "coast"))


def test_calibration_and_thermal_derivative_coast_alike(maps):
    """With the same map and walk both predict the same: the map's change since the alignment."""
    unit = unit_at_rest(seconds=400, temperature=lambda t: 20 + t / 60)
    walk = GYRO["bias"]["walk"]
    standard = config(gyro={**GYRO, "calibration": {"kind": "polynomial", "path": maps}})
    derivative = {"kind": "thermal_derivative", "walk": walk, "map": {"kind": "polynomial", "path": maps}}
    a, b = go(standard, unit)[1], go(config(gyro={**GYRO, "bias": derivative}), unit)[1]
    np.testing.assert_allclose(a["coast"], b["coast"], atol=1e-7)  # half an epoch of the ramp is 5e-8
    np.testing.assert_allclose(a["bias"], b["bias"], atol=1e-7)


def test_motion_is_not_used_and_is_reported():
    unit = unit_at_rest(seconds=300)
    unit.gyro[4000:4100] += 0.05 * np.sin(np.arange(100) / 5)[:, None]
    journal, got = go(config(), unit)
    (start, stop), *more = journal.moving.spans
    assert not more
    assert 199.9 <= start <= 200.3
    assert 205.0 <= stop <= 206.1  # a second without motion ends it
    late = (got["t"] > 200) & (got["t"] < 210)
    assert np.all(np.abs(got["bias"] - got["truth"])[late] < 6 * got["sigma"][late])


def test_a_step_of_the_bias_is_learnt_after_a_new_alignment():
    unit = unit_at_rest(seconds=400)
    unit.gyro[4000:] += [3e-3, 0, 0]
    unit.bias[4000:] += [3e-3, 0, 0]
    journal, got = go(config(), unit)
    assert len(journal.alignments) == 2
    assert journal.alignments[1].t == pytest.approx(260, abs=1)
    np.testing.assert_allclose(got["bias"][-1], got["truth"][-1], atol=3e-5)


def test_a_large_bias_is_rest_all_the_same():
    _, got = go(config(), unit_at_rest(seconds=150, offset=(0.5, -0.3, 0.2)))
    assert np.all(got["used"])
    np.testing.assert_allclose(got["bias"][-1], got["truth"][-1], atol=3e-5)


def test_handling_at_the_start_is_waited_out():
    unit = unit_at_rest(seconds=300)
    unit.gyro[:600] += 0.3 * np.random.default_rng(0).normal(size=(600, 3))
    journal, got = go(config(), unit)
    assert 85 <= journal.alignments[0].t <= 120
    np.testing.assert_allclose(journal.alignments[0].inputs["gyro"], OMEGA_IE, atol=2e-7)
    assert np.all(np.abs(got["bias"] - got["truth"])[-1] < 5 * got["sigma"][-1])


def test_a_gap_is_predicted_across():
    """The variance after the gap has grown by the walk over it, no more and no less, before the next update."""
    unit = unit_at_rest(seconds=400)
    unit.t[4000:] += 500.0
    _, got = go(config(), unit)
    k = int(np.searchsorted(got["t"], 400))
    assert got["t"][k] - got["t"][k - 1] > 499
    # one epoch of 0.1 s after the gap: walk^2 500 s and the epoch's white noise, weighed against one another
    prior = 2.618e-6**2 * 500 + got["sigma"][k - 1] ** 2
    measured = 1.5417e-5**2 / got["tau"][k]
    np.testing.assert_allclose(got["sigma"][k], np.sqrt(1 / (1 / prior + 1 / measured)), rtol=0.02)


def test_a_wrong_noise_figure_is_noticed_and_does_not_become_motion():
    unit = unit_at_rest(seconds=300, noise=4 * 1.54e-5)
    journal, got = go(config(), unit)
    np.testing.assert_allclose(journal.alignments[0].noise_ratio["gyro"], 4, rtol=0.15)
    assert np.mean(got["used"]) > 0.999


def test_never_at_rest_is_an_error():
    unit = unit_at_rest(seconds=200)
    unit.gyro += 0.5 * np.sin(unit.t)[:, None]
    with pytest.raises(NotAtRest, match="no 60 s at rest were found"):
        go(config(), unit)
    with pytest.raises(NotAtRest, match="no 60 s at rest were found"):
        go(config(), unit_at_rest(seconds=30))


def test_an_alignment_of_too_few_updates_says_so():
    made = config()
    short = made.filter.model_copy(update={"align": 5.0, "update_interval": 5.0})
    with pytest.raises(NotAtRest, match=r"has 2 updates at most, 3 are needed; set filter.align to 15 s or more, or"):
        go(made.model_copy(update={"filter": short}), unit_at_rest(seconds=200))


def test_temperature_outside_the_domain_names_the_time(maps):
    unit = unit_at_rest(seconds=200, temperature=lambda t: 58 + t / 60)
    bias = {"kind": "thermal_derivative", "walk": "1e-5 deg/s/sqrt(s)", "map": {"kind": "polynomial", "path": maps}}
    message = r"polynomial: T = 60\.\d+ °C at t = 1[23]\d\.\d+ s is outside the map's domain \(-20, 60\); refit"
    with pytest.raises(OutsideDomain, match=message):
        go(config(gyro={**GYRO, "bias": bias}), unit)


@pytest.mark.parametrize(("answer", "effects", "noted"), [
    ("seen", [], True), ("none", [], False), ("seen", [{"kind": "hysteresis", "width": "2 K"}], False),
])  # fmt: skip
def test_a_memory_of_the_maps_soak_that_nothing_follows_is_noted(maps, tmp_path, answer, effects, noted):
    fitted = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "path": maps}).load()
    size = np.deg2rad([0.0, -30.0, 5.0]) / 3600
    memory = {"answer": answer, "kinds": ["hysteresis"], "size": size.tolist()}
    fitted.noting(memory=memory).save(tmp_path / "map.json")
    settings = {"kind": "polynomial", "path": str(tmp_path / "map.json")}
    bias = {"kind": "thermal_derivative", "walk": "1e-5 deg/s/sqrt(s)", "map": settings, "effects": effects}
    journal = RunLog()
    Run(config(gyro={**GYRO, "bias": bias}), journal)
    said = [text for text in journal.faults.found if "up and down differ by up to 30 deg/h, y" in text]
    assert len(said) == noted


def test_missing_channels_and_axes_are_named(maps):
    unit = unit_at_rest(seconds=100)
    unit.channels = lambda: {"gyro": unit.gyro}
    with pytest.raises(MissingChannel, match=r"channel 'accel' is needed by the filter.*or write `accel: null`"):
        go(config(), unit)
    bias = {"kind": "thermal_derivative", "walk": "1e-5 deg/s/sqrt(s)", "map": {"kind": "polynomial", "path": maps}}
    with pytest.raises(
        MissingChannel, match="channel 'temperature' is needed by the filter and the recording has gyro;"
    ):
        go(config(accel=None, gyro={**GYRO, "bias": bias}), unit)
    unit.channels = lambda: {"gyro": unit.gyro[:, :1]}
    with pytest.raises(ConfigError, match="the recording has 1 axes and the bias model 3"):
        go(config(accel=None), unit)


def test_one_axis_is_enough():
    unit = unit_at_rest(seconds=200)
    unit.channels = lambda: {"gyro": unit.gyro[:, 2:]}
    _, got = go(config(accel=None, gyro={**GYRO, "bias": {**GYRO["bias"], "axes": ["z"]}}), unit)
    assert got["x"].shape[1] == 2
    np.testing.assert_allclose(got["bias"][-1, 0], got["truth"][-1, 2] + OMEGA_IE[2], atol=3e-5)


def test_a_sensor_that_is_stuck_from_the_start_is_named():
    unit = unit_at_rest(seconds=300)
    unit.gyro[:, 1] = 1e-3
    whole, journal = Chunk(unit.t, unit.channels()), RunLog()
    stream = read(config().model_copy(update={"source": StandIn()}), journal.faults, stream=[whole])
    message = r"no 60 s at rest.*looked at, rows where gyro is stuck, left out: \d+ \(first y at 4.95 s.*\); use a"
    with pytest.raises(NotAtRest, match=message):
        list(Run(config(), journal).over(epochs(stream, 0.1)))
