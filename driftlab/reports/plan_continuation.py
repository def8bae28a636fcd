"""What a plan after recordings shows: whether it is enough, a table of further profiles, a chart, JSON and a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.planning.continuation import LITTLE, Continuation
from driftlab.planning.detectability import DetectabilityReport
from driftlab.planning.search import ENOUGH, RatedProfile
from driftlab.reports import plan_effects
from driftlab.reports.charts import Chart, Line, Panel, Rule, Shade
from driftlab.reports.pages import write_page
from driftlab.reports.plan import profile_chart, setpoints

if TYPE_CHECKING:
    from rich.table import Table

SHOWN = 6  # profiles of the table


def headline(found: Continuation) -> str:
    """Return whether what was recorded is enough, or what to record."""
    before, best = found.recorded, found.chosen
    low, high = before.chamber.low, before.chamber.high
    over = f"from {low:.4g} to {high:.4g} °C"
    if found.enough:
        value, at, axis = before.worst
        text = f"enough: {_said(found, before.score)} {over} (rms, worst axis)"
        most = f"{_said(found, value)} at most ({before.subject.axes[axis]}, {at:.3g} °C)"
        return f"{text}, {most}; {_why(found)}"
    if before.whole and found.gain < LITTLE and found.target is not None:
        now, then = _said(found, before.score), _said(found, best.score)
        return (
            f"{_said(found, found.target)} is not reached by recording more: sigma is {now} {over} (rms, worst axis), "
            f"and {then} after {best.profile.hours:.3g} h more at best; see what limits it below"
        )
    return f"record {best.profile.name} ({best.profile.hours:.3g} h); {_gained(found)}"


def _why(found: Continuation) -> str:
    if found.enough == "target":
        return f"{_said(found, found.target or 0.0)} was asked for"
    if found.enough == "floor":
        return "the bias by itself wanders by more: it is below the floor of the Allan deviation"
    if found.gain <= 0:
        return "another hour would not make it smaller"
    return f"another hour would make it smaller by {100 * found.gain:.1f} %, less than {100 * LITTLE:.0f} %"


def _gained(found: Continuation) -> str:
    before, best = found.recorded, found.chosen
    if not before.whole:
        low, high = before.seen
        known = f"{low:.4g} to {high:.4g} °C were seen, the rest of the range is not known"
        return f"{known}; with it sigma is {_said(found, best.score)} (rms over the range, worst axis)"
    return (
        f"sigma then goes from {_said(found, before.score)} to {_said(found, best.score)} (rms over the range, worst "
        f"axis), at worst from {_said(found, before.worst[0])} to {_said(found, best.worst[0])}"
    )


def _more(found: Continuation) -> str:
    """Return what further hours would do where it is enough."""
    if found.gain <= 0:
        return f"no further profile of {found.hours:g} h makes sigma smaller"
    return f"should there be time: {found.chosen.profile.name}; {_gained(found)}"


def lines(found: Continuation) -> list[str]:
    """Return what is known so far, and on what that stands, a sentence each."""
    before, unit = found.recorded, found.recorded.subject.unit
    subject, (low, high) = before.subject, before.seen
    several = "s" if len(before.parts) > 1 else ""
    count = f"{len(before.parts)} recording{several}"
    said = [f"recorded: {before.hours:.3g} h in {count}, {low:.4g} to {high:.4g} °C"]
    if np.isfinite(before.score):
        value, at, axis = before.worst
        said.append(
            f"known so far: {_said(found, before.score)} (rms, worst axis), at worst {_said(found, value)} "
            f"({subject.axes[axis]}, {at:.3g} °C)"
        )
    each = zip(subject.axes, subject.noise * unit.factor, subject.walk * unit.factor, strict=True)
    noises = ", ".join(f"{a} {n:.3g} {unit.shown}/sqrt(Hz) and {k:.3g} {unit.shown}/sqrt(s)" for a, n, k in each)
    said.append(f"noise and walk as measured over blocks of minutes: {noises}")
    if found.enough:
        said.append(_more(found))
    if len(before.parts) > 1:
        said.append("recordings are fitted one after the other; another level after a pause counts as walk")
    worst = float(np.sqrt(np.mean(before.misfit**2, axis=0)).max())
    if worst > 0.5 * before.score:
        said.append(
            f"{_said(found, worst)} of it is what kind: {subject.map.kind} cannot follow of the curve, which no "
            "further hour changes: try another with --kind"
        )
    return said


def heads(found: Continuation) -> list[str]:
    """Return the heads of the table's columns."""
    shown = found.recorded.subject.unit.shown
    return ["further profile", f"rms after it\n[{shown}]", f"largest\n[{shown}]", "at\n[°C]"]


