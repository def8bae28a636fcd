"""Noise in a run's folder: the factors that the recording was made with, for both sensors."""

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from driftlab import api
from driftlab.cli import app
from driftlab.commands.export import inflations, of_config, with_inflation
from driftlab.errors import ConfigError, UnreadableFile
from fusion_plugins.thermal_maps.polynomial import Polynomial

NOISE, WALK = {"gyro": 1e-4, "accel": 1e-3}, {"gyro": 2e-6, "accel": 3e-5}
WHITE, WALKED = {"gyro": [1.0, 1.5, 2.0], "accel": [0.7, 1.0, 1.3]}, {"gyro": [4.0, 1.0, 2.0], "accel": [2.0, 3.0, 1.0]}
SLOPE = 2e-4  # of the gyro's bias with temperature, rad/s/K
UNITS = {"gyro": "rad/s", "accel": "m/s^2"}


def section(channel, **bias):
    return {
        "noise": f"{NOISE[channel]} {UNITS[channel]}/sqrt(Hz)",
        "bias": {"walk": f"{WALK[channel]} {UNITS[channel]}/sqrt(s)", **bias},
    }


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A run's folder, its config's file, and a config; the map is the one that the recording was made with."""
    folder, rng, N = tmp_path_factory.mktemp("run"), np.random.default_rng(4), 8000
    t, T = np.arange(N) * 1.0, np.linspace(10, 40, N)
    data = {"time": (t, "s"), "temperature": (T, "degC")}
    for channel, unit in UNITS.items():
        walk = np.cumsum(np.multiply(WALKED[channel], WALK[channel]) * rng.normal(size=(N, 3)), axis=0)
        values = walk + np.multiply(WHITE[channel], NOISE[channel]) * rng.normal(size=(N, 3))
        values += SLOPE * (T - 10)[:, None] if channel == "gyro" else [0.0, 0.0, 9.80665]
        data[channel] = (values, unit)
    grid = np.linspace(10, 40, 500)
    Polynomial(order=1).fit(grid, np.tile(SLOPE * (grid - 10)[:, None], 3), {}).save(folder / "map.json")
    mapped = {"kind": "polynomial", "order": 1, "path": str(folder / "map.json"), "outside": "clamp"}
    config = {
        "filter": {
            "gyro": section("gyro", kind="thermal_derivative", map=mapped),
            "accel": section("accel", kind="random_walk"),
            "rest": {"false_alarm": 1e-30},
        }
    }
    api.run(config, data, out=folder / "out")
    (folder / "unit.yaml").write_text(yaml.safe_dump(config))
    return folder, config


def test_both_sensors_have_the_factors_that_they_were_made_with(place):
    folder, _ = place
    found = inflations(folder / "out")
    for channel in UNITS:
        one = found[channel]["compensated"]
        np.testing.assert_allclose(one.of_noise.value, WHITE[channel], rtol=0.03)
        np.testing.assert_allclose(one.of_walk.value, WALKED[channel], rtol=0.4)
        assert np.all(one.of_walk.low < WALKED[channel])
        assert np.all(one.of_walk.high > WALKED[channel])
        assert all(np.all(lag.ratio < lag.high) for lag in one.lags)


def test_readings_that_nobody_compensates_need_a_walk_that_covers_the_temperature(place):
    """The temperature moves the bias by a ramp: over ten minutes like a walk of r sqrt(3 L / 2)."""
    folder, _ = place
    found = inflations(folder / "out")["gyro"]
    ramp = SLOPE * 30 / 8000
    (lag,) = (lag for lag in found["raw"].lags if lag.seconds == 600)
    walk = np.hypot(ramp * np.sqrt(1.5 * 600), np.multiply(WALKED["gyro"], WALK["gyro"])) / WALK["gyro"]
    np.testing.assert_allclose(lag.walk, walk, rtol=0.35)
    assert np.all(found["compensated"].of_walk_up_to(600.0) <= found["raw"].of_walk_up_to(600.0) * 1.1)


def test_the_command_writes_them(place):
    folder, _ = place
    out, args = folder / "imu.yaml", ["--run", str(folder / "out"), "--set", "rate=200 Hz", "--set", "compensated=true"]
    done = CliRunner().invoke(app, ["export", "kalibr", str(folder / "unit.yaml"), "--out", str(out), *args])
    assert done.exit_code == 0, done.output
    read = yaml.safe_load(out.read_text())
    assert read["gyroscope_noise_density"] == pytest.approx(2e-4, rel=0.03)
    assert read["accelerometer_random_walk"] == pytest.approx(9e-5, rel=0.4)


def test_what_is_no_run_is_refused(place, tmp_path):
    folder, config = place
    with pytest.raises(ConfigError, match=r"has no estimates\.h5; name the folder that `driftlab run --out` wrote"):
        inflations(tmp_path)
    (tmp_path / "estimates.h5").write_bytes(b"no HDF5")
    with pytest.raises(UnreadableFile):
        inflations(tmp_path)
    what = of_config(api.check({"filter": {**config["filter"], "accel": None}}).config)
    with pytest.raises(ConfigError, match="is of accel, which the config has not; name a run of its own"):
        with_inflation(what, folder / "out")
