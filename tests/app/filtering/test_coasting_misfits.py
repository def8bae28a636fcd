"""A model that does not fit is scored as it is: against the true bias, over every epoch at rest."""

import re

import numpy as np
import pytest
from days_at_rest import DEG_H, config, day, fitted, run_over, temperature, true_rms
from epochs_at_rest import ACCEL_NOISE, G

from driftlab.evaluation.summary import remarks, summarise

FOG = {"noise": "0.012 deg/sqrt(h)", "walk": "1e-4 deg/h/sqrt(s)"}
MISFITS = {
    "a cubic on a bend": {"of_map": "polynomial"},
    "a walk 10 times too small": {"walk": "0.05 deg/h/sqrt(s)", "unit": {"walk": 0.5 * DEG_H}},
    "noise 5 times too small": {"noise": "0.636 deg/h/sqrt(Hz)", "walk": "0.005 deg/h/sqrt(s)"},
    "a FOG's config": {**FOG, "of_map": "polynomial"},
    "a FOG's config without a map": FOG,
}


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    return {kind: fitted(folder, kind) for kind in ("polynomial", "spline")}


def judged(misfit, maps, seed=0):
    settings = dict(MISFITS[misfit])
    chunk, truth = day(seed, **settings.pop("unit", {}))
    if "of_map" in settings:
        settings["of_map"] = maps[settings["of_map"]]
    return truth, run_over(config(**settings), chunk)


@pytest.mark.parametrize("misfit", MISFITS)
def test_a_misfit_is_scored_against_the_truth_over_all_epochs(misfit, maps):
    truth, (run, columns) = judged(misfit, maps)
    found = run.yardsticks
    np.testing.assert_allclose(found.filter_whole, true_rms(columns, "bias", truth), rtol=0.1)
    np.testing.assert_allclose(found.coast["to the end"], true_rms(columns, "coast", truth), rtol=0.1)
    assert found.share["whole"] == pytest.approx(1.0)
    assert found.moved == 0.0
    assert run.journal.moving.spans == []
    # what the filter refused is where it is worst: scored by what it used, it would look twice as good
    used = np.isfinite(columns["coast"][:, 0]) & columns["used"]
    agreed = np.sqrt(np.mean((columns["bias"] - truth)[used] ** 2, axis=0))
    if misfit != "a cubic on a bend":
        assert agreed[0] < 0.6 * found.filter_whole[0]


def test_the_worse_model_has_the_worse_score(maps):
    """A cubic on a bend is worse than a spline, and a declared noise that is wrong besides is worse again."""
    chunk, _ = day(0)
    scores = []
    for settings in (
        {"of_map": maps["spline"]},
        {"of_map": maps["polynomial"]},
        {"of_map": maps["polynomial"], "walk": "0.005 deg/h/sqrt(s)"},
        {**FOG, "of_map": maps["polynomial"]},
        FOG,
    ):
        run, _ = run_over(config(**settings), chunk)
        scores.append(run.yardsticks.filter_whole[0])
    assert 10 * scores[0] < scores[1] < min(scores[2:])


def test_what_was_refused_at_rest_is_said_to_be_no_motion(maps):
    _, (run, _) = judged("a FOG's config", maps)
    summary = summarise(run)
    assert summary["motion_s"] == []
    assert summary["refused_s"]
    assert summary["refused_axes"][0] == "gyro x"
    (line,) = [line for line in remarks(run) if line.startswith("refused")]
    assert line.startswith("refused although the unit stood still: ")
    assert "because of gyro x" in line
    assert "its map, walk or noise is wrong. The scores count it all the same" in line


def test_an_accelerometer_that_drifts_with_temperature_is_said_to_look_like_that(maps):
    """1 mg/K at 1 K/min on x: 1.6e-4 m/s^2 a second, where the walk of the config allows 5e-7."""
    chunk, _ = day(0, seconds=3600)
    drift = 1e-3 * G * (temperature(chunk.t) - 15.0)
    chunk = chunk.having(accel=chunk["accel"] + drift[:, None] * [1, 0, 0])
    accel = {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "5e-7 m/s^2/sqrt(s)"}}
    run, _ = run_over(config(of_map=maps["spline"], accel=accel), chunk)
    summary = summarise(run)
    assert summary["motion_s"] == []
    assert summary["refused_axes"] == ["accel x"]
    assert summary["temperature_swing_K"] == pytest.approx(25.0, abs=0.5)
    (line,) = [line for line in remarks(run) if line.startswith("refused")]
    assert "because of accel x; that looks like an accelerometer whose bias drifts" in line
    assert "while the temperature moved by 25" in line
    assert "raise filter.accel.bias.walk, or write `accel: null` under filter" in line