def cells(found: Continuation) -> list[list[str]]:
    """Return the rows of the table: what is known so far, then the best profiles."""
    before, factor = found.recorded, found.recorded.subject.unit.factor
    value, at, _ = before.worst if np.isfinite(before.score) else (np.inf, np.nan, 0)
    whole = "" if before.whole else " (where seen)"
    first = [f"none{whole}", _number(before.score * factor), _number(value * factor), f"{at:.1f}"]
    return [first, *(_row(found, item) for item in found.judged[:SHOWN])]


def _row(found: Continuation, item: RatedProfile) -> list[str]:
    value, at, _ = item.worst
    factor = found.recorded.subject.unit.factor
    short = "" if item.share >= ENOUGH else " (not all of the range)"
    return [item.profile.name + short, _number(item.score * factor), _number(value * factor), f"{at:.1f}"]


def table(found: Continuation) -> Table:
    """Return the table for a terminal."""
    from rich.table import Table

    result = Table(title="sigma of the map, fitted to all of it", title_justify="left")
    first, *others = heads(found)
    result.add_column(first)
    for head in others:
        result.add_column(head, justify="right", no_wrap=True)
    for row in cells(found):
        result.add_row(*row)
    return result


def sigma_chart(found: Continuation) -> Chart:
    """Return sigma over temperature, a panel an axis: so far, and with the further profile."""
    before, best, unit = found.recorded, found.chosen, found.recorded.subject.unit
    low, high = before.seen
    ends = ((before.chamber.low, low), (high, before.chamber.high))
    shades = tuple(Shade(a, b, "not seen yet", "hole") for a, b in ends if b > a)
    panels = []
    for axis, name in enumerate(before.subject.axes):
        drawn = (
            Line(best.temperature, best.sigma[:, axis] * unit.factor, "with the further profile", "series:0"),
            Line(before.grid, before.sigma[:, axis] * unit.factor, "so far", "series:1", style="dashed"),
        )
        target = () if found.target is None else (Rule(found.target * unit.factor, "asked for"),)
        panels.append(Panel(drawn, f"sigma {name} [{unit.shown}]", shades=shades, rules=target, log=True))
    return Chart(tuple(panels), "temperature [°C]", "How sure the map is", "one standard deviation of the map's error")


def document(found: Continuation, said: list[str]) -> dict[str, Any]:
    """Return what was found as JSON holds it: SI, temperatures in degC."""
    before, best = found.recorded, found.chosen
    subject, axes = before.subject, before.subject.axes
    return {
        "schema": 1,
        "driftlab": __version__,
        "hours": found.hours,
        "range": [before.chamber.low, before.chamber.high],
        "unit": subject.unit.si,
        "channel": subject.channel,
        "kind": subject.map.kind,
        "noise": dict(zip(axes, subject.noise, strict=True)),
        "walk": dict(zip(axes, subject.walk, strict=True)),
        "noise_of": subject.noise_of,
        "recorded": {
            "hours": before.hours,
            "seen_degC": before.seen,
            "sigma_rms": before.score if np.isfinite(before.score) else None,
            "sigma": {axis: before.sigma[:, k] for k, axis in enumerate(axes)},
        },
        "temperature_degC": best.temperature,
        "enough": found.enough or None,
        "target": found.target,
        "profile": {
            "name": best.profile.name,
            "hours": best.profile.hours,
            "sigma_rms": dict(zip(axes, best.rms, strict=True)),
            "sigma": {axis: best.sigma[:, k] for k, axis in enumerate(axes)},
            "knots": {"time_s": best.profile.time, "temperature_degC": best.profile.temperature},
        },
        "notes": said,
    }


def write_report(path: Path, found: Continuation, outlook: DetectabilityReport, said: list[str], title: str) -> None:
    """Write the page."""
    profile = found.chosen.profile
    write_page(
        path, "plan_after", title=title, lead=headline(found), notes=said, rows=cells(found),
        heads=[head.replace("\n", " ") for head in heads(found)], chart=sigma_chart(found),
        profile=profile_chart(profile, found.recorded.chamber.lag, "The further profile", profile.name),
        effects=plan_effects.section(outlook), enough=bool(found.enough),
        setpoints=setpoints(profile),
    )  # fmt: skip


def _said(found: Continuation, value: float) -> str:
    unit = found.recorded.subject.unit
    return f"{_number(value * unit.factor)} {unit.shown}"


def _number(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}" if np.isfinite(value) else "not known"
