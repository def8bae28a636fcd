"""Short examples of the gallery: what their pictures say is so, and every picture is there and small."""

import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from example_modules import importable

import driftlab

ROOT = Path(__file__).parents[2]
PPM, DEG_H = 1e-6, np.pi / 180 / 3600


@pytest.fixture
def example(request):
    with importable(ROOT / "examples" / request.param):
        import run

        yield run


class Planned(dict):
    """The plan of the example as `driftlab plan` makes it: the search takes ten seconds, and has tests of its own."""

    headline = "ramps once up and down, 1 K/min, 27 min at the ends"


@pytest.mark.parametrize("example", ["07_planned_soak"], indirect=True)
def test_a_planned_soak_leaves_less_error_than_a_staircase_of_the_same_hours(example, tmp_path, monkeypatch):
    knots = np.array([0.0, 1350.0, 2958.0, 7071.0, 8679.0, 12792.0, 14400.0]), [25, -20, -20, 50, 50, -20, -20]
    plan = Planned(time=knots[0], set_point=knots[1], temperature=np.array([-20, 50]), sigma=np.full((2, 3), 7e-6))
    monkeypatch.setattr(driftlab, "plan", lambda *_, **__: plan)
    rms = example.main(2, tmp_path)
    assert rms["planned"] < 0.7 * rms["staircase"]
    assert (tmp_path / "planned_soak.png").stat().st_size > 10_000


@pytest.mark.parametrize("example", ["08_voltage_reference"], indirect=True)
def test_the_curve_of_a_reference_is_that_of_its_log_and_its_memory_is_left_open(example, tmp_path):
    fitted = example.main(tmp_path)
    log = pl.read_csv(example.DATA)
    T, x = log["temp"].to_numpy(), log["x"].to_numpy()
    grid = np.linspace(*fitted.map.domain, 50)
    apart = fitted.map.bias(grid)[:, 0] / PPM - np.polyval(np.polyfit(T, x, 3), grid)
    assert np.std(apart) < 0.05
    assert fitted.summary["judged"]["memory"]["answer"] == "undecided"
    assert (tmp_path / "voltage_reference.png").stat().st_size > 10_000


@pytest.mark.parametrize("example", ["09_hysteresis"], indirect=True)
def test_a_hysteresis_is_found_in_one_soak_with_its_size_and_none_where_there_is_none(example, tmp_path):
    has, has_none = (fitted.summary["judged"]["memory"] for fitted in example.main(tmp_path).values())
    assert (has["answer"], has["kinds"], has_none["answer"]) == ("seen", ["hysteresis"], "none")
    # 4 K of play at 6 deg/h/K
    assert np.all(np.abs(np.abs(has["size"]) - 24 * DEG_H) < 3 * np.array(has["sigma"]))
    assert (tmp_path / "hysteresis.png").stat().st_size > 10_000


@pytest.mark.parametrize("example", ["11_turntable"], indirect=True)
def test_scale_factors_that_are_tracked_are_those_of_a_joint_solution(example, tmp_path):
    last, joint, sigma, z = example.main(tmp_path)
    assert np.max(np.abs(last - joint) / sigma) < 1e-6
    assert np.mean(np.abs(z[27:]) < 2) > 0.9  # it drifts by steps of the walk's size, and no random walk
    assert (tmp_path / "turntable.png").stat().st_size > 10_000


def test_every_picture_of_the_gallery_is_small_and_its_command_exists():
    text = (ROOT / "docs" / "gallery.md").read_text()
    pictures = re.findall(r"!\[[^]]+\]\((images/\w+\.png)\)", text)
    commands = re.findall(r"^    make (\w+)\n.*?\| takes \| [^\n]*`(\S+\.py)` \|$", text, re.MULTILINE | re.DOTALL)
    makefile = (ROOT / "Makefile").read_text()
    assert len(pictures) == len(commands) == 9
    assert all((ROOT / "docs" / picture).stat().st_size < 80_000 for picture in pictures)
    assert all(f"\n{target}: $(VENV)/ready\n\t$(VENV)/bin/python {script}\n" in makefile for target, script in commands)
