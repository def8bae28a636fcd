"""What a plan shows: a table of profiles, sentences, charts, JSON and a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.planning.detectability import DetectabilityReport
from driftlab.planning.search import ENOUGH, RatedProfile, SearchResult
from driftlab.planning.unit_model import FILTERS
from driftlab.reports import plan_effects
from driftlab.reports.charts import Chart, Line, Panel, Rule
from driftlab.reports.pages import write_page

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.planning.chamber import Profile

WIDE = 600  # points of the body's temperature in a chart
NOTEWORTHY = 0.7  # of sigma: with less from the noise, the kind of map is what limits it


def headline(found: SearchResult) -> str:
    """Return what to record, and what comes of it."""
    best, unit = found.chosen, found.subject.unit
    value, at, axis = best.worst
    low, high = found.chamber.low, found.chamber.high
    return (
        f"record: {best.profile.name} ({best.profile.hours:.3g} h); the map is then known to "
        f"{_number(best.score * unit.factor)} {unit.shown} (rms from {low:.4g} to {high:.4g} °C, worst axis), to "
        f"{_number(value * unit.factor)} {unit.shown} at worst ({found.subject.axes[axis]}, {at:.3g} °C)"
    )


def lines(found: SearchResult, lag_of: str) -> list[str]:
    """Return why, and on what it stands, a sentence each."""
    subject, best = found.subject, found.chosen
    said = [_why(found), *_target(found), *_limits(found)]
    low, high = best.covered
    said.append(
        f"the body follows the chamber with {found.chamber.lag:.4g} s ({lag_of}) and comes to {low:.4g} to {high:.4g} "
        "°C"
    )
    unit = subject.unit
    each = zip(subject.noise, subject.walk, subject.floor, strict=True)
    values = dict.fromkeys(
        f"noise {unit.text(n, '/sqrt(Hz)')}, walk {unit.text(k, '/sqrt(s)')} (Allan floor {_number(f * unit.factor)} "
        f"{unit.shown})"
        for n, k, f in each
    )
    said.append(f"it stands on {'; '.join(values)}: {subject.noise_of}{_tuning(subject.noise_of)}")
    if subject.shape is None:
        said.append(
            f"the curve is not known: {subject.map.kind} is planned as rough as it can be, and what it cannot follow "
            "is not counted; name a fitted map, be it of another unit of the product"
        )
    else:
        said.append(f"the curve is {subject.shape_of}; loops of hysteresis and effects of rate are not in sigma")
    return said


def _why(found: SearchResult) -> str:
    classic, best = found.classic, found.chosen
    if classic is None or classic is best:
        return "no other profile of these hours is better"
    unit, ratio, passed = found.subject.unit, classic.score / best.score, best.profile.reversals
    than = f"a {classic.profile.name} has {_number(classic.score * unit.factor)} {unit.shown}"
    if ratio < 1.1 or passed < 2:
        return f"{than}, about as much"
    return (
        f"{than}, {ratio:.2g} times as much: there a walk of the bias passes for a curve; here each temperature is "
        f"passed {passed} times, up and down, and it does not"
    )


def _target(found: SearchResult) -> list[str]:
    if found.target is None:
        return []
    unit = found.subject.unit
    asked = f"{found.target * unit.factor:.4g} {unit.shown}"
    if found.shortest is None:
        return [f"{asked} is reached by no profile of any length that can be meant: see what limits it below"]
    shortest = found.shortest
    return [f"{asked} is reached in {shortest.profile.hours:.3g} h at the shortest: {shortest.profile.name}"]


def _limits(found: SearchResult) -> list[str]:
    """Say where the kind of map, and not the soak, is what limits."""
    best, unit = found.chosen, found.subject.unit
    noise = best.alone
    if found.subject.shape is None or noise > NOTEWORTHY * best.score:
        return []
    left = np.sqrt(max(best.score**2 - noise**2, 0.0)) * unit.factor
    return [
        f"of that, {_number(left)} {unit.shown} is what kind: {found.subject.map.kind} cannot follow of the curve, at "
        f"any length, and {_number(noise * unit.factor)} {unit.shown} is noise: try another kind with --kind"
    ]


def _tuning(whose: str) -> str:
    if whose != FILTERS:
        return ""
    return (
        "; a walk that was tuned wider than the unit's makes sigma too large: `driftlab allan` measures it on a log at "
        "rest, --walk takes it"
    )


def table(found: SearchResult) -> Table:
    """Return the profiles, the chosen one first."""
    from rich.table import Table

    heads, rows = cells(found)
    low, high = found.chamber.low, found.chamber.high
    title = f"expected sigma of the map from {low:.4g} to {high:.4g} °C, worst axis ({found.hours:g} h each)"
    result = Table(title=title, title_justify="left")
    result.add_column(heads[0])
    for head in heads[1:]:
        result.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        result.add_row(*row)
    return result


def cells(found: SearchResult) -> tuple[list[str], list[list[str]]]:
    """Return the heads of the table's columns, and its rows."""
    shown = found.subject.unit.shown
    heads = ["profile", f"rms\n[{shown}]", f"largest\n[{shown}]", "at\n[°C]", "covers\n[°C]"]
    return heads, [_row(found, item) for item in found.judged]


