"""Frozen limits: alarms of lines in control whatever their law, planted units, and Hotelling's limit."""

import numpy as np
import pytest
from lines import DEG_H, line, record
from pydantic import ValidationError

from driftlab.family.baseline import Baseline, Together
from driftlab.family.record import Figure
from driftlab.spc.charts import InControl
from driftlab.spc.line import baseline_of, line_of
from driftlab.spc.sentences import alarms

LEVEL = [InControl(0.0, 60 * DEG_H)] * 3


def levels(records, seed):
    return np.random.default_rng(seed).normal(size=(len(records), 3)) * 60 * DEG_H


def frozen(count, seed, **more):
    records = line(count, seed, **more)
    found = line_of(records, None, levels=levels(records, seed))
    return Baseline.model_validate_json(baseline_of(found, LEVEL).model_dump_json())


def values_of(record):
    return {name: figure.value for name, figure in record.figures.items()}


def judged(records, baseline, **more):
    return line_of(records, None, levels=levels(records, 99), baseline=baseline, **more)


# the law of the values is none that the limits assume: t with three degrees of freedom, and an exponential
@pytest.mark.parametrize("law", ["normal", "heavy", "skew"])
def test_a_line_in_control_hardly_alarms_whatever_its_law(law):
    single, joint, values = 0, 0, 0
    for seed in range(3):
        found = judged(line(300, 50 + seed, law=law), frozen(150, seed, law=law))
        single += sum(int(np.sum(chart.beyond)) for chart in found.controls)
        joint += sum(int(np.sum(chart.beyond)) for chart in found.multivariate)
        values += 300
    assert single / (values * 18) < 1 / 120
    assert joint / (values * 3) < 1 / 120


@pytest.mark.parametrize("law", ["normal", "heavy", "skew"])
def test_a_shifted_lot_alarms_against_frozen_limits_and_not_against_its_own(law):
    """All of a day off alike: by its own units that would be the usual."""
    new = line(12, 7, law=law, planted=[("noise", "x", 0, 12, 4 if law == "normal" else 8)])
    found = judged(new, frozen(150, 3, law=law))
    chart = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    assert np.median(chart.z) > 2.5
    assert chart.drifting[-1]
    assert "frozen limits (of 150 units, made from 2026-01-05" in found.sentences[0]
    assert any(one.text.startswith("x noise: the EWMA leaves") for reasons in alarms(found).values() for one in reasons)
    single = np.any(chart.beyond)
    assert ("units are beyond" in found.sentences[0]) == single
    assert ("the line may have moved, x noise" in found.sentences[0]) != single


def test_one_unit_is_enough():
    base = frozen(100, 1)
    (good,), (bad,) = line(1, 4), line(1, 4, planted=[("walk", "z", 0, 1, 9)])
    quiet, found = judged([good], base), judged([bad], base)
    assert not alarms(quiet)
    assert quiet.sentences[0].startswith("None of 18 values of 1 unit is beyond frozen limits")
    assert "half of the units that are off by" in quiet.sentences[0]
    ((place, reasons),) = alarms(found).items()
    assert place == 0
    texts = [one.text for one in reasons]
    assert any(text.startswith("z T-squared") and "(of it walk" in text for text in texts)
    assert any(text.startswith("z walk 0.1") and "deg/h/sqrt(s), limits" in text for text in texts)


def test_limits_of_a_unit_are_the_same_in_whatever_company():
    """Its own uncertainty and what is frozen make them; others that are judged with it do not."""
    rng = np.random.default_rng(8)
    shares = rng.uniform(0.02, 0.4, 120)  # uncertainty of each unit's figures
    units = [
        record(k, values_of(one), "L1", share) for k, (one, share) in enumerate(zip(line(120, 5), shares, strict=True))
    ]
    base = Baseline.model_validate_json(
        baseline_of(line_of(units[:100], None, levels=levels(units[:100], 5)), LEVEL).model_dump_json()
    )
    alone = [judged([unit], base) for unit in units[100:]]
    together = judged(units[100:], base)
    for k, own in enumerate(alone):
        for chart, of_all in zip(own.controls, together.controls, strict=True):
            if chart.quantity != "level":
                assert chart.z[0] == pytest.approx(of_all.z[k], rel=1e-12)
                assert [one[0] for one in chart.limits] == pytest.approx([one[k] for one in of_all.limits], rel=1e-12)


