"""The remarks on a run."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from units_at_rest import UNITS, unit_at_rest

import driftlab
from driftlab.config import Config
from driftlab.evaluation.overview import Overview, ScoredRun
from driftlab.evaluation.scores import HORIZONS, ScoreAccumulator, Scores
from driftlab.evaluation.summary import FAR_OFF, jumps, remarks
from driftlab.filtering.segment import RunLog
from fusion_core.consistency import NisTest, VarianceRatio
from fusion_core.contracts import Alignment
from fusion_core.faults import Faults
from fusion_plugins.measurement_models.zupt import Zupt

MODEL, ONES = Zupt.examples()[0], np.ones(3)
SCORES = Scores(
    ("x", "y", "z"), ONES, ONES, {**dict.fromkeys(HORIZONS, ONES), "10 min": np.full(3, np.nan)},
    dict.fromkeys(HORIZONS, ONES), dict.fromkeys(HORIZONS, 0.0),
    {**dict.fromkeys(("first 30 s", "whole", *HORIZONS), 1.0), "10 min": 0.9}, 0.0,
)  # fmt: skip
QUIET = Overview(
    count=6000, used=5990, start=0.0, end=600.0 - 1e-6, first_row=0.0, bias=ONES, sigma=ONES, deviations=(ONES, ONES),
    yardsticks=SCORES,
    nis=NisTest(1.005, 0.99, 1.01), whiteness_p=ONES, slow=VarianceRatio(ONES, ONES, ONES, ONES), curves={}, errors={},
    nis_curve=np.zeros((0, 3)), nis_highest=0.0, swing=0.0,
)  # fmt: skip


def alignment(t, ratio=ONES):
    return Alignment(t, 0.1, {}, {sensor.channel: ratio for sensor in MODEL.sensors}, ONES)


def journal(*again, ratio=ONES):
    alignments = [alignment(60.0, ratio), *map(alignment, again)]
    return RunLog(Faults(first_row=0.0), alignments)


def nis(mean):
    return NisTest(mean, 0.99, 1.01)


def said(overview, log):
    return remarks(ScoredRun(Config(), MODEL, log, overview, None))


def test_bounds_that_only_a_long_run_can_miss_are_no_news():
    assert said(replace(QUIET, nis=nis(1.03)), journal()) == []


def test_innovations_that_add_up_say_by_how_much_sigma_is_too_small():
    """An error of twice its sigma is 4 sigma^2 tau / N^2 of an innovation's square, of which 3 are too much."""
    noise, tau = MODEL.tracked.noise, 0.1
    excess = 3 * ONES**2 * tau / noise**2
    adding = replace(QUIET, slow=VarianceRatio(1 + 100 * excess, np.full(3, 100.0), np.array([1e-9, 0.5, 1e-9]), ONES))
    (line,) = said(adding, journal())
    assert line.startswith("innovations of gyro x, gyro z add up: over 10 s gyro x has ")
    assert "its sigma is about 2 times too small; measure the walk with `driftlab allan`" in line


def test_what_the_deviations_have_of_the_thermometer_adds_up_and_is_no_walk():
    excess = 3 * ONES**2 * 0.1 / MODEL.tracked.noise**2
    slow = VarianceRatio(1 + 100 * excess, np.full(3, 100.0), np.full(3, 1e-9), ONES)
    adding = replace(QUIET, slow=slow, deviations=(ONES, 2 * ONES))
    assert said(adding, journal()) == []


def test_noise_that_is_declared_far_too_large_makes_no_sigma_too_small():
    """Innovations of a ninth of the square that the model says: the error is a third of what they add up to."""
    excess = 3 * ONES**2 * 0.1 / MODEL.tracked.noise**2
    slow = VarianceRatio(1 + 100 * excess, np.full(3, 100.0), np.full(3, 1e-9), ONES / 9)
    assert said(replace(QUIET, slow=slow), journal()) == []


@pytest.mark.parametrize(("align", "expected"), [(0.5, 0), (60.0, 1)])
def test_noise_of_a_few_updates_is_not_told_from_what_is_declared(align, expected):
    model = MODEL.model_copy(update={"align": align})
    log = journal(ratio=np.array([1.0, 0.43, 1.0]))
    assert len(remarks(ScoredRun(Config(), model, log, QUIET, None))) == expected


def test_a_quiet_run_has_nothing_to_say():
    assert said(QUIET, journal()) == []


