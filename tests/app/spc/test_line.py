"""Charts of a line against published run lengths, changes against planted ones, indices against their coverage."""

import numpy as np
import pytest
from lines import AXES, DEG_H, SPREAD, TYPICAL, line, record

from driftlab.config import Limits
from driftlab.spc.change_points import least_alike, parts, scores, shares, steps
from driftlab.spc.charts import (
    LAMBDA,
    SIGMAS,
    InControl,
    L,
    ewma,
    ewma_limit,
    in_control,
    scale_of,
)
from driftlab.spc.line import baseline_of, line_of

LIMITS = Limits.model_validate({"noise": "2.5 deg/h/sqrt(Hz)", "residual": "1 deg/h", "bias_instability": "1 deg/h"})


def run_length(out):
    """Return the mean place of the first alarm in rows of alarms, each of which has one."""
    assert np.all(out.any(axis=1))
    return float(np.mean(np.argmax(out, axis=1) + 1))


# Montgomery, Introduction to Statistical Quality Control, 7th ed., table 9.11 (lambda 0.2, L 2.962), and 1 / P(|z| > 3)
@pytest.mark.parametrize(
    ("shift", "of_ewma", "of_shewhart"), [(0.0, 500.0, 370.4), (0.5, 41.8, 155.2), (1.0, 10.5, 43.9), (2.0, 3.7, 6.3)]
)
def test_charts_run_as_long_as_the_tables_say(shift, of_ewma, of_shewhart):
    rng = np.random.default_rng(4)
    runs = 1000 if shift == 0 else 3000
    z = shift + rng.normal(size=(runs, round(10 * of_shewhart)))  # beyond that is one of 22,000
    far = np.full((runs, 40), 100.0)  # every run ends
    assert run_length(np.abs(np.hstack([z, far])) > SIGMAS) == pytest.approx(of_shewhart, rel=0.08)
    w = ewma(np.hstack([z, far]), most=np.inf)
    settled, n = L * np.sqrt(LAMBDA / (2 - LAMBDA)), w.shape[1]
    assert run_length(np.abs(w) > settled) == pytest.approx(of_ewma, rel=0.08)
    used = run_length(np.abs(ewma(np.hstack([z, far]))) > ewma_limit(n))  # narrow at first, and no unit counts to more
    assert used == pytest.approx(530, rel=0.08) if shift == 0 else 0.7 * of_ewma < used < 1.05 * of_ewma


def test_neither_odd_units_nor_a_shift_widen_the_limits():
    rng = np.random.default_rng(1)
    spoilt, centres = [], []
    for _ in range(60):
        x = rng.normal(size=200)
        x[rng.choice(200, 10, replace=False)] += 10
        x[150:] += 2
        law = in_control(x, np.zeros(200))
        spoilt.append(law.spread)
        centres.append(in_control(x[:150], np.zeros(150)).centre)
    assert np.mean(spoilt) == pytest.approx(1.0, abs=0.06)
    assert np.mean(centres) == pytest.approx(0.0, abs=0.12)


def test_what_units_are_measured_with_is_not_their_spread():
    rng = np.random.default_rng(2)
    own = np.where(np.arange(300) % 3 == 0, 3.0, 0.3)
    found = [in_control(50 + rng.normal(size=300) + own * rng.normal(size=300), own) for _ in range(60)]
    assert np.mean([law.spread for law in found]) == pytest.approx(1.0, abs=0.06)
    assert np.mean([law.centre for law in found]) == pytest.approx(50.0, abs=0.05)
    boasting = in_control(
        rng.normal(size=300), np.full(300, 2.0)
    )  # units that claim to be measured worse than they are
    assert boasting.sigma(np.array([2.0]))[0] == pytest.approx(1.0, abs=0.2)


def test_limits_that_are_estimated_give_the_alarms_of_a_line_in_control():
    found = [line_of(line(200, seed, sigma=0.05), None) for seed in range(6)]
    beyond = np.concatenate([chart.beyond for one in found for chart in one.controls])
    assert len(beyond) == 6 * 15 * 200
    assert 0.0015 < np.mean(beyond) < 0.0045  # 0.0027 where the limits are known