def test_an_ewma_that_came_back_and_an_uneven_lot_are_said():
    new = line(
        40, 6, lots=2, planted=[("noise", "x", 5, 12, 2.5), ("walk", "y", 20, 30, 2.5), ("walk", "y", 30, 40, -2.5)]
    )
    text = " ".join(judged(new, frozen(150, 3)).sentences)
    assert "The EWMA left its limits and came back: " in text
    assert "x noise from 00" in text
    assert "lot L01 y walk deviation" in text


def test_what_goes_together_is_missed_by_single_limits_and_seen_by_t_squared():
    """Residual and noise go together; a unit with more of one and less of the other is within either limit."""
    rng, records = np.random.default_rng(0), []
    for k in range(120):
        common, own = rng.normal(size=3), rng.normal(size=(2, 3))
        values = [2.0 * np.exp(0.1 * (common + 0.2 * one)) * DEG_H for one in own]
        records.append(record(k, {"residual": values[0], "noise": values[1]}))
    base = baseline_of(line_of(records, None), LEVEL)
    odd = {"residual": np.full(3, 2.0 * np.exp(0.2)) * DEG_H, "noise": np.full(3, 2.0 * np.exp(-0.2)) * DEG_H}
    found = line_of([record(0, odd)], None, baseline=base)
    assert not any(np.any(chart.beyond) for chart in found.controls)
    assert all(np.all(chart.beyond) for chart in found.multivariate)
    assert len(found.multivariate) == 3


def test_t_squared_alarms_as_rarely_as_it_says_also_of_few_units():
    """Montgomery 11.3: with the factor of F for a covariance that is estimated; without it one unit in 70 alarms."""
    rng, out, units = np.random.default_rng(2), 0, 0
    mix = np.linalg.cholesky(0.6 + 0.4 * np.eye(4))
    for _ in range(3000):
        known, new = rng.normal(size=(25, 4)) @ mix.T, rng.normal(size=(40, 4)) @ mix.T
        together = Together.of("x", dict(zip("abcd", known.T, strict=True)))
        value, limit, contributions = together.judged(dict(zip("abcd", (new - known.mean(axis=0)).T, strict=True)))
        out += int(np.sum(value > limit))
        units += len(value)
        assert np.all(contributions >= -1e-9)
    assert out / units == pytest.approx(0.0027, rel=0.25)


def test_a_unit_without_a_figure_is_judged_by_the_others():
    rng = np.random.default_rng(1)
    together = Together.of("x", {name: rng.normal(size=50) for name in "abc"})
    z = {"a": np.array([4.5, 4.5, np.nan]), "b": np.array([np.nan, 0.0, np.nan]), "c": np.array([0.0, 0.0, np.nan])}
    value, limit, contributions = together.judged(z)
    assert limit[0] < limit[1]
    assert np.isnan(value[2])
    assert np.isnan(contributions[0, 1])
    assert value[0] > limit[0]


def test_run_rules_are_those_that_were_asked_for():
    records = line(60, 3, planted=[("noise", "y", 30, 60, 1.5)])
    assert not any(chart.patterns for chart in line_of(records, None).controls)
    found = line_of(records, None, rules="nelson")
    said = [one.text for reasons in alarms(found).values() for one in reasons]
    assert any(text.startswith("y noise: 9 units in a row") for text in said)
    base = baseline_of(line_of(line(3), None), LEVEL)
    assert "frozen" not in " ".join(judged(records, base).sentences)


