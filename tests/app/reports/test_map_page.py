"""The page of a fitted map, in a browser and on paper, and where it may lie."""

import json

import h5py
import numpy as np
import pytest
from browsers import colours, drag, overflow, range_of_x
from typer.testing import CliRunner

import driftlab
from driftlab.cli import app
from driftlab.reports.map import axis_chart, chart
from fusion_core.errors import ConfigError

CONFIG = """
serial: CRS-0042
source: {kind: hdf5, channels: {time: {path: time}, gyro: {path: gyro}, temperature: {path: temperature}}}
filter:
  align: 60 s
  update_interval: 1 s
  gyro:
    noise: 3.2 deg/h/sqrt(Hz)
    bias: {kind: thermal_derivative, walk: 0.02 deg/h/sqrt(s), map: {kind: polynomial, order: 3, path: map.json}}
  accel: null
limits: {residual: 5 deg/h, swing: 900 deg/h}
"""
DEG_H = np.deg2rad(1) / 3600


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A soak of 8 h, up and down, with a bend at 31 degC and hysteresis on x."""
    place = tmp_path_factory.mktemp("map")
    (place / "unit.yaml").write_text(CONFIG)
    rng = np.random.default_rng(0)
    N = 7200
    T = np.interp(np.linspace(0, 1, N), [0, 0.5, 1], [-20, 48, -20])
    x = 60 * np.tanh((T - 31) / 3) + 15 * np.sin(np.pi * (T + 20) / 68) * np.sign(np.gradient(T))
    walk = np.cumsum(0.04 * rng.normal(size=(N, 3)), axis=0)
    gyro = DEG_H * (np.stack([x, 0.5 * T, 0.01 * T**2], axis=1) + walk + 1.6 * rng.normal(size=(N, 3)))
    with h5py.File(place / "soak.h5", "w") as file:
        for name, values, unit in (
            ("time", 4.0 * np.arange(N), "s"), ("gyro", gyro, "rad/s"), ("temperature", T, "degC"),
        ):  # fmt: skip
            file[name] = values
            file[name].attrs["unit"] = unit
    return place


@pytest.fixture(scope="module")
def fitted(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(app, ["fit-map", "unit.yaml", "--input", "soak.h5"])
    assert done.exit_code == 0, done.output
    return done.output


def test_the_terminal_says_the_verdict(fitted):
    lines = fitted.splitlines()
    assert "(rms of the samples; white noise alone 1.6" in lines[1]
    assert lines[4].startswith("good to ")
    assert "between -20 and 48 °C (1 sigma, rms over the range: x " in lines[4]
    assert any(line.startswith("hysteresis or lag: up and down differ in x by ") for line in lines)
    bent = next(line for line in lines if "more than a cubic can" in line)
    assert "once it is known why up and down differ, take kind: spline; `driftlab fit-map --compare` tells" in bent
    assert any(line.startswith("  residual of the map, at most 5 deg/h: x ") and "fail" in line for line in lines)
    assert any(line.startswith("  swing of the map") and "pass" in line for line in lines)
    assert lines[-1] == "written to map.json, map.report.html"


def test_the_page_shows_what_was_printed_and_what_it_stands_on(fitted, folder, opened):
    shown = opened(folder / "map.report.html")
    text = shown.locator("body").inner_text()
    for line in fitted.splitlines()[4:]:
        if line.startswith(("good to", "hysteresis", "x bends")):
            assert line.replace("`", "") in text.replace("`", "")
    for what in ("CRS-0042", "soak.h5", "SHA-256", "white noise alone", "FAIL: residual of the map", "time warming"):
        assert what in text
    assert shown.locator("figure.chart").count() == 4  # an axis each, and sigma with the samples
    assert all(colours(shown, k) > 5 for k in range(4))
    assert range_of_x(shown) == pytest.approx([-20, 48], abs=2)
    drag(shown, 0.5, 0.75)
    assert range_of_x(shown)[1] < 40
    assert (folder / "map.report.html").stat().st_size < 500_000


@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_all_of_it(fitted, folder, opened, dark):
    shown = opened(folder / "map.report.html", width=390, dark=dark)
    assert overflow(shown) == 0
    assert colours(shown) > 5


def test_a_page_or_a_map_of_before_is_replaced_and_nothing_else(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config, data = folder / "unit.yaml", str(folder / "soak.h5")
    driftlab.fit_map(config, data, kind="spline", out="a.json", report="why")
    first = (tmp_path / "why" / "report.html").read_text()
    assert not (tmp_path / "a.report.html").exists()
    result = driftlab.fit_map(config, data, out="a.json", report="why")
    assert [path.name for path in result.written] == ["a.json", "report.html"]
    assert (tmp_path / "why" / "report.html").read_text() != first
    (tmp_path / "b.report.html").write_text("<html>my own notes</html>")
    with pytest.raises(ConfigError, match=r"exists, and nothing in it says .* name another folder with report"):
        driftlab.fit_map(config, data, out="b.json")
    assert not (tmp_path / "b.json").exists()
    assert not list(tmp_path.rglob("*.part"))


def test_python_has_the_same_verdict_numbers_and_picture(fitted, folder):
    result = driftlab.fit_map(folder / "unit.yaml", str(folder / "soak.h5"))
    assert all(line in fitted for line in result.lines())
    assert result.summary["verdict"] == result.verdict.sentences(result.unit)
    json.dumps(result.summary, allow_nan=True)
    judged = result.summary["judged"]
    assert judged["sigma"]["rms"] == pytest.approx(np.sqrt(np.mean(result.verdict.sigma**2, axis=0)))
    hours = {"warming": 4.0, "cooling": 4.0, "neither": 0.0}
    assert judged["coverage"]["hours"] == pytest.approx(hours, abs=0.05)
    memory = judged["memory"]
    assert memory["answer"] == "seen"
    assert memory["size"][0] / DEG_H == pytest.approx(30, abs=4 * memory["sigma"][0] / DEG_H)
    assert len(result.plot().axes) == len(chart(result.verdict, result.unit).panels) == 2 * 3 + 2


def test_points_and_curve_of_the_chart_are_the_samples_and_the_map(folder):
    result = driftlab.fit_map(folder / "unit.yaml", str(folder / "soak.h5"))
    above, below = axis_chart(result.verdict, result.unit, 0).panels
    lines = {line.name: line for line in above.lines}
    warming, cooling = lines["warming"], lines["cooling"]
    at = np.linspace(0, 30, 40)
    apart = np.interp(at, warming.x, warming.y) - np.interp(at, cooling.x, cooling.y)
    np.testing.assert_allclose(apart, 30 * np.sin(np.pi * (at + 20) / 68), atol=8)
    left = {line.name: line for line in below.lines}
    np.testing.assert_allclose(
        left["warming"].y, warming.y - result.map.bias(warming.x)[:, 0] * result.unit.factor, rtol=1e-9
    )
