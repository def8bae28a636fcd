"""Pages of maps, noise and plans, opened as they are written; those of a run and a comparison have their own tests."""

import json
from functools import cache

import command_line
import pytest
from browsers import assert_drawn_everywhere, assert_fits_on_paper

import driftlab

CONFIG = """
filter:
  update_interval: 1 s
  align: 60 s
  gyro:
    noise: 3.2 deg/h/sqrt(Hz)
    bias: {kind: thermal_derivative, walk: 0.1 deg/h/sqrt(s), map: {kind: MAP}}
  accel:
    noise: 0.05 m/s/sqrt(h)
    bias: {kind: random_walk, walk: 1e-6 m/s^2/sqrt(s)}
serial: SN-1
limits: {noise: 4 deg/h/sqrt(Hz), residual: 5 deg/h}
source:
  kind: hdf5
  channels:
    time: {path: time, unit: s}
    gyro: {path: gyro, unit: rad/s}
    accel: {path: accel, unit: m/s^2}
    temperature: {path: temperature, unit: degC}
"""
SHEET = 688  # CSS pixels of A4 between its margins
HOURS = ["0 s", "1800 s", "3600 s"]
SOAK = {
    "kind": "synthetic",
    "rate": "1 Hz",
    "duration": "1 h",
    "profile": {"kind": "table", "time": HOURS, "temperature": ["0 degC", "40 degC", "0 degC"]},
    "gyro": {"noise": "3.2 deg/h/sqrt(Hz)", "curve": [{"linear": "1e-3 deg/s/K"}] * 3},
}
RANGE = ("--range", "0..40 degC", "--hours", "1.5", "--lag", "2 min", "--effects", "hysteresis,thermal_rate")
PAGES = {
    "allan": (("allan", "unit.yaml", "--input", "soak.h5", "--out", "out"), "out/report.html", 2),
    "map": (("fit-map", "unit.yaml", "--input", "soak.h5", "--out", "map.json"), "map.report.html", 4),
    "kinds": (("fit-map", "unit.yaml", "--input", "soak.h5", "--compare", "--out", "map.json"), "map.report.html", 5),
    "size": (
        ("fit-map", "network.yaml", "--input", "soak.h5", "--select", "--neurons-max", "2", "--out", "map.onnx"),
        "map.report.html",
        4,
    ),
    "plan": (("plan", "unit.yaml", *RANGE, "--out", "out"), "out/report.html", 3),
    "plan after": (("plan", "unit.yaml", *RANGE, "--after", "soak.h5", "--out", "out"), "out/report.html", 2),
}


@pytest.fixture(scope="module")
def soak(tmp_path_factory):
    path = tmp_path_factory.mktemp("soak") / "soak.h5"
    driftlab.simulate({"source": SOAK}, seed=2, out=path)
    return path


@pytest.fixture(scope="module")
def made(soak, tmp_path_factory):
    """Return what a command of PAGES says as JSON, and its page; each is made once."""

    @cache
    def make(kind):
        folder = tmp_path_factory.mktemp("made")
        (folder / "soak.h5").symlink_to(soak)
        (folder / "unit.yaml").write_text(CONFIG.replace("MAP", "polynomial, order: 2"))
        (folder / "network.yaml").write_text(CONFIG.replace("MAP", "onnx_network"))
        arguments, page, _ = PAGES[kind]
        done = command_line.driftlab(*arguments, "--json", cwd=folder)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout), folder / page

    return make


@pytest.mark.parametrize("kind", PAGES)
def test_it_is_drawn_on_every_screen(kind, made, opened):
    _, page = made(kind)
    assert_drawn_everywhere(opened, page, PAGES[kind][2])
    assert_fits_on_paper(opened(page, width=SHEET))


def test_kinds_are_bars_with_their_names(made, opened):
    said, page = made("kinds")
    shown = opened(page)
    bars = shown.locator("ol.bars li")
    names = [row["name"] for row in sorted(said["compare"]["tried"], key=lambda row: row["error"])]
    assert [text.removesuffix(" taken") for text in bars.locator(".name").all_inner_texts()] == names
    assert bars.locator(".name strong").count() == 1
    widths = [bars.nth(k).locator(".bar").bounding_box()["width"] for k in range(len(names))]
    assert widths == sorted(widths)


def test_a_plan_with_more_hours_is_never_worse(made):
    said, _ = made("plan")
    sigma = [point["sigma"] for point in said["pareto"]]
    assert sigma == sorted(sigma, reverse=True)
    # in 1.5 h a second cycle does not fit, and one that is slower suffers more from the walk
    assert said["profile"]["knots"]["time_s"][-1] < 1.5 * 3600
    best = min(point["sigma"] for point in said["pareto"] if point["hours"] <= 1.5)
    assert max(said["profiles"][0]["sigma_rms"].values()) <= 1.05 * best
