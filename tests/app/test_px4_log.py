"""From a PX4 log to a map, a run and noise figures, by a config of three lines."""

import json

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner
from ulog_writer import Extras, sensor, write_ulog

from driftlab.cli import app
from fusion_plugins.thermal_maps.polynomial import Polynomial

CONFIG = """\
extends: px4_log
latitude: 47.4 deg
filter: {gyro: {calibration: {kind: polynomial, path: map.json}}}
"""
DEVICES = (0x26000A, 0x3C0312)
SLOPE = np.deg2rad([0.012, -0.02, 0.006])  # rad/s/K
SECONDS, RATE, NOISE = 420, 10, np.deg2rad(0.03)  # rad/s a sample


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A vehicle that warms up from 15 to 45 degC, level, y to the north; its second unit is another one."""
    folder = tmp_path_factory.mktemp("px4")
    rng = np.random.default_rng(6)
    t = 30 + np.arange(SECONDS * RATE) / RATE
    T = np.round(15 + 30 * (t - 30) / SECONDS, 1)
    phi, rate = np.deg2rad(47.4), 7.292115e-5
    earth = rate * np.array([np.cos(phi), 0, -np.sin(phi)])  # x north, z down
    topics = []
    for k, device in enumerate(DEVICES):
        gyro = earth + 1e-3 + (1 + k) * SLOPE * (T - 30)[:, None] + NOISE * rng.normal(size=(len(t), 3))
        accel = [0, 0, -9.80665] + 0.02 * rng.normal(size=(len(t), 3))
        topics += [sensor("sensor_gyro", k, t, gyro, T, device), sensor("sensor_accel", k, t + 3e-4, accel, T, device)]
    write_ulog(folder / "soak.ulg", topics, {"TC_G_ENABLE": 0, "SDLOG_PROFILE": 5}, Extras([(200_000_000, 80)]))
    (folder / "unit.yaml").write_text(CONFIG)
    (folder / "other.yaml").write_text(CONFIG + f"source: {{device_id: '{hex(DEVICES[1])}'}}\n")
    return folder


def driftlab(folder, monkeypatch, *args):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(app, [*args, "--input", "soak.ulg"])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.mark.parametrize(("config", "times"), [("unit.yaml", 1), ("other.yaml", 2)])
def test_a_map_of_the_unit_that_is_named(folder, monkeypatch, config, times):
    said = driftlab(folder, monkeypatch, "fit-map", config, "--out", f"{config}.json")
    assert f"read are sensor_gyro[{times - 1}], device_id {DEVICES[times - 1]}" in said
    assert "dropouts, for which the logger wrote nothing (0.08 s in all): 1" in said
    fitted = Polynomial(path=folder / f"{config}.json").load()
    swing = fitted.bias(np.array([44.0, 16.0]))
    sigma = NOISE / np.sqrt(RATE * SECONDS / 10)  # of the mean over a tenth of the soak, at either end
    np.testing.assert_allclose(swing[0] - swing[1], times * SLOPE * 28, atol=5 * sigma)


def test_a_run_with_that_map(folder, monkeypatch):
    driftlab(folder, monkeypatch, "fit-map", "unit.yaml")
    driftlab(folder, monkeypatch, "run", "unit.yaml", "--out", "done")
    summary = json.loads((folder / "done" / "summary.json").read_text())
    notes = [what for what, fault in summary["faults"].items() if fault == {"count": 0, "first": ""}]
    assert any(f"device_id {DEVICES[0]}" in note for note in notes)
    with h5py.File(folder / "done" / "estimates.h5") as file:
        t = file["t"][:]
    assert t[[0, -1]] == pytest.approx([30, 30 + SECONDS], abs=2)  # in the vehicle's own time


def test_its_noise(folder, monkeypatch):
    found = json.loads(driftlab(folder, monkeypatch, "allan", "unit.yaml", "--json", "--out", "noise"))
    white = [found["gyro"][a]["white"]["value"] for a in "xyz"]
    assert found["gyro"]["x"]["white"]["unit"] == "rad/s/sqrt(Hz)"
    assert white == pytest.approx([NOISE / np.sqrt(RATE)] * 3, rel=0.1)
