"""From an ArduPilot log to a map, a run and the noise with a config of three lines."""

import json

import numpy as np
import pytest
from autopilots import logged, parameters
from dataflash_writer import write_log
from typer.testing import CliRunner

from driftlab.cli import app
from driftlab.commands.fit_map import fit_map
from driftlab.config import load_config

DEG, G = np.pi / 180, 9.80665
TCAL = (25.0, 60.0, 40.0, np.array([[300.0, -150.0, 80.0], [4.0, 3.0, -2.0], [-0.1, 0.05, 0.02]]))
OFFSET = (0.004, -0.003, 0.002)


def bias(T):
    """The gyro's own, rad/s: what its map must show."""
    return np.stack([0.3 + 0.02 * (T - 35), -0.1 - 3e-4 * (T - 35) ** 2, 0.005 * (T - 35)], axis=1) * DEG


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A vehicle that learned a poor polynomial, mounted upside down, 20 minutes from cold to warm."""
    folder = tmp_path_factory.mktemp("vehicle")
    rng = np.random.default_rng(4)
    t = 15 + np.arange(20 * 60 * 25) / 25
    T = 22 + 35 * (1 - np.exp(-(t - 15) / 400))
    omega = bias(T) + 0.05 * DEG * rng.normal(size=(len(t), 3))
    f = np.array([0.0, 0.0, G]) + 7e-3 * rng.normal(size=(len(t), 3))
    gyro = logged(omega, T, orientation=8, offset=OFFSET, tcal=TCAL)
    accel = logged(f, T, orientation=8)
    values = parameters("GYR", orientation=8, offset=OFFSET, tcal=TCAL)
    write_log(folder / "soak.bin", t, [(gyro, accel, T)], values)
    (folder / "vehicle.yaml").write_text("extends: ardupilot_log\nlatitude: 0 deg\nsource: {path: soak.bin}\n")
    return folder


def driftlab(folder, *args):
    done = CliRunner().invoke(app, [str(folder / arg) if "." in arg or arg == "out" else arg for arg in args])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_a_map_is_the_sensors_own_and_not_what_the_autopilot_left(folder):
    out = driftlab(folder, "fit-map", "vehicle.yaml", "--kind", "polynomial", "--out", "map.json")
    assert "rows of gyro 0 with corrections of the autopilot undone: INS_GYROFFS, INS_TCAL1 (polynomial), AHRS" in out
    T = np.linspace(25, 55, 50)
    shown = fit_map(load_config(folder / "vehicle.yaml"), [], kind="polynomial").map.bias(T)
    np.testing.assert_allclose(shown, bias(T), atol=0.003 * DEG)


def test_it_runs(folder):
    driftlab(folder, "run", "vehicle.yaml", "--out", "out")
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert any("autopilot undone" in fault for fault in map(str, summary["faults"]))


def test_its_noise_is_told(folder):
    found = json.loads(driftlab(folder, "allan", "vehicle.yaml", "--json"))
    white = found["gyro"]["z"]["white"]["value"]
    assert white == pytest.approx(0.05 / 5 * DEG, rel=0.1)


def test_three_lines_are_enough_for_a_map(folder):
    out = driftlab(folder, "fit-map", "vehicle.yaml")
    assert "kind of map: spline, since the config names none" in out
    assert "in the config: filter.gyro.calibration: {kind: spline, path: vehicle.map.json}" in out
    assert (folder / "vehicle.map.json").is_file()
