"""`driftlab plan --after` from a recording to files, and as the function does it."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import driftlab
from driftlab.cli import app

CONFIG = """
filter:
  update_interval: 1 s
  align: 60 s
  gyro:
    noise: 3.2 deg/h/sqrt(Hz)
    bias: {kind: thermal_derivative, walk: 0.1 deg/h/sqrt(s), map: {kind: polynomial, order: 2}}
  accel:
    noise: 0.05 m/s/sqrt(h)
    bias: {kind: random_walk, walk: 1e-6 m/s^2/sqrt(s)}
source:
  kind: hdf5
  channels:
    time: {path: time, unit: s}
    gyro: {path: gyro, unit: rad/s}
    accel: {path: accel, unit: m/s^2}
    temperature: {path: temperature, unit: degC}
"""
CURVES = [{"linear": "1e-3 deg/s/K"}, {"quadratic": "1e-5 deg/s/K^2"}, {"offset": "0.1 deg/s"}]
PROFILE = {"kind": "table", "time": ["0 s", "5400 s"], "temperature": ["0 degC", "30 degC"]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("after")
    (found / "unit.yaml").write_text(CONFIG)
    source = {"kind": "synthetic", "rate": "1 Hz", "duration": "1.5 h", "profile": PROFILE, "gyro": {"curve": CURVES}}
    driftlab.simulate({"source": source}, seed=2, out=found / "first.h5")
    return found


def test_a_recording_becomes_what_is_missing(folder, monkeypatch):
    monkeypatch.chdir(folder)
    asked = ["--hours", "1.5", "--lag", "2 min", "--range", "0..40 degC", "--effects", "hysteresis,thermal_rate"]
    done = CliRunner().invoke(app, ["plan", "unit.yaml", "--after", "first.h5", *asked, "--out", "out"])
    assert done.exit_code == 0, done.output
    said = done.stdout
    assert "were seen, the rest of the range is not known" in said
    assert "so far, hysteresis: not known, temperature has not turned back" in said
    written = json.loads((folder / "out" / "plan.json").read_text())
    assert {item["kind"] for item in written["effects"]} == {"hysteresis", "thermal_rate"}
    assert written["enough"] is None
    rows = np.genfromtxt(folder / "out" / "setpoints.csv", delimiter=",", skip_header=1)
    np.testing.assert_allclose(rows[:, 1], written["profile"]["knots"]["temperature_degC"], atol=1e-3)
    assert "not seen yet" in (folder / "out" / "report.html").read_text()


def test_the_function_says_the_same_of_what_was_seen(folder):
    config = folder / "unit.yaml"
    result = driftlab.plan(config, 1.0, after=str(folder / "first.h5"), lag="2 min", effects=["thermal_rate"])
    fitted = driftlab.fit_map(config, str(folder / "first.h5"))
    T = np.linspace(*fitted.map.domain, 30)
    known = np.interp(T, result.temperature, result.sigma[:, 0])
    np.testing.assert_allclose(known, fitted.map.sigma(T)[:, 0], rtol=0.1)
    assert result.found.recorded.hours == pytest.approx(1.5, rel=0.02)