def _row(found: SearchResult, item: RatedProfile) -> list[str]:
    value, at, _ = item.worst
    factor = found.subject.unit.factor
    short = "" if item.share >= ENOUGH else " (!)"
    low, high = item.covered
    name = item.profile.name + (" (chosen)" if item is found.chosen else "")
    return [name, _number(item.score * factor), _number(value * factor), f"{at:.1f}", f"{low:.1f} to {high:.1f}{short}"]


def _number(value: float) -> str:
    return f"{value:#.3g}".rstrip(".") if value < 1000 else f"{value:.0f}"


# charts


def charts(found: SearchResult) -> list[Chart]:
    """Return the chosen profile over time, the expected sigma over temperature, and hours against sigma."""
    profile = found.chosen.profile
    what = f"{profile.name}; the set points are in setpoints.csv"
    return [profile_chart(profile, found.chamber.lag, "What to record", what), sigma_chart(found), _pareto(found)]


def profile_chart(profile: Profile, lag: float, title: str, caption: str) -> Chart:
    """Return the set points over time, and the temperature of a unit that follows them with a lag in s."""
    t, body = profile.samples(lag, WIDE)
    lines = (
        Line(t / 3600, profile.chamber(t), "set point", "temperature"),
        Line(t / 3600, body, "unit", "estimate"),
    )
    panel = Panel(lines, "temperature [°C]")
    return Chart((panel,), "time [h]", title, caption)


def setpoints(profile: Profile) -> list[tuple[str, str]]:
    """Return the set points of the page: hours, degC."""
    return [(f"{t / 3600:.3f}", f"{T:.2f}") for t, T in zip(profile.time, profile.temperature, strict=True)]


def sigma_chart(found: SearchResult) -> Chart:
    """Return sigma over temperature, a panel an axis: of the chosen profile, and of the classic staircase."""
    best, classic, unit = found.chosen, found.classic, found.subject.unit
    panels = []
    for axis, name in enumerate(found.subject.axes):
        drawn = [Line(best.temperature, best.sigma[:, axis] * unit.factor, "chosen", "series:0")]
        if classic is not None and classic is not best:
            values = classic.sigma[:, axis] * unit.factor
            drawn.append(Line(classic.temperature, values, classic.profile.name, "series:1", style="dashed"))
        target = () if found.target is None else (Rule(found.target * unit.factor, "asked for"),)
        panels.append(Panel(tuple(drawn), f"sigma {name} [{unit.shown}]", rules=target, log=True))
    caption = "one standard deviation of the map's error, without its mean over the soak"
    return Chart(tuple(panels), "temperature [°C]", "How sure the map will be", caption)


