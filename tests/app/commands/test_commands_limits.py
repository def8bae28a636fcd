"""Limits as an exit status: `--enforce-limits`."""

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from driftlab.cli import app

UNIT = """
source:
  kind: hdf5
  path: log.h5
  channels: {time: {path: t, unit: s}, r: {path: r, unit: ppm}, temperature: {path: T, unit: degC}}
filter:
  kind: held
  channel: r
  update_interval: 1 s
  align: 1 min
  noise: 1 ppm/sqrt(Hz)
  bias: {kind: thermal_derivative, walk: 1e-3 ppm/sqrt(s), map: {kind: polynomial, order: 1, path: map.json}}
"""


@pytest.fixture
def status(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    t = np.arange(3600.0)
    T = 20 + 10 * np.sin(2 * np.pi * t / 1800)
    with h5py.File("log.h5", "w") as file:
        file["t"], file["T"] = t, T
        file["r"] = 2 * T + np.random.default_rng(0).normal(size=len(t))

    def run(command, limits, *more):
        (tmp_path / "unit.yaml").write_text(UNIT + (f"limits: {{{limits}}}\n" if limits else ""))
        return CliRunner().invoke(app, [command, "unit.yaml", *more]).exit_code

    return run


def test_fit_map_and_run_end_by_the_limits(status):
    kept, beyond, near = "residual: 0.5 ppm", "residual: 0.1 ppm", "residual: 0.19 ppm"
    assert status("fit-map", beyond) == 0  # a result, and no failure
    assert status("fit-map", kept, "--enforce-limits") == 0
    assert status("fit-map", beyond, "--enforce-limits") == 1
    assert status("fit-map", near, "--enforce-limits") == 3
    assert status("fit-map", "residual: 0.5 ppm, noise: 2 ppm/sqrt(Hz)", "--enforce-limits") == 3  # which run measures
    noise = "residual: 0.5 ppm, noise: 2 ppm/sqrt(Hz)"
    assert status("run", noise, "--enforce-limits", "--out", "a") == 0  # the map's file says its residual
    assert status("run", "noise: 0.5 ppm/sqrt(Hz)", "--enforce-limits", "--out", "b", "--json") == 1


def test_allan_ends_by_the_limits(status):
    assert status("allan", "noise: 30 ppm/sqrt(Hz)", "--enforce-limits") == 0
    assert status("allan", "noise: 0.5 ppm/sqrt(Hz)", "--enforce-limits") == 1


def test_nothing_is_enforced_without_limits(status):
    for command in ("run", "fit-map", "allan"):
        assert status(command, "", "--enforce-limits") not in (0, 3)


def test_run_says_each_limit_that_does_not_pass(status):
    assert status("fit-map", "residual: 0.5 ppm") == 0
    status("run", "noise: 0.5 ppm/sqrt(Hz), coast: 5 ppm, residual: 0.5 ppm", "--input", "log.h5::0:300", "--out", "c")
    said = CliRunner().invoke(app, ["run", "unit.yaml", "--input", "log.h5::0:300", "--out", "d"]).stdout.splitlines()
    lines = [line for line in said if line.startswith("  ") and "at most" in line]
    assert any("white noise" in line and ", fail (" in line for line in lines)
    assert any("prediction" in line and ", not measured (" in line for line in lines)
    assert not any(", pass (" in line for line in lines)