@pytest.mark.parametrize(
    ("changes", "log", "expected"),
    [
        ({}, journal(70.5), "aligned again at 70.5 s: still"),
        ({}, journal(70.5, 90.0, 99.0), "aligned again 3 times, first at 70.5 s: still"),
        ({"count": 9, "used": 0}, journal(), "no update was used: nothing is known of the bias"),
        ({"end": 61.0}, journal(), "only 1.0 s after the alignment: too short"),
        ({}, journal(ratio=np.array([1.0, 2.5, 1.0])), "y 2.5); set filter.gyro.noise"),
        (
            {"nis": nis(1.44)},
            journal(),
            "NIS 1.44 per component, 0.99 to 1.01 was expected: innovations are 20 % larger",
        ),
        ({"nis": nis(0.25)}, journal(), "50 % smaller than the model says, so its deviations are too large"),
        ({}, journal(ratio=np.array([1.0, 1.0, 0.001])), "or correct unit and path of source.channels.gyro"),
    ],
)
def test_each_thing_is_said_once(changes, log, expected):
    (line,) = said(replace(QUIET, **changes), log)
    assert expected in line


def test_no_reference_no_heading_error():
    """Without a used sample there is no average to measure against: the error is not known, and not zero."""
    tally, none = ScoreAccumulator(3), np.zeros((400, 3))
    moved = {"t": np.arange(400.0), "tau": np.ones(400), "still": np.zeros(400), "bias": none, "coast": none}
    tally.add({**moved, "rate": none + 1}, np.full((400, 9), np.nan))
    found = tally.yardsticks(np.array([0.0, 0.0, 1.0]), ("x", "y", "z"))
    assert all(np.isnan(value) for value in found.heading.values())
    assert np.all(np.isnan(found.filter_whole))
    assert found.share["whole"] == 0.0
    assert found.moved == pytest.approx(1.0)


def test_a_prediction_far_beyond_its_sigma_is_named_and_one_within_is_not():
    coast = {**SCORES.coast, "to the end": np.array([1.0, 34.0, 2.0])}
    (line,) = said(replace(QUIET, yardsticks=replace(SCORES, coast=coast)), journal())
    assert line.startswith("prediction, to the end: off by gyro y ")
    assert "34 times its sigma" in line
    assert "of the map" not in line  # the config has none
    assert "fit a map of the temperature with driftlab fit-map" in line
    near = {**SCORES.coast, "to the end": np.array([1.0, 3.5, 2.0])}
    assert said(replace(QUIET, yardsticks=replace(SCORES, coast=near)), journal()) == []


def test_one_that_was_aligned_again_as_it_lay_is_judged_and_one_that_was_turned_is_not():
    coast = {**SCORES.coast, "to the end": np.array([1.0, 34.0, 2.0])}
    off = replace(QUIET, yardsticks=replace(SCORES, coast=coast))
    again = journal(90.0)
    lying = [replace(one, inputs={"gyro": np.array([5e-5, 0.0, 5e-5])}) for one in again.alignments]
    again.alignments[:] = lying
    assert [line[:27] for line in said(off, again)] == ["prediction, to the end: off", "aligned again at 90.0 s: st"]
    again.alignments[1:] = [replace(lying[1], inputs={"gyro": np.array([0.0, 5e-5, 5e-5])})]
    assert not any("prediction" in line for line in said(off, again))
    again.alignments[:] = lying
    gone = replace(SCORES, coast=coast, share={**SCORES.share, "whole": 0.95})  # in gaps it may have been turned
    assert not any("prediction" in line for line in said(replace(QUIET, yardsticks=gone), again))
    again.moving.spans.append((70.0, 80.0))
    assert not any("prediction" in line for line in said(off, again))


def test_predictions_that_depend_on_one_another_are_off_by_far_no_more_often_than_one():
    """Mean squares of right deviations, by draws: of one number, of walks, and of walks that all have a part alike."""
    rng, n, tests = np.random.default_rng(0), 40_000, 15
    one = rng.normal(size=(n, 1)) ** 2
    walks = np.cumsum(rng.normal(size=(n, 60)), axis=1) ** 2
    alike = (rng.normal(size=(n, 1)) + rng.normal(size=(n, 30))) ** 2
    ratios = [np.sqrt(np.mean(e2, axis=1) / np.mean(e2)) for e2 in (one, walks, alike)]
    assert all(np.mean(ratio > 2.5) <= 1.2 * np.mean(ratios[0] > 2.5) for ratio in ratios)
    assert tests * 2 * norm.sf(FAR_OFF) < 0.01  # each run: of 5 lengths and 3 axes


TEMPERED = """
latitude: 40.9 deg
heading: 0 deg
filter:
  update_interval: 1 s
  gyro:
    noise: 3.18 deg/h/sqrt(Hz)
    bias: {kind: thermal_derivative, walk: 1.5e-4 deg/s/sqrt(s), map: {kind: polynomial, order: 3, path: map.json}}
  accel: {noise: 0.05 m/s/sqrt(h), bias: {kind: random_walk, walk: 2e-3 m/s/h/sqrt(s)}}
"""