def without_walk(records, which):
    return [
        one.model_copy(update={"figures": {**one.figures, "walk": Figure(value=(0.0,) * 3, sigma=(None,) * 3)}})
        if which(k) else one for k, one in enumerate(records)
    ]  # fmt: skip


def test_a_walk_that_does_not_show_is_no_alarm_and_no_failure():
    """By a frozen logarithm there is no value of 0; of a figure that is mostly 0 no limits are frozen."""
    base = frozen(60, 2)
    found = judged(without_walk(line(12, 5), lambda k: True), base)
    assert not any(chart.quantity == "walk" for chart in found.controls)
    silent = without_walk(line(60, 2), lambda k: k % 10 != 0)
    base = baseline_of(line_of(silent, None), LEVEL)
    assert base.of("walk", "x") is None
    assert base.of("noise", "x") is not None
    found = judged(without_walk(line(12, 5), lambda k: k > 3), base)
    assert "No limits are frozen of x walk" in " ".join(found.sentences)
    assert sum(int(np.sum(chart.beyond)) for chart in found.controls if chart.of_family) <= 2


def test_a_family_of_few_units_has_frozen_levels_alone():
    base = baseline_of(line_of(line(5), None), LEVEL)
    assert {limits.quantity for limits in base.limits} == {"level"}
    found = judged(line(12), base)
    assert all(chart.of_family == (chart.quantity == "level") for chart in found.controls)
    assert "frozen" not in " ".join(found.sentences)


def test_limits_are_those_of_the_line_after_its_last_change():
    shift = [("noise", "x", 40, 90, 3)]
    records = line(90, 2, planted=shift)
    before = line_of(records, None)
    base = baseline_of(before, LEVEL)
    later = line_of(line(20, 8, planted=[("noise", "x", 0, 20, 3)]), None, baseline=base)
    chart = next(chart for chart in later.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    assert abs(np.median(chart.z)) < 1
    assert not np.any(chart.beyond)


@pytest.mark.parametrize("domain", [(-20.0, 20.0), (-40.0, 85.0)])
def test_a_soak_over_another_range_has_no_swing_on_the_charts(domain):
    records = [one.model_copy(update={"domain": domain}) for one in line(12, 4)]
    found = judged(records, frozen(60, 2))
    assert {chart.quantity for chart in found.controls} == {"residual", "noise", "walk", "level"}
    assert "12 units were soaked over another range than the others (" in " ".join(found.sentences)


def test_a_unit_soaked_over_a_part_of_the_range_of_most_is_named_without_a_baseline_too():
    records = line(12, 4)
    whole = records[0].domain
    records[5] = records[5].model_copy(update={"domain": (whole[0], sum(whole) / 2)})
    said = " ".join(line_of(records, None).sentences)
    assert f"1 unit was soaked over another range than the others ({records[5].unit})." in said
    assert "another range" not in " ".join(line_of(line(12, 4), None).sentences)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda one: one["limits"][4]["tails"].update(most=0),
        lambda one: one["limits"][4]["tails"].update(centre=[]),
        lambda one: one["limits"][4]["tails"].update(below=[-1.0]),
        lambda one: one["limits"][4]["tails"].update(share=[[1.0], [1.0]]),
        lambda one: one["limits"][0].update(scale="log"),
        lambda one: one["together"][0].update(quantities=["a", "b", "c", "d", "e", "f"]),
        lambda one: one.update(limits=[]),
    ],
)
def test_a_spoilt_baseline_is_refused_when_it_is_read(spoil):
    content = frozen(60, 2).model_dump(mode="json")
    Baseline.model_validate(content)
    spoil(content)
    with pytest.raises(ValidationError):
        Baseline.model_validate(content)


def test_run_rules_are_said_after_the_changes():
    records = line(60, 3, planted=[("noise", "y", 30, 60, 1.5)])
    alone, ruled = (line_of(records, None, rules=rules).sentences for rules in (None, "nelson"))
    assert ruled[0] == alone[0]
    assert any(text.startswith("Run rules begin to alarm at ") for text in ruled)
    assert not any("Run rules" in text for text in alone)