def test_a_statistic_is_the_gain_of_a_step_by_least_squares():
    rng = np.random.default_rng(3)
    z, a, k = rng.normal(size=30), rng.uniform(0.3, 1, size=30), np.arange(30)
    y, of = scores(z), parts(30, [(3, 11)])
    assert {(0, 12), (3, 11)} <= set(map(tuple, of.tolist()))
    mean = a * (a @ y) / (a @ a)
    for (i, j), found in zip(of, shares(z, a, of), strict=True):
        X = np.column_stack([a, a * ((i <= k) & (k < j))])
        left = float(np.sum((y - X @ np.linalg.lstsq(X, y, rcond=None)[0]) ** 2))
        assert found == pytest.approx((float(np.sum((y - mean) ** 2)) - left) / float(y @ y))


@pytest.mark.parametrize(("n", "draws"), [(27, 2000), (150, 1000)])
def test_the_price_of_looking_everywhere_is_at_least_what_looking_everywhere_finds(n, draws):
    rng = np.random.default_rng(5)
    values = np.exp(3 * rng.normal(size=(draws, n)))  # whatever the law is
    p = np.array([least_alike(z, np.ones(n))[2] for z in values])
    for share in (0.2, 0.05):
        assert share / 10 < np.mean(p <= share) <= share + 2 * np.sqrt(share / draws)


@pytest.mark.parametrize("law", ["normal", "heavy", "skew"])
def test_clean_lines_show_one_change_in_twenty_at_most(law):
    lines = [line_of(line(100, seed, law=law), None) for seed in range(16)]
    changed = sum(any(chart.changes for chart in one.controls) for one in lines)
    assert changed <= 3  # of 16 lines with 0.05 each, P(4 or more) = 0.007


def test_a_shift_is_found_within_ten_units():
    places, held = [], []
    for seed in range(20):
        at = 60 + 4 * seed
        got = line_of(line(200, seed, planted=[("noise", "x", at, 200, 1.0)]), None)
        chart = next(chart for chart in got.controls if (chart.quantity, chart.axis) == ("noise", "x"))
        places += [change.at - at for change in chart.changes[:1]]
        held += [change.low <= at <= change.high for change in chart.changes[:1]]
    assert len(places) >= 17
    assert np.mean(np.abs(places) <= 10) >= 0.85
    assert np.mean(held) >= 0.85  # 95 %, of 20


def test_a_lot_that_is_shifted_has_a_beginning_and_an_end():
    for seed in range(3):
        found = line_of(line(200, seed, planted=[("swing", "y", 80, 100, 2.5)]), None)
        changes = [
            c for chart in found.controls if (chart.quantity, chart.axis) == ("swing", "y") for c in chart.changes
        ]
        assert [c.after > c.before for c in changes] == [True, False]
        assert changes[0].at == pytest.approx(80, abs=10)
        assert changes[1].at == pytest.approx(100, abs=10)
        chart = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("swing", "y"))
        assert [lot.name for lot in chart.lots if lot.out] == ["L04"]


def test_odd_units_are_no_change_of_the_line():
    records = line(200, 7, planted=[("noise", "x", k, k + 1, 12.0) for k in (20, 21, 90, 91, 92, 150)])
    found = line_of(records, None)
    assert not any(chart.changes for chart in found.controls)
    chart = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    assert set(chart.at[chart.beyond]) >= {20, 21, 90, 91, 92, 150}
    assert not chart.drifting[40:80].any()


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_steady_drift_is_a_trend_and_a_step_is_none(seed):
    """Four deviations over 200 units, one at a time; and one step of two."""
    drift = [("noise", "x", k, k + 1, 4 * k / 200) for k in range(200)]
    for planted, trends in ((drift, True), ([("noise", "x", 90, 200, 2.0)], False)):
        found = line_of(line(200, seed, planted=planted), None)
        chart = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("noise", "x"))
        assert (chart.trend is not None) == trends
        assert bool(chart.changes) != trends
        said = [sentence for sentence in found.sentences if sentence.startswith("x noise rose")]
        assert len(said) == 1
        assert ("a trend, no step" in said[0]) == trends
        assert not any(sentence.startswith("No change") for sentence in found.sentences)
        if chart.trend is not None:
            wide = np.log(chart.trend.after / chart.trend.before) / SPREAD["noise"]
            assert wide == pytest.approx(4, abs=1)


