"""Commands where POSIX' modules are missing, and files that are open can be neither renamed nor removed."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

SUPPORT = Path(__file__).parent.parent / "support"
CONFIG = """
source: {kind: hdf5, channels: {time: {path: time, unit: s}, gyro: {path: gyro, unit: deg/s},
  temperature: {path: temperature, unit: degC}}}
filter: {gyro: {noise: 3.18 deg/h/sqrt(Hz), bias: {kind: thermal_derivative, walk: 2.2e-5 deg/s/sqrt(s),
  map: {kind: polynomial, order: 3, path: map.json}}}}
"""
TWIN = """
source: {kind: synthetic, rate: 1 Hz, profile: {kind: ramp}}
filter: {gyro: {noise: 3.18 deg/h/sqrt(Hz), bias: {kind: random_walk, walk: 2.2e-5 deg/s/sqrt(s)}}}
"""


def record(path, T):
    rng, x = np.random.default_rng(len(T)), (T - 25) / 20
    bias = np.stack([0.02 + 0.03 * x - 0.01 * x**3, -0.01 + 0.02 * x**2, 0.01 - 0.02 * x], axis=1)
    with h5py.File(path, "w") as file:
        file["time"], file["temperature"] = np.arange(len(T), dtype=float), T
        file["gyro"] = bias + 8.8e-4 * rng.standard_normal(bias.shape)


@pytest.fixture
def folder(tmp_path):
    record(tmp_path / "soak.h5", np.linspace(5, 45, 14_400))
    record(tmp_path / "run.h5", 22 + 14 * np.sin(np.linspace(0, 3, 7200)))
    (tmp_path / "unit.yaml").write_text(CONFIG)
    (tmp_path / "other.yaml").write_text("extends: unit.yaml\n")
    (tmp_path / "twin.yaml").write_text(TWIN)
    units = tmp_path / "units"
    units.mkdir()
    for name in ("a", "b"):
        record(units / f"{name}.h5", np.linspace(5, 45, 7200))
    return tmp_path


def test_commands_work_by_the_rules_of_windows(folder):
    commands = [
        ["init", "soak.h5", "--out", "first.yaml", "--unit", "gyro=deg/s"],
        ["check", "unit.yaml", "--input", "soak.h5"],
        ["fit-map", "unit.yaml", "--input", "soak.h5"],
        ["fit-map", "unit.yaml", "--input", "soak.h5"],  # in the place of the first
        ["run", "unit.yaml", "--input", "run.h5", "--out", "results"],
        ["run", "unit.yaml", "--input", "run.h5", "--out", "results", "--smooth"],
        ["run", "unit.yaml", "--input", "run.h5", "--out", "results", "--resume"],
        ["simulate", "twin.yaml", "--out", "twin.h5"],
        ["compare", "unit.yaml", "other.yaml", "--input", "run.h5", "--out", "compared"],
        ["export", "c", "map.json", "--out", "firmware"],
        ["fleet", "unit.yaml", "--units", "units/*.h5", "--out", "line", "--workers", "2"],
    ]
    done = subprocess.run(
        [sys.executable, SUPPORT / "like_windows.py", folder, json.dumps(commands)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    ended = json.loads(done.stdout.splitlines()[-1])
    wrong = [(command, *end) for command, end in zip(commands, ended, strict=True) if end[0] or "Traceback" in end[1]]
    assert not wrong, wrong
    for name in ("results/estimates.h5", "results/report.html", "map.json", "line/units.parquet", "twin.h5"):
        assert (folder / name).is_file(), name
    assert not list(folder.glob("*.partial")) + list(folder.glob("**/*.new")) + list(folder.glob("**/*.lock"))
