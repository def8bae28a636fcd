"""A plan after recordings: whether they are enough, a table of further profiles, a chart, JSON and its page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.planning.continuation import LITTLE, Continuation
from driftlab.planning.detectability import DetectabilityReport
from driftlab.planning.search import MIN_COVERAGE, RatedProfile
from driftlab.reports import plan as plan_page
from driftlab.reports import plan_effects
from driftlab.reports.charts import Chart, Shade, target_rule
from driftlab.reports.tables import TextTable
from driftlab.units import number

if TYPE_CHECKING:
    from rich.table import Table

MAX_ROWS = 6  # profiles of the table
UNKNOWN = "not known"  # a sigma beyond all that was recorded


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


def _further(plan: Continuation) -> str:
    """Return the gain of further hours where the recordings are enough."""
    if plan.gain <= 0:
        return f"no further profile of {plan.hours:g} h makes sigma smaller"
    return f"should there be time: {plan.chosen.profile.name}; {_gained(plan)}"


def lines(plan: Continuation) -> list[str]:
    """Return the state of knowledge so far, and its basis, a sentence each."""
    before, unit = plan.recorded, plan.recorded.subject.unit
    subject, (low, high) = before.subject, before.seen
    several = "s" if len(before.parts) > 1 else ""
    count = f"{len(before.parts)} recording{several}"
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
    if plan.enough:
        sentences.append(_further(plan))
    if len(before.parts) > 1:
        sentences.append("recordings are fitted one after the other; another level after a pause counts as walk")
    worst = float(np.sqrt(np.mean(before.misfit**2, axis=0)).max())
    if worst > 0.5 * before.score:
        sentences.append(
            f"{_size(plan, worst)} of it is what kind: {subject.map.kind} cannot follow of the curve, which no "
            "further hour changes: try another with --kind"
        )
    return sentences


def cells(plan: Continuation) -> list[list[str]]:
    """Return the rows of the table: what is known so far, then the best profiles."""
    before = plan.recorded
    value, at, _ = before.worst if np.isfinite(before.score) else (np.inf, np.nan, 0)
    whole = "" if before.whole else " (where seen)"
    first = _row(plan, f"none{whole}", before.score, value, at)
    return [first, *(_profile_row(plan, rated) for rated in plan.judged[:MAX_ROWS])]


def _profile_row(plan: Continuation, rated: RatedProfile) -> list[str]:
    value, at, _ = rated.worst
    short = "" if rated.share >= MIN_COVERAGE else " (not all of the range)"
    return _row(plan, rated.profile.name + short, rated.score, value, at)


def _row(plan: Continuation, name: str, score: float, largest: float, at: float) -> list[str]:
    factor = plan.recorded.subject.unit.factor
    return [name, *(number(value * factor, missing=UNKNOWN) for value in (score, largest)), f"{at:.1f}"]


def _profiles(plan: Continuation) -> TextTable:
    shown = plan.recorded.subject.unit.shown
    heads = ["further profile", f"rms after it\n[{shown}]", f"largest\n[{shown}]", "at\n[°C]"]
    return TextTable(heads, cells(plan), "sigma of the map, fitted to all of it")


def table(plan: Continuation) -> Table:
    """Return the table for a terminal."""
    return _profiles(plan).rich()


def sigma_chart(plan: Continuation) -> Chart:
    """Return sigma over temperature, a panel an axis: so far, and with the further profile."""
    before, best, unit = plan.recorded, plan.chosen, plan.recorded.subject.unit
    low, high = before.seen
    ends = ((before.chamber.low, low), (high, before.chamber.high))
    shades = tuple(Shade(a, b, "not seen yet", "hole") for a, b in ends if b > a)
    curves = [
        (best.temperature, best.sigma, "with the further profile"),
        (before.temperature, before.sigma, "so far"),
    ]
    rules = target_rule(plan.target, unit.factor)
    panels = plan_page.sigma_panels(before.subject.axes, curves, unit, shades=shades, rules=rules)
    return Chart(panels, "temperature [°C]", "Sigma of the map", "one standard deviation of the map's error")


def document(plan: Continuation, notes: list[str]) -> dict[str, Any]:
    """Return the plan as JSON holds it: SI, temperatures in degC."""
    before, best, axes = plan.recorded, plan.chosen, plan.recorded.subject.axes
    return {
        **plan_page.head(before.subject, before.chamber, plan.hours, {}),
        "recorded": {
            "hours": before.hours,
            "seen_degC": before.seen,
            "sigma_rms": before.score if np.isfinite(before.score) else None,
            "sigma": plan_page.by_axis(axes, before.sigma),
        },
        "temperature_degC": best.temperature,
        "enough": plan.enough or None,
        "target": plan.target,
        "profile": {
            "name": best.profile.name,
            "hours": best.profile.hours,
            "sigma_rms": plan_page.by_axis(axes, best.rms),
            "sigma": plan_page.by_axis(axes, best.sigma),
            **plan_page.knots(best.profile),
        },
        "notes": notes,
    }


def write_report(path: Path, plan: Continuation, outlook: DetectabilityReport, notes: list[str], title: str) -> None:
    """Write the page."""
    profile, chart = plan.chosen.profile, sigma_chart(plan)
    parts = [
        (chart.title, chart),
        ("Gain of a further recording", _profiles(plan)),
        (plan_page.NOTES, notes),
        (
            "The further profile",
            plan_page.profile_chart(profile, plan.recorded.chamber.lag, "The further profile", profile.name),
        ),
        (plan_effects.HEADING, plan_effects.section(outlook)),
    ]
    plan_page.write_plan(path, title, headline(plan), parts, profile, "pass" if plan.enough else "unknown")


def _size(plan: Continuation, value: float) -> str:
    unit = plan.recorded.subject.unit
    return f"{number(value * unit.factor, missing=UNKNOWN)} {unit.shown}"