def _pareto(found: SearchResult) -> Chart:
    unit = found.subject.unit
    hours = np.array([point.hours for point in found.pareto])
    best = np.array([point.best.score for point in found.pareto]) * unit.factor
    classic = np.array([point.classic.score if point.classic else np.nan for point in found.pareto]) * unit.factor
    drawn = (
        Line(hours, best, "best profile", "series:0"),
        Line(hours, classic, "staircase one way", "series:1", style="dashed"),
    )
    target = () if found.target is None else (Rule(found.target * unit.factor, "asked for"),)
    panel = Panel(drawn, f"sigma, rms of the worst axis [{unit.shown}]", rules=target, log=True)
    return Chart((panel,), "length [h]", "What more hours buy", "each point is a search of its own", log=True)


# files


def document(found: SearchResult, said: list[str]) -> dict[str, Any]:
    """Return the plan as JSON holds it: SI, temperatures in degC."""
    subject, chamber, best = found.subject, found.chamber, found.chosen
    return {
        "schema": 1,
        "driftlab": __version__,
        "hours": found.hours,
        "range": [chamber.low, chamber.high],
        "chamber": {"rate_K_s": chamber.rate, "lag_s": chamber.lag, "start_degC": chamber.start},
        "unit": subject.unit.si,
        "channel": subject.channel,
        "kind": subject.map.kind,
        "noise": dict(zip(subject.axes, subject.noise, strict=True)),
        "walk": dict(zip(subject.axes, subject.walk, strict=True)),
        "noise_of": subject.noise_of,
        "curve_of": subject.shape_of,
        "profile": _as_json(found, best) | {"knots": _knots(best)},
        "expected_sigma": {
            "unit": subject.unit.si,
            "temperature_degC": best.temperature,
            **{axis: best.sigma[:, k] for k, axis in enumerate(subject.axes)},
        },
        "pareto": [
            {
                "hours": point.hours,
                "sigma": point.best.score,
                "profile": point.best.profile.name,
                "staircase_sigma": None if point.classic is None else point.classic.score,
            }
            for point in found.pareto
        ],
        "profiles": [_as_json(found, item) for item in found.judged],
        "target": None if found.target is None else {"sigma": found.target, "shortest": _shortest(found)},
        "notes": said,
    }


def _shortest(found: SearchResult) -> dict[str, Any] | None:
    return None if found.shortest is None else _as_json(found, found.shortest) | {"knots": _knots(found.shortest)}


def _as_json(found: SearchResult, item: RatedProfile) -> dict[str, Any]:
    value, at, axis = item.worst
    return {
        "name": item.profile.name,
        "family": item.profile.family,
        "hours": item.profile.hours,
        "sigma_rms": dict(zip(found.subject.axes, item.rms, strict=True)),
        "sigma_largest": value,
        "at_degC": at,
        "axis": found.subject.axes[axis],
        "covered_degC": item.covered,
    }


def _knots(item: RatedProfile) -> dict[str, Any]:
    return {"time_s": item.profile.time, "temperature_degC": item.profile.temperature}


def write_setpoints(path: Path, item: RatedProfile) -> None:
    """Write the set points for the chamber; straight lines in between."""
    write_profile(path, item.profile)


def write_profile(path: Path, profile: Profile) -> None:
    """Write the set points of a profile."""
    rows = zip(profile.time, profile.temperature, strict=True)
    text = "".join(f"{t:.1f},{T:.3f}\n" for t, T in rows)
    path.write_text("time [s],temperature [degC]\n" + text, encoding="utf-8")


def write_report(path: Path, found: SearchResult, said: list[str], title: str, outlook: DetectabilityReport) -> None:
    """Write the page."""
    heads, rows = cells(found)
    profile, *others = charts(found)
    write_page(
        path, "plan", title=title, lead=headline(found), notes=said, heads=[h.replace("\n", " ") for h in heads],
        rows=rows, profile=profile, charts=others, effects=plan_effects.section(outlook),
        setpoints=setpoints(found.chosen.profile),
    )  # fmt: skip
