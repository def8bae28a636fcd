"""Measured recordings through the whole program."""

import numpy as np
import pytest

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from driftlab.maps.fit import fit_map, gather
from fusion_core.errors import ConfigError
from fusion_core.faults import Faults

pytestmark = pytest.mark.recordings

DEG_H = np.rad2deg(1.0) * 3600


def pan(recordings):
    """PAN CubeSat, 25 bursts of 5 s at 50 Hz, one every 305 s, in a cold vacuum chamber; no accelerometer."""
    return Config.model_validate(
        {
            "source": {
                "kind": "csv",
                "path": str(recordings / "data/pan_tvc_lsm6dsm/pan_tvc_50hz_bursts.csv"),
                "channels": {
                    "time": {"path": "t_s", "unit": "s"},
                    "gyro": {"path": ["gx_rad_s", "gy_rad_s", "gz_rad_s"], "unit": "rad/s"},
                    "temperature": {"path": "temp_C", "unit": "degC"},
                    "valid": {"path": ["ok_x", "ok_y", "ok_z"]},
                },
            },
            "filter": {
                "align": "4 s",
                "gyro": {"noise": "2e-3 deg/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "2e-4 deg/s/sqrt(s)"}},
            },
        }
    )


def test_the_blocks_of_a_soak_stand_where_they_were_recorded(recordings):
    """Bursts of 5 s, one every 305 s, in two parts: the second begins where the first has ended."""
    path = str(recordings / "data/pan_tvc_lsm6dsm/pan_tvc_50hz_bursts.csv")
    soak = gather(pan(recordings), [f"{path}::0:3800", f"{path}::3800:"], Faults()).summary
    one, two = (soak.t[soak.recording == k] for k in (0, 1))
    assert 12 * 305 < np.ptp(one) < 12 * 305 + 10
    assert 11 * 305 < np.ptp(two) < 11 * 305 + 10
    assert 0 < two[0] - one[-1] < 10
    assert np.sum(soak.span) < 25 * 6


def test_samples_that_are_there_twice_are_refused(recordings):
    """They would count as another soak: a sigma too small by the root of two."""
    path = str(recordings / "data/pan_tvc_lsm6dsm/pan_tvc_50hz_bursts.csv")
    with pytest.raises(ConfigError, match=r"has samples in common with .*, and would count twice; name it once"):
        gather(pan(recordings), [f"{path}::0:3800", path], Faults())


def test_bursts_and_gaps_run_through_without_a_special_case(recordings):
    config, journal = pan(recordings), RunLog()
    stretches = list(Run(config, journal))
    t = np.concatenate([s.epochs.t for s in stretches])
    bias = np.concatenate([s.bias for s in stretches])
    sigma = np.concatenate([s.sigma for s in stretches])
    tau = np.concatenate([s.epochs["tau"] for s in stretches])
    used = np.concatenate([s.estimates.used for s in stretches])
    assert np.mean(used) > 0.98
    assert tau.max() < 0.2  # a gap is nobody's time
    assert np.all(np.isfinite(bias))
    gaps = np.flatnonzero(np.diff(t) > 100)
    assert len(gaps) == 24
    assert np.all(sigma[gaps + 1] > sigma[gaps])  # what is not measured grows uncertain
    # at the end of each burst the estimate is the burst's mean, as computed by others
    means = np.genfromtxt(recordings / "data/pan_tvc_lsm6dsm/pan_tvc_burst_means.csv", delimiter=",", names=True)
    ends = np.append(gaps, len(t) - 1)
    expected = np.stack([means[f"g{axis}_mean_rad_s"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(bias[ends], expected, atol=1.2e-4)
    assert np.sqrt(np.mean((bias[ends] - expected) ** 2)) < 4e-5


def test_a_map_of_one_sweep_fits_the_other(recordings):
    """RTIMULib2: no time column, two heating sweeps. Rms of the means of 25 rows, the sweep's constant removed.

    An independent cubic fit leaves 23/25/25 deg/h from run 2 to run 3, and 35/21/23 back.
    """
    folder = recordings / "data" / "rtimulib2_teensy"
    gyro = {"path": ["gx_rad_s", "gy_rad_s", "gz_rad_s"], "unit": "rad/s"}
    channels = {"gyro": gyro, "temperature": {"path": "temp_C", "unit": "degC"}, "valid": {"path": "ok"}}

    def sweep(number):
        path = str(folder / f"measurements{number}.csv")
        return Config.model_validate({"source": {"kind": "csv", "path": path, "interval": "1 s", "channels": channels}})

    for a, b, expected in ((2, 3, [23, 25, 25]), (3, 2, [35, 21, 23])):
        fitted = fit_map(sweep(a), [], "polynomial", Faults())
        soak = gather(sweep(b), [], Faults())
        T, bias = soak.T, soak.bias
        inside = (fitted.domain[0] <= T) & (fitted.domain[1] >= T)
        left = bias[inside] - fitted.bias(T[inside])
        left = left[: len(left) // 25 * 25].reshape(-1, 25, 3).mean(axis=1)
        rms = np.std(left, axis=0) * DEG_H
        assert np.all(rms < 1.1 * np.array(expected)), rms


def test_what_cannot_be_used_is_reported(recordings):
    config, faults = pan(recordings), Faults()
    gather(config, [], faults)
    assert any("flagged as not valid" in line for line in faults.lines())


@pytest.mark.parametrize("unit", ["a", "b", "c"])
def test_a_spline_of_the_soak_follows_the_ramp(recordings, unit, tmp_path):
    """The declared model on units with a known truth: coasting with the map beats coasting without, on every axis."""
    folder = recordings / "blind" / unit
    spline = {"kind": "spline", "path": str(tmp_path / "map.json"), "outside": "clamp"}
    gyro = {"noise": "3.2 deg/h/sqrt(Hz)"}
    channels = {name: {"path": name} for name in ("time", "gyro", "accel", "temperature")}
    base = {"latitude": "40.9 deg", "heading": "0 deg", "source": {"kind": "hdf5", "channels": channels}}
    accel = {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2 m/s/h/sqrt(s)"}}
    walk = {"walk": "3e-5 deg/s/sqrt(s)"}

    def config(bias):
        return Config.model_validate(base | {"filter": {"gyro": {**gyro, "bias": bias}, "accel": accel}})

    with_map = config({"kind": "thermal_derivative", **walk, "map": spline})
    fit_map(with_map, [str(folder / "soak.h5")], None, Faults()).save(tmp_path / "map.json")
    truth = np.load(folder / "holdout_bias_truth.npy")
    errors = {}
    for name, settings in (("map", with_map), ("none", config({"kind": "random_walk", **walk}))):
        source = settings.source.model_copy(update={"path": folder / "holdout.h5"})
        stretches = list(Run(settings.model_copy(update={"source": source}), RunLog()))
        t = np.concatenate([s.epochs.t for s in stretches])
        coast = np.concatenate([s.coast for s in stretches])
        error = coast - truth[np.rint(t * 4).astype(int)]
        error = error[np.isfinite(error[:, 0])]
        errors[name] = np.std(error, axis=0)
    # a and b have an effect in them that the map lacks; c has none
    assert np.all(errors["map"] < (0.4 if unit == "c" else 1.0) * errors["none"]), errors
