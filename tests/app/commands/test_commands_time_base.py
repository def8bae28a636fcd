"""One time base: what a message says of a moment is what `PATH::START:STOP` takes."""

import json
import re

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner
from units_at_rest import unit_at_rest

from driftlab.cli import app
from fusion_core.errors import OutsideDomain, TimeBackwards
from fusion_plugins.thermal_maps.polynomial import Polynomial

FIRST_ROW = 1.76e9
CONFIG = """
extends: mems_crs05
source:
  kind: hdf5
  channels:
    time:        {path: time, unit: s}
    gyro:        {path: gyro, unit: rad/s}
    accel:       {path: accel, unit: m/s^2}
    temperature: {path: temperature, unit: degC}
filter:
  align: 20 s
  gyro: {bias: {kind: random_walk, walk: 1.5e-4 deg/s/sqrt(s)}}
"""
STUCK, SHAKEN, BACK = 100.0, 150.0, 180.0  # s from the first row


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A recording with the time of day, on which each thing happens at a known second."""
    folder = tmp_path_factory.mktemp("bench")
    unit = unit_at_rest(seconds=200, rate=50, temperature=lambda t: 20 + t / 20)
    t, gyro = unit.t - unit.t[0], unit.gyro.copy()
    gyro[(t >= STUCK) & (t < STUCK + 4), 1] = gyro[np.searchsorted(t, STUCK), 1]
    gyro[(t >= SHAKEN) & (t < SHAKEN + 2), 0] += 0.1
    for name, times in (("unit.h5", t), ("back.h5", np.where(t < BACK, t, t - 20))):
        with h5py.File(folder / name, "w") as file:
            file["time"], file["gyro"] = FIRST_ROW + times, gyro
            file["accel"], file["temperature"] = unit.accel, unit.temperature
    (folder / "unit.yaml").write_text(CONFIG)
    return folder


def driftlab(*args):
    return CliRunner().invoke(app, [str(arg) for arg in args])


def run(folder, recording="unit.h5", **more):
    done = driftlab("run", folder / "unit.yaml", "--input", folder / recording, "--out", folder / "out")
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("part", ["", "::5:", "::90:"])
def test_notes_count_from_the_first_row_of_the_file_also_where_a_part_of_it_is_read(bench, part):
    said = run(bench, f"unit.h5{part}")
    stuck = re.search(r"gyro is stuck, left out: \d+ \(first y at ([\d.]+) s \(t = (\d+\.\d+) s in the file\)", said)
    assert float(stuck[1]) == pytest.approx(STUCK + 99 / 50, abs=0.03)
    assert float(stuck[2]) - float(stuck[1]) == pytest.approx(FIRST_ROW, abs=2e-3)
    moved = re.search(r"motion, not used: .* \(first at ([\d.]+) s \(t = (\d+\.\d+) s in the file\)\)", said)
    assert float(moved[1]) == pytest.approx(SHAKEN, abs=0.2)


def test_a_run_says_to_programs_when_the_first_row_was(bench):
    run(bench, "unit.h5::5:")
    summary = json.loads((bench / "out" / "summary.json").read_text())
    assert summary["t"]["first_row_s"] == FIRST_ROW
    assert summary["t"]["start_s"] == pytest.approx(FIRST_ROW + 5, abs=0.2)
    with h5py.File(bench / "out" / "estimates.h5") as file:
        assert file["t"].attrs["first_row"] == FIRST_ROW
        assert file["t"][0] == summary["t"]["start_s"], "the file's own seconds"


def test_figures_begin_where_the_part_does(bench):
    run(bench, "unit.h5::100:")
    page = (bench / "out" / "report.html").read_text()
    assert "aligned at 120." in page
    assert "time from the first row [s]" in page
    charts = re.findall(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)
    drawn = json.loads(charts[0])
    assert drawn["label"] == "time from the first row [s]"
    assert min(t[0] for t in drawn["x"]) == pytest.approx(100, abs=0.3)


def test_time_that_runs_backwards_is_cut_where_the_message_says(bench):
    for part in ("", "::10:"):
        done = driftlab("run", bench / "unit.yaml", "--input", f"{bench / 'back.h5'}{part}", "--out", bench / "out")
        assert isinstance(done.exception, TimeBackwards)
        where = re.search(
            r"at ([\d.]+) s \(t = ([\d.]+) s in the file\); .* before that: \S+?(::\d*:[\d.]+)$", str(done.exception)
        )
        assert float(where[1]) == pytest.approx(BACK - 20, abs=0.01)
        run(bench, f"back.h5{where[3]}")


def test_temperature_outside_a_map_is_cut_where_the_message_says(bench):
    T = np.linspace(18, 26, 4000)
    Polynomial(order=1).fit(T, np.outer(T, np.ones(3)) * 1e-5, {"channel": "gyro", "unit": "rad/s"}).save(
        bench / "map.json"
    )
    config = CONFIG.replace("gyro: {bias", "gyro: {calibration: {kind: polynomial, path: map.json}, bias")
    (bench / "mapped.yaml").write_text(config)
    done = driftlab("run", bench / "mapped.yaml", "--input", bench / "unit.h5", "--out", bench / "out")
    assert isinstance(done.exception, OutsideDomain)
    at, own = re.search(r"°C at ([\d.]+) s \(t = ([\d.]+) s in the file\) is outside", str(done.exception)).groups()
    assert float(at) == pytest.approx(120.0, abs=0.3), "20 + t / 20 degC = 26 degC"
    assert float(own) - float(at) == pytest.approx(FIRST_ROW, abs=2e-3)
    part = f"{bench / 'unit.h5'}::0:{float(at) - 1}"
    assert driftlab("run", bench / "mapped.yaml", "--input", part, "--out", bench / "out").exit_code == 0