def test_the_deviation_of_all_predictions_is_that_of_runs_that_begin_there(tmp_path):
    """First the temperature stands, then it swings: later predictions have more of the map's error."""
    (tmp_path / "unit.yaml").write_text(TEMPERED)
    soak = unit_at_rest(seconds=1000, rate=5.0, temperature=lambda t: 20 + 10 * np.sin(2 * np.pi * t / 1000), seed=1)
    soak.gyro += 3e-5 * np.sin(soak.temperature * 2)[:, None]  # which a cubic does not follow
    driftlab.fit_map(tmp_path / "unit.yaml", samples(soak), units=UNITS).save(tmp_path / "map.json")
    made = unit_at_rest(seconds=2600, rate=5.0, temperature=lambda t: 20 + 9 * np.sin(np.maximum(t - 800, 0) / 200))
    whole = driftlab.run(tmp_path / "unit.yaml", samples(made), units=UNITS).run
    _, sigma, _ = whole.predictions["all 4 of 10 min"]
    anew = []
    for start in whole.yardsticks.starts + whole.alignment.t - 60:
        part = {name: values[(made.t >= start) & (made.t < start + 662)] for name, values in samples(made).items()}
        anew.append(driftlab.run(tmp_path / "unit.yaml", part, units=UNITS).overview.yardsticks.coast_sigma["10 min"])
    assert sigma == pytest.approx(np.sqrt(np.mean(np.square(anew), axis=0)), rel=0.02)
    assert np.all(sigma > 1.1 * whole.yardsticks.coast_sigma["10 min"])


def samples(made):
    return {"time": made.t, **made.channels()}


def test_the_noise_of_the_reference_is_no_error_of_a_prediction():
    """A mean over 30 s of a sensor that is as loud as declared."""
    loud = np.sqrt(30) * np.ones(3)
    model = MODEL.model_copy(update={"gyro": MODEL.gyro.model_copy(update={"noise": loud})})
    coast = {**SCORES.coast, "to the end": np.array([1.0, 5.0, 2.0])}
    run = ScoredRun(Config(), model, journal(), replace(QUIET, yardsticks=replace(SCORES, coast=coast)), None)
    assert remarks(run) == []


def test_a_score_without_a_value_says_why():
    scores = replace(SCORES, filter_first=np.full(3, np.nan), share={**SCORES.share, "first 30 s": 0.1})
    (line,) = said(replace(QUIET, yardsticks=scores), journal())
    assert line.startswith("no score for first 30 s (10 %)")


def rested_anew(rate, noise=None):
    """Columns of a run at rest over 100 s, refused from 40 s on at readings `rate` (100, 3), aligned anew at 99 s."""
    none = np.zeros((100, 3))
    columns = {
        "t": np.arange(100.0), "tau": np.ones(100), "used": np.arange(100) < 40, "rate": rate, "bias": none,
        "bias_sigma": none + 1e-7,
    }  # fmt: skip
    model = MODEL.model_copy(update={"gyro": MODEL.gyro.model_copy(update={"noise": noise * ONES})}) if noise else MODEL
    return jumps(ScoredRun(Config(), model, journal(99.0), QUIET, None), columns)


def test_a_rest_at_another_rate_that_no_turn_explains_is_a_jump():
    """A turn by 3.4 degrees moves an Earth rate by at most 4e-6 rad/s, one by 1,000 degrees by 1.5e-4."""
    rate = np.zeros((100, 3))
    rate[40:] = [0.0, 1e-3, 0.0]
    (line,) = rested_anew(rate)
    assert line.startswith("gyro y jumped by 206 deg/h before 99.0 s, and no turn explains it: by then the unit had ")
    assert "turned by 3.4° at most" in line


def test_a_yaw_turn_moves_the_earth_rate():
    rate = np.zeros((100, 3))
    rate[40:] = [0.0, 1.4e-4, 0.0]
    rate[40:45, 2] = np.pi / 5
    assert rested_anew(rate, 1e-7) == []
    rate[40:45, 2] = 0.0
    assert rested_anew(rate, 1e-7)


def test_motion_before_the_new_rest_is_no_jump_and_turns_that_undo_each_other_are_turns():
    rate = np.zeros((100, 3))
    rate[40:45, 2], rate[60:65, 2] = np.pi / 10, -np.pi / 10  # there and back, then at rest
    assert rested_anew(rate, 1e-7) == []
    for k, axis in enumerate((0, 1, 0, 1)):  # four quarter turns that add up to nothing, and leave it turned by 120 deg
        rate[40 + k, axis] = np.pi / 2 * (1 if k < 2 else -1)
    rate[65:, 1] = 7e-5
    assert rested_anew(rate, 1e-7) == []


def test_readings_that_are_missing_may_hold_a_turn():
    rate = np.zeros((100, 3))
    rate[40:] = [0.0, 1e-3, 0.0]
    run = ScoredRun(Config(), MODEL, journal(109.0), QUIET, None)
    t = np.arange(100.0) + 10 * (np.arange(100) > 60)
    columns = {"t": t, "tau": np.ones(100), "used": t < 40, "rate": rate, "bias": 0 * rate, "bias_sigma": 0 * rate}
    assert jumps(run, columns) == []