def test_the_change_is_said_with_its_unit_date_and_lot():
    spreads = np.log(1.3) / SPREAD["noise"]
    found = line_of(line(200, 3, planted=[("noise", "x", 121, 200, spreads)]), LIMITS)
    chart = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    (change,) = chart.changes
    k = change.at
    share = 100 * (change.after / change.before - 1)
    assert share == pytest.approx(30, abs=4 * 100 * change.error)
    assert found.sentences[0].startswith(
        f"x noise rose by {share:.0f} % from unit {k:04d} ({found.dates[k]}, lot {found.lots[k]}) on"
    )
    assert chart.basis[1] == k
    assert chart.centre == pytest.approx(TYPICAL["noise"] * DEG_H, rel=0.05)


def test_the_level_of_the_map_is_watched_where_it_is_given():
    rng = np.random.default_rng(0)
    records = line(120)
    levels = (rng.normal(size=(120, 3)) * 60 - np.array([200, 0, 0]) * (np.arange(120)[:, None] >= 70)) * DEG_H
    found = line_of(records, None, levels=levels)
    (change,) = next(c for c in found.controls if (c.quantity, c.axis) == ("level", "x")).changes
    assert change.at == pytest.approx(70, abs=10)
    assert "x level fell by" in found.sentences[0]
    assert "deg/h from unit" in found.sentences[0]


@pytest.mark.parametrize("count", [1, 3, 40])
def test_levels_are_charted_about_a_family_that_is_known(count):
    """A line that has moved since shows at once, also by few units; by its own units it would be in control."""
    rng, law = np.random.default_rng(1), baseline_of(line_of(line(3), None), [InControl(0.0, 60 * DEG_H)] * 3)
    records = line(count)
    levels = (rng.normal(size=(count, 3)) * 20 + [240, 0, 0]) * DEG_H
    found = line_of(records, None, levels=levels, baseline=law)
    charts = {c.axis: c for c in found.controls if c.quantity == "level"}
    assert all(chart.of_family for chart in charts.values())
    assert np.mean(charts["x"].beyond) > 0.7
    assert charts["x"].drifting[-1] or count == 1
    assert not np.any(charts["y"].beyond)
    assert charts["x"].limits[1] == pytest.approx(180 * DEG_H)
    assert ("Too few units to look for changes of the line." in found.sentences) == (count < 10)
    assert not any(c.of_family for c in found.controls if c.quantity != "level")


def test_units_come_by_date_and_those_of_a_day_as_the_manifest_has_them():
    rows = [("b", "2026-03-02"), ("a", "2026-03-01T10:00:00"), ("c", ""), ("d", "2026-03-01"), ("e", "2026-03-02")]
    figures = {name: np.full(3, 1.0) for name in TYPICAL}
    records = [record(0, figures, unit=unit, date=date) for unit, date in rows]
    records.insert(2, record(0, {}, unit="broken", date="2026-03-01", state="failed", error="no file", axes=()))
    found = line_of(records, None)
    assert found.units == ("d", "a", "c", "b", "e")
    assert "1 without a date" in found.order
    undated = line_of([one.model_copy(update={"date": ""}) for one in records], None)
    assert undated.units == ("b", "a", "c", "d", "e")
    assert "manifest, which has no dates" in undated.order


