"""`driftlab plan`: what it proposes, writes and refuses, and whether it comes true."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import driftlab
from driftlab.cli import app
from driftlab.commands.inputs import config_of
from driftlab.errors import ConfigError
from driftlab.planning.chamber import Chamber, Profile
from driftlab.planning.request import parse_request, read_hours
from driftlab.planning.search import MIN_COVERAGE, candidates, judge, ranked
from driftlab.planning.unit_model import UnitModel, twin_of

ERRORS = (Path(__file__).parents[3] / "docs" / "reference" / "errors.md").read_text()
WALK = "2.2e-5 deg/s/sqrt(s)"
UNIT = f"""
extends: mems_crs05
filter:
  update_interval: 1 s
  gyro:
    bias: {{kind: thermal_derivative, walk: {WALK}, map: {{kind: polynomial, order: 5}}}}
"""
SMOOTH = {"offset": "0.1 deg/s", "linear": "2e-3 deg/s/K", "quadratic": "-3e-5 deg/s/K^2"}
TWIN = {
    "extends": "unit.yaml",
    "source": {
        "kind": "synthetic",
        "rate": "1 Hz",
        "lag": "5 min",
        "profile": {"kind": "ramp", "low": "-20 degC", "high": "50 degC"},
        "gyro": {"curve": [SMOOTH] * 3},
    },
}
FILES = ["plan.json", "report.html", "setpoints.csv"]


@pytest.fixture(autouse=True)
def bench(tmp_path, monkeypatch):
    (tmp_path / "unit.yaml").write_text(UNIT)
    (tmp_path / "bare.yaml").write_text("latitude: 40.9 deg\n")
    for sensor in ("gyro", "accel"):
        tracked = f"filter: {{track: {sensor}, {sensor}: {{calibration: {{kind: polynomial}}}}}}"
        (tmp_path / f"{sensor}.yaml").write_text(f"extends: mems_crs05\nlatitude: 0 deg\n{tracked}\n")
    wander = "{kind: gauss_markov, sigma: 5 deg/h, tau: 300 s}"
    (tmp_path / "wander.yaml").write_text(f"extends: mems_crs05\nfilter: {{gyro: {{bias: {wander}}}}}\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def planned(what, hours, **given):
    """Plan, and foretell of one effect how small it may be: of all of them that takes longer than all else."""
    return driftlab.plan(what, hours, effects=["thermal_rate"], **given)


@pytest.fixture(scope="module")
def target():
    """A plan of 8 h that is to come to 1 deg/h."""
    return planned(UNIT, 8, range=(-20.0, 50.0), lag="5 min", sigma="1 deg/h")


def run(*args):
    return CliRunner().invoke(app, ["plan", *map(str, args)])


def test_what_it_writes_is_one_plan_and_its_page_shows_it(opened):
    done = run("unit.yaml", "--range", "-20..50 degC", "--hours", "4 h", "--lag", "5 min", "--out", "soak", "--json")
    assert done.exit_code == 0
    printed, held = json.loads(done.stdout), json.loads(Path("soak/plan.json").read_text())
    assert held.pop("written")
    assert printed == held
    assert sorted(path.name for path in Path("soak").iterdir()) == FILES
    assert (held["schema"], held["hours"], held["range"]) == (1, 4.0, [-20.0, 50.0])
    setpoints = pl.read_csv("soak/setpoints.csv")
    assert setpoints.columns == ["time [s]", "temperature [degC]"]
    np.testing.assert_allclose(setpoints["time [s]"], held["profile"]["knots"]["time_s"], atol=0.06)
    assert setpoints["time [s]"][-1] == pytest.approx(4 * 3600)
    best, *others = held["profiles"]
    assert best["name"] == held["profile"]["name"]
    assert max(best["sigma_rms"].values()) <= 1.05 * min(max(item["sigma_rms"].values()) for item in others)
    assert held["expected_sigma"]["unit"] == "rad/s"
    sigma = np.array(held["expected_sigma"]["x"])
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(best["sigma_rms"]["x"])
    hours, values = zip(*((point["hours"], point["sigma"]) for point in held["pareto"]), strict=True)
    assert list(hours) == sorted(hours)
    assert values[-1] < values[0]
    shown = opened(Path("soak/report.html"))
    assert shown.locator("figure.chart").count() == 3
    assert "(chosen)" in shown.locator("table").first.inner_text()
    assert "walk" in shown.locator("ul.remarks").last.inner_text()


def test_a_target_is_reached_and_not_much_sooner(target):
    found = target.found
    assert found.shortest.score <= found.target
    assert found.shortest.share >= MIN_COVERAGE
    less = planned("unit.yaml", 0.9 * found.shortest.profile.hours, range=(-20.0, 50.0), lag="5 min").found
    assert less.chosen.score > found.target


def test_a_plan_is_a_table_over_temperature(target):
    assert len(target.time) != len(target.temperature)
    table = target.to_polars()
    np.testing.assert_array_equal(table["temperature [degC]"], target.temperature)
    np.testing.assert_array_equal(table["sigma_y [rad/s]"], target.sigma[:, 1])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"hours": "0"}, "hours 0: is not a length that can be meant; write hours from"),
        ({"hours": "-3 h"}, "hours -3: is not a length that can be meant; write hours from"),
        ({"hours": "long"}, "hours: 'long' is not a quantity, it begins with 'l' and not with a number; "),
        (
            {"hours": "3 K"},
            "hours: '3 K' cannot be converted to s; write a quantity of that dimension (here e.g. '8 h')",
        ),
        ({"range": (-20.0, 50.0), "lag": "5"}, "lag: '5' has no unit (here e.g. '10 min')"),
        ({"range": (-20.0, 50.0), "rate": "5"}, "rate: '5' has no unit (here e.g. '2 K/min')"),
        ({"range": (-20.0, 50.0), "sigma": "5"}, "sigma: '5' has no unit (here e.g. '3 deg/h')"),
        ({"range": (-20.0, 50.0), "walk": "5"}, "walk: '5' has no unit (here e.g. '0.02 deg/h/sqrt(s)')"),
        ({"hours": None}, "hours None: is not a length"),
        ({"hours": float("nan")}, "hours nan: is not a length"),
        ({"range": "3"}, "range 3: is no range of temperature; write e.g. range='-20..50 degC'"),
        ({"range": (-20.0, 50.0), "sigma": "0 deg/h"}, "sigma 0 deg/h: must be greater than zero; write e.g. sigma='3"),
        ({"range": (-20.0, 50.0), "effects": ["x"]}, "effects x: is no installed effect"),
    ],
)
def test_a_function_speaks_of_its_arguments_and_the_command_of_its_options(given, message):
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        driftlab.plan("unit.yaml", **given)


@pytest.mark.parametrize("text", ["4", "4 h", "240 min", "14400s", 4, 4.0])
def test_hours_are_a_time_with_its_unit_or_a_number_of_hours(text):
    assert read_hours(text) == pytest.approx(4.0, rel=1e-12)


def test_a_walk_asks_for_cycles_and_white_noise_does_not(target):
    calm = planned("unit.yaml", 8, walk="0 deg/s/sqrt(s)", range=(-20.0, 50.0), lag="5 min").found
    walking = target.found
    assert walking.chosen.profile.reversals > 2
    assert walking.classic.score > 4 * walking.chosen.score
    assert calm.classic.score < 1.5 * calm.chosen.score


def test_a_simulated_unit_tells_what_it_is():
    plan = planned(TWIN, 4, kind="spline")
    assert (plan.found.chamber.low, plan.found.chamber.high, plan.found.chamber.lag) == (-20, 50, 300)
    assert "the simulated unit's own" in " ".join(plan.lines())
    np.testing.assert_allclose(plan.found.subject.walk, np.deg2rad(2.2e-5))
    assert plan.sigma.shape == (len(plan.temperature), 3)
    assert len(plan.plot().axes) == 3


def test_a_fitted_map_gives_range_and_curve(bench):
    low, high = driftlab.fit_map(TWIN, out="map.json").map.domain
    named = {"extends": "unit.yaml", "filter": {"gyro": {"bias": {"map": {"path": "map.json"}}}}}
    plan = planned(named, 4, lag="5 min")
    assert (plan.found.chamber.low, plan.found.chamber.high) == pytest.approx((low, high))
    assert "the curve is that of map.json" in " ".join(plan.lines())


def test_what_a_kind_cannot_follow_is_said():
    curves = [{"steps": [{"at": "20 degC", "height": "0.05 deg/s", "width": "1 K"}]}] * 3
    stepped = {**TWIN, "source": {**TWIN["source"], "gyro": {"curve": curves}}}
    lines = planned(stepped, 4).lines()
    assert any("is what kind: polynomial cannot follow of the curve" in line for line in lines)


def soak_of(profile, seed):
    table = {
        "kind": "table",
        "time": [f"{t} s" for t in profile.time.tolist()],
        "temperature": [f"{T} degC" for T in profile.temperature.tolist()],
    }
    return {**TWIN, "source": {**TWIN["source"], "profile": table, "seed": seed}}


def test_a_plan_comes_true():
    """Of simulated soaks of the planned profile, fitted as `fit-map` does; benchmarks/plan.py has all of it."""
    plan = planned(TWIN, 3)
    assert not any("cannot follow of the curve" in line for line in plan.lines())
    grid, inside = plan.temperature[5:-5], slice(5, -5)
    off, said = [], []
    for seed in range(4):
        config = soak_of(plan.found.chosen.profile, seed)
        fitted, twin = driftlab.fit_map(config).map, twin_of(config_of(config))
        T = np.clip(plan.found.chosen.profile.samples(300.0, 5000)[1], *fitted.domain)
        level = np.mean(fitted.bias(T) - twin.curve(T), axis=0)
        off.append(fitted.bias(grid) - twin.curve(grid) - level)
        said.append(np.sqrt(np.mean(fitted.sigma(grid) ** 2)))
    foretold = np.sqrt(np.mean(plan.sigma[inside] ** 2))
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(foretold, rel=0.35)  # of 12 axes
    assert np.median(said) == pytest.approx(foretold, rel=0.15)


def test_half_the_hours_of_the_papers_soak_are_enough():
    """Fontanella et al. 2018, sec. 4: 2.5 h at each 5 K from -20.53 to 48.08 degC, one way."""
    paper = twin_of(config_of({**TWIN, "source": {**TWIN["source"], "profile": {"kind": "soak"}}}))
    long = Profile("the paper's", "staircase", paper.time, paper.temperature)
    chamber, subject = Chamber(-20.53, 48.08, 25.0, 2 / 60, 300.0), UnitModel.of(config_of(TWIN), None, None)
    half = ranked([judge(profile, subject, chamber) for profile in candidates(chamber, long.hours / 2)])[0]
    assert half.score < judge(long, subject, chamber).score / 5


def refusals():
    section = ERRORS[ERRORS.index("## Plans") : ERRORS.index("## The loop")]
    found = re.findall(r"\$ driftlab plan (.*)\n    driftlab: (.*)", section)
    assert len(found) > 8
    return found


@pytest.mark.parametrize(("command", "message"), refusals())
def test_what_cannot_be_meant_is_refused_in_the_words_of_the_reference(command, message):
    done = run(*shlex.split(command))
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception) == message
    assert not Path("soak").exists()


@pytest.mark.parametrize("text", ["-20..50 degC", "-20 degC..50 degC", "-4..122 degF", "253.15..323.15 K"])
def test_a_range_is_written_in_any_unit(text):
    chamber = parse_request(config_of("unit.yaml"), range=text).chamber
    assert (chamber.low, chamber.high) == pytest.approx((-20, 50))


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--range", "0..1e300 degC", "is no temperature that can be"),
        ("--range", "-300..20 degC", "is no temperature that can be"),
        ("--start", "9999 degC", "is no temperature that can be"),
        ("--lag", "1e300 s", "is not a size that can be meant"),
        ("--sigma", "1e-300 deg/h", "is not a size that can be meant"),
        ("--walk", "1e300 deg/h/sqrt(s)", "is not a size that can be meant"),
        ("--rate", "", "is not a quantity"),
        ("--effects", "", "is no installed effect"),
        ("--effects", "nan,", "is no installed effect"),
    ],
)
def test_sizes_that_cannot_be_meant_are_refused(option, value, message):
    found = run("unit.yaml", "--hours", 1, "--range", "0..50 degC", option, value)
    assert isinstance(found.exception, ConfigError)
    assert message in str(found.exception)
