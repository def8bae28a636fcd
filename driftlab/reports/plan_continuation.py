"""A plan after recordings as a page: whether they are enough, a table of further profiles, a chart and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from driftlab.maps.assessment import memory_sentence
from driftlab.planning.continuation import LITTLE, Continuation
from driftlab.planning.detectability import DetectabilityReport, EffectEstimate
from driftlab.planning.search import MIN_COVERAGE, RatedProfile
from driftlab.reports import plan_effects
from driftlab.reports.charts import Chart, Shade, target_rule
from driftlab.reports.plan import NOTES, PlanPage, by_axis, head, knots, profile_chart, sigma_panels
from driftlab.reports.tables import TextTable
from driftlab.units import number

MAX_ROWS = 6  # profiles of the table
UNKNOWN = "not known"  # a sigma beyond all that was recorded
FURTHER = "The further profile"


def page_of(plan: Continuation, outlook: DetectabilityReport, seen: Sequence[EffectEstimate]) -> PlanPage:
    """Return the page of a plan; `seen` are the effects in what was recorded."""
    notes = [
        *lines(plan), *plan_effects.seen_lines(seen, plan.recorded.subject.unit), *plan_effects.brief(outlook),
    ]  # fmt: skip
    profile, chart, table = plan.chosen.profile, _sigma_chart(plan), profiles(plan)
    parts = [
        (chart.title, chart),
        ("Gain of a further recording", table),
        (NOTES, notes),
        (FURTHER, profile_chart(profile, plan.recorded.chamber.lag, FURTHER, profile.name)),
        (plan_effects.HEADING, plan_effects.section(outlook)),
    ]
    document = _document(plan, notes) | {"effects": plan_effects.document(outlook)}
    return PlanPage(headline(plan), notes, document, table, chart, parts, "pass" if plan.enough else "unknown")


def headline(plan: Continuation) -> str:
    """Return the verdict on the recordings: enough, or the recording that is missing."""
    before, best = plan.recorded, plan.chosen
    low, high = before.chamber.low, before.chamber.high
    over = f"from {low:.4g} to {high:.4g} °C"
    if plan.enough:
        value, at, axis = before.worst
        text = f"enough: {_size(plan, before.score)} {over} (rms, worst axis)"
        most = f"{_size(plan, value)} at most ({before.subject.axes[axis]}, {at:.3g} °C)"
        return f"{text}, {most}; {_why(plan)}"
    if before.whole and plan.gain < LITTLE and plan.target is not None:
        now, then = _size(plan, before.score), _size(plan, best.score)
        return (
            f"{_size(plan, plan.target)} is not reached by recording more: sigma is {now} {over} (rms, worst axis), "
            f"and {then} after {best.profile.hours:.3g} h more at best; see what limits it below"
        )
    return f"record {best.profile.name} ({best.profile.hours:.3g} h); {_gained(plan)}"


def _why(plan: Continuation) -> str:
    if plan.enough == "target":
        return f"{_size(plan, plan.target or 0.0)} was asked for"
    if plan.enough == "floor":
        return "the bias by itself wanders by more: it is below the floor of the Allan deviation"
    if plan.gain <= 0:
        return "another hour would not make it smaller"
    return f"another hour would make it smaller by {100 * plan.gain:.1f} %, less than {100 * LITTLE:.0f} %"


def _gained(plan: Continuation) -> str:
    before, best = plan.recorded, plan.chosen
    if not before.whole:
        low, high = before.seen
        known = f"{low:.4g} to {high:.4g} °C were seen, the rest of the range is not known"
        return f"{known}; with it sigma is {_size(plan, best.score)} (rms over the range, worst axis)"
    return (
        f"sigma then goes from {_size(plan, before.score)} to {_size(plan, best.score)} (rms over the range, worst "
        f"axis), at worst from {_size(plan, before.worst[0])} to {_size(plan, best.worst[0])}"
    )


def lines(plan: Continuation) -> list[str]:
    """Return the state of knowledge so far, and its basis, a sentence each."""
    before, unit = plan.recorded, plan.recorded.subject.unit
    subject, (low, high) = before.subject, before.seen
    count = f"{len(before.parts)} recording{'s' if len(before.parts) > 1 else ''}"
    sentences = [f"recorded: {before.hours:.3g} h in {count}, {low:.4g} to {high:.4g} °C"]
    if np.isfinite(before.score):
        value, at, axis = before.worst
        sentences.append(
            f"known so far: {_size(plan, before.score)} (rms, worst axis), at worst {_size(plan, value)} "
            f"({subject.axes[axis]}, {at:.3g} °C)"
        )
    each = zip(subject.axes, subject.noise * unit.factor, subject.walk * unit.factor, strict=True)
    noises = ", ".join(f"{a} {n:.3g} {unit.shown}/sqrt(Hz) and {k:.3g} {unit.shown}/sqrt(s)" for a, n, k in each)
    sentences.append(f"noise and walk as measured over blocks of minutes: {noises}")
    if plan.enough and plan.gain <= 0:
        sentences.append(f"no further profile of {plan.hours:g} h makes sigma smaller")
    elif plan.enough:
        sentences.append(f"should there be time: {plan.chosen.profile.name}; {_gained(plan)}")
    if len(before.parts) > 1:
        sentences.append("recordings are fitted one after the other; another level after a pause counts as walk")
    between, worst = (float(np.sqrt(np.mean(v**2, axis=0)).max()) for v in (before.between, before.misfit))
    if between > 0.5 * before.score and before.memory.answer != "none":
        half = f"{_size(plan, between)} of it is half of what is, or may be, between up and down"
        sentences.append(f"{half}: {memory_sentence(before.memory, subject.axes, unit)}")
    if worst > 0.5 * before.score:
        sentences.append(
            f"{_size(plan, worst)} of it is what kind: {subject.map.kind} cannot follow of the curve, which no "
            "further hour changes: try another with --kind"
        )
    return sentences


def profiles(plan: Continuation) -> TextTable:
    """Return the state of knowledge so far, then the best profiles."""
    before, unit = plan.recorded, plan.recorded.subject.unit

    def row(name: str, score: float, largest: float, at: float) -> list[str]:
        return [name, *(number(value * unit.factor, missing=UNKNOWN) for value in (score, largest)), f"{at:.1f}"]

    def further(rated: RatedProfile) -> list[str]:
        short = "" if rated.share >= MIN_COVERAGE else " (not all of the range)"
        return row(rated.profile.name + short, rated.score, *rated.worst[:2])

    value, at, _ = before.worst if np.isfinite(before.score) else (np.inf, np.nan, 0)
    first = row("none" if before.whole else "none (where seen)", before.score, value, at)
    heads = ["further profile", f"rms after it\n[{unit.shown}]", f"largest\n[{unit.shown}]", "at\n[°C]"]
    return TextTable(heads, [first, *map(further, plan.judged[:MAX_ROWS])], "sigma of the map, fitted to all of it")


def _sigma_chart(plan: Continuation) -> Chart:
    """Return sigma over temperature, a panel an axis: so far, and with the further profile."""
    before, best, unit = plan.recorded, plan.chosen, plan.recorded.subject.unit
    low, high = before.seen
    ends = ((before.chamber.low, low), (high, before.chamber.high))
    shades = tuple(Shade(a, b, "not seen yet", "hole") for a, b in ends if b > a)
    further = best.temperature, best.sigma, "with the further profile"
    curves, rules = [further, (before.temperature, before.sigma, "so far")], target_rule(plan.target, unit.factor)
    panels = sigma_panels(before.subject.axes, curves, unit, shades=shades, rules=rules)
    return Chart(panels, "temperature [°C]", "Sigma of the map", "one standard deviation of the map's error")


def _document(plan: Continuation, notes: list[str]) -> dict[str, Any]:
    before, best, axes = plan.recorded, plan.chosen, plan.recorded.subject.axes
    return {
        **head(before.subject, before.chamber, plan.hours),
        "recorded": {
            "hours": before.hours,
            "seen_degC": before.seen,
            "sigma_rms": before.score if np.isfinite(before.score) else None,
            "sigma": by_axis(axes, before.sigma),
        },
        "temperature_degC": best.temperature,
        "enough": plan.enough or None,
        "target": plan.target,
        "profile": {
            "name": best.profile.name,
            "hours": best.profile.hours,
            "sigma_rms": by_axis(axes, best.rms),
            "sigma": by_axis(axes, best.sigma),
            **knots(best.profile),
        },
        "notes": notes,
    }


def _size(plan: Continuation, value: float) -> str:
    unit = plan.recorded.subject.unit
    return f"{number(value * unit.factor, missing=UNKNOWN)} {unit.shown}"