def test_values_that_are_missing_are_left_out_and_few_are_no_chart():
    records = line(40)
    for k, one in enumerate(records):
        noise = one.figures["noise"]
        none = tuple(None if axis == 1 and k % 2 else v for axis, v in enumerate(noise.value))
        few = tuple(v if k < 9 else None for v in one.figures["walk"].value)
        held = {"noise": noise.model_copy(update={"value": none}), "walk": noise.model_copy(update={"value": few})}
        records[k] = one.model_copy(update={"figures": {**one.figures, **held}})
    found = line_of(records, None)
    assert next(c for c in found.controls if (c.quantity, c.axis) == ("noise", "y")).at.tolist() == list(
        range(0, 40, 2)
    )
    assert found.too_few == ("x walk", "y walk", "z walk")
    assert any("x walk" in said for said in found.sentences)


@pytest.mark.parametrize("records", [[], line(5)])
def test_too_few_units_are_said(records):
    assert line_of(records, LIMITS).sentences == ("Too few units for charts of the line.",)


def test_what_does_not_vary_has_no_alarm():
    figures = {name: np.full(3, 1.0) for name in TYPICAL} | {"walk": np.zeros(3)}
    found = line_of([record(k, figures) for k in range(30)], None)
    assert len(found.controls) == 15
    assert not any(np.any(chart.beyond) or chart.changes for chart in found.controls)


def test_values_are_told_apart_where_they_are_about_normal():
    rng = np.random.default_rng(0)
    z = rng.normal(size=400)
    assert scale_of(np.exp(0.5 * z), size=True).name == "log"
    assert scale_of(100 + 20 * z, size=True).name == "as it is"
    assert scale_of(np.maximum(z, 0) ** 2, size=True).name != "log"  # a walk that does not show is 0
    assert scale_of(np.exp(z), size=False).name == "as it is"


def test_limits_are_judged_in_the_scale_of_the_values_and_by_count():
    found = line_of(line(300, 1), LIMITS)
    assert {row.quantity for row in found.capability} == {"noise", "residual"}  # an Allan floor is no figure of a line
    row = next(row for row in found.capability if (row.quantity, row.axis) == ("noise", "x"))
    true = np.log(2.5 / TYPICAL["noise"]) / (3 * SPREAD["noise"])
    assert row.ppk_low < true < row.ppk_high
    assert row.cpk == pytest.approx(row.ppk, rel=0.15)
    assert row.trusted
    above = sum(one.figures["noise"].value[0] > 2.5 * DEG_H for one in line(300, 1))
    assert row.beyond == above
    assert row.share_low <= above / 300 <= row.share_high


def test_after_a_change_the_limits_are_judged_anew():
    found = line_of(line(200, 3, planted=[("noise", "x", 100, 200, 3.0)]), LIMITS)
    whole, now = (row for row in found.capability if (row.quantity, row.axis) == ("noise", "x"))
    assert whole.since == 0
    assert now.since == pytest.approx(100, abs=5)
    assert (whole.trusted, now.trusted) == (False, True)  # two levels are not normal
    assert now.ppk == pytest.approx((np.log(2.5 / 2) / 0.1 - 3) / 3, abs=0.1)
    assert any(f"since unit {now.since:04d}" in said for said in found.sentences)


def test_steps_of_many_levels_are_all_found():
    rng = np.random.default_rng(8)
    z = rng.normal(size=400) + np.repeat([0, 2, 0, -2], 100)
    assert [step.at for step in steps(z, np.ones(400), 0.003)] == pytest.approx([100, 200, 300], abs=10)


@pytest.mark.parametrize("seed", [143, 147, 254])
def test_steps_that_move_one_another_in_turns_come_to_an_end(seed):
    """Each of these steps, once moved, moves its neighbours back to where they were."""
    rng = np.random.default_rng(seed)
    z = np.repeat(rng.normal(size=10) * 2, 6) + rng.normal(size=60) * rng.choice([0.3, 1.0])
    found = [step.at for step in steps(np.round(z, 1), np.exp(0.5 * rng.normal(size=60)), 0.3)]
    assert 0 < len(found) < 12
    assert found == sorted(set(found))


def test_axes_of_the_charts_are_those_of_the_units():
    assert line_of(line(30), None).axes == AXES