@pytest.mark.parametrize(("axis", "channel", "size"), [("y", "gyro", 5e-3), ("x", "accel", 60 * ACCEL_NOISE)])
def test_motion_names_its_sensor_and_axis(axis, channel, size, maps):
    chunk, _ = day(0, seconds=1500)
    moved = (chunk.t > 700) & (chunk.t <= 720)
    values = chunk[channel].copy()
    values[moved, "xyz".index(axis)] += size * np.where(np.arange(np.sum(moved)) % 2, 1, -1)
    run, columns = run_over(config(of_map=maps["spline"]), chunk.having(**{channel: values}))
    summary = summarise(run)
    assert summary["motion_axes"] == [f"{channel} {axis}"]
    (line,) = [line for line in remarks(run) if line.startswith("motion")]
    assert line.endswith(f"(first at t = 701.0 s), seen by {channel} {axis}")
    ((start, stop),) = summary["motion_s"]
    assert start == 701.0
    assert 720 <= stop <= 725
    assert np.sum(~columns["still"]) == stop - start + 1
    assert summary["share"]["moved"] == pytest.approx((stop - start + 1) / (1500 - summary["t"]["aligned_s"]))


def test_a_unit_that_was_turned_was_turned_and_has_no_drifting_accelerometer(maps):
    """Until it is aligned anew it is refused, also once it is still: that needs no other reason."""
    chunk, _ = day(0, seconds=900)
    values = chunk["gyro"].copy()
    moved = (chunk.t > 300) & (chunk.t <= 320)
    values[moved] += 0.02 * np.sin(3 * chunk.t[moved])[:, None]
    force = np.where((chunk.t > 320)[:, None], chunk["accel"][:, [0, 2, 1]], chunk["accel"])
    run, _ = run_over(config(of_map=maps["spline"]), chunk.having(gyro=values, accel=force))
    summary = summarise(run)
    ((start, stop),) = summary["motion_s"]
    assert start == 301.0
    assert stop == pytest.approx(380, abs=2)
    assert [line.split(":")[0].split(" at t")[0] for line in remarks(run)] == [
        "motion, not used",
        "aligned again",
    ]


@pytest.mark.parametrize(("gaps", "moving"), [(0.5, 0.0), (0.0, 0.3), (0.2, 0.2), (0.05, 0.0)])
def test_a_score_that_stands_on_little_says_why(gaps, moving, maps):
    """In each 200 s after the alignment it rests, is shaken, and is not recorded."""
    chunk, _ = day(0, seconds=3060)
    phase = (chunk.t - 61) % 200 / 200
    shaken = (chunk.t > 61) & (phase > 1 - moving - gaps) & (phase <= 1 - gaps)
    sign = np.where(np.arange(len(chunk)) % 2, 1.0, -1.0)
    chunk = chunk.having(gyro=chunk["gyro"] + (shaken * sign)[:, None] * [0.02, 0, 0])
    chunk = chunk.where((chunk.t <= 61) | (phase <= 1 - gaps))
    run, _ = run_over(config(of_map=maps["spline"]), chunk)
    lines = [line for line in remarks(run) if line.startswith("the scores")]
    if gaps + moving < 0.1:
        assert lines == []
        return
    (line,) = lines
    pattern = (
        r"the scores stand on (\d+) % of the time after the alignment \((.*)\); in between the error is taken to go"
    )
    share, why = re.match(pattern, line).groups()
    assert int(share) == pytest.approx(100 * (1 - gaps - moving), abs=4)
    parts = {what: int(part) for part, what in re.findall(r"(\d+) % (\w+)", why)}
    expected = {what: 100 * part for what, part in (("gaps", gaps), ("motion", moving)) if part}
    assert parts == {what: pytest.approx(part, abs=4) for what, part in expected.items()}
