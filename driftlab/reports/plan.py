"""A plan as a page: sentences, a table of profiles, charts and JSON; and the plan of what is recorded first.

`plan_continuation` makes the page of a plan after recordings, `plan_short_soak` that of a unit whose family is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.planning.chamber import Chamber, Profile
from driftlab.planning.detectability import DetectabilityReport
from driftlab.planning.search import MIN_COVERAGE, RatedProfile, SearchResult
from driftlab.planning.unit_model import FILTERS, UnitModel
from driftlab.reports import plan_effects
from driftlab.reports.charts import Chart, Line, Panel, axis_panels, target_rule
from driftlab.reports.pages import write_page
from driftlab.reports.tables import TextTable
from driftlab.units import BiasUnit, number
from fusion_core.chunk import Array

WIDE = 600  # points of the body's temperature in a chart
NOTEWORTHY = 0.7  # of sigma: with less from the noise, the kind of map is what limits it
NOTES = "Remarks"  # heading of the sentences on a page
CHOSEN = "Chosen profile"


@dataclass(frozen=True)
class PlanPage:
    """A plan in words, as a table, as charts, and as JSON.

    Attributes
    ----------
    headline : str
        What to record, and what comes of it.
    lines : list of str
        The reasons for the profile, and the basis of the plan, a sentence each.
    document : dict
        The plan as JSON holds it: SI, temperatures in degC.
    table : TextTable
        The profiles, the chosen one first.
    chart : Chart
        The one that a notebook shows.
    parts : list of (str, object)
        Of the page: headings, and under each a Chart, a TextTable, a section of effects, or a list of sentences.
    outcome : str
        Class of the headline on the page.
    """

    headline: str
    lines: list[str]
    document: dict[str, Any]
    table: TextTable
    chart: Chart
    parts: list[tuple[str, Any]]
    outcome: str = ""

    def write(self, path: Path, title: str, profile: Profile) -> None:
        """Write the page; the set points of the profile stand at its end."""
        rows = [(f"{t / 3600:.3f}", f"{T:.2f}") for t, T in zip(profile.time, profile.temperature, strict=True)]
        setpoints = TextTable(["time [h]", "temperature [°C]"], rows, texts=0)
        write_page(
            path, "plan", title=title, lead=self.headline, outcome=self.outcome, parts=self.parts, setpoints=setpoints
        )


def write_profile(path: Path, profile: Profile) -> None:
    """Write the set points of a profile for the chamber; straight lines in between."""
    rows = zip(profile.time, profile.temperature, strict=True)
    lines = "".join(f"{t:.1f},{T:.3f}\n" for t, T in rows)
    path.write_text("time [s],temperature [degC]\n" + lines, encoding="utf-8")


# what the three forms share


def profile_chart(profile: Profile, lag: float, title: str, caption: str) -> Chart:
    """Return the set points over time, and the temperature of a unit that follows them with a lag in s."""
    t, body = profile.samples(lag, WIDE)
    lines = (
        Line(t / 3600, profile.chamber(t), "set point", "temperature"),
        Line(t / 3600, body, "unit", "estimate"),
    )
    return Chart((Panel(lines, "temperature [°C]"),), "time [h]", title, caption)


def chosen_profile(profile: Profile, lag: float) -> tuple[str, Chart]:
    """Return the part of a page on the chosen profile."""
    caption = f"{profile.name}; the set points are in setpoints.csv"
    return CHOSEN, profile_chart(profile, lag, CHOSEN, caption)


def sigma_panels(
    axes: Sequence[str], curves: Sequence[tuple[Array, Array, str]], unit: BiasUnit, **how: Any
) -> tuple[Panel, ...]:
    """Return sigma over temperature, a panel an axis: of curves (T, sigma, name) the first solid, the second dashed."""

    def lines(axis: int) -> Iterator[Line]:
        for k, (T, sigma, name) in enumerate(curves):
            yield Line(T, sigma[:, axis] * unit.factor, name, f"series:{k}", style="dashed" if k else "line")

    return axis_panels(axes, lines, "sigma", unit.shown, log=True, **how)


def hours_chart(lines: Sequence[Line], target: float | None, unit: BiasUnit, title: str, caption: str) -> Chart:
    """Return sigma over the length of a soak."""
    label = f"sigma, rms of the worst axis [{unit.shown}]"
    panel = Panel(tuple(lines), label, rules=target_rule(target, unit.factor), log=True)
    return Chart((panel,), "length [h]", title, caption, log=True)


def head(subject: UnitModel, chamber: Chamber, hours: float, /, **more: Any) -> dict[str, Any]:
    """Return the head of a plan as JSON holds it: the chamber, with `more` after its range, and the unit."""
    return {
        "schema": 1,
        "driftlab": __version__,
        "hours": hours,
        "range": [chamber.low, chamber.high],
        **more,
        "unit": subject.unit.si,
        "channel": subject.channel,
        "kind": subject.map.kind,
        "noise": by_axis(subject.axes, subject.noise),
        "walk": by_axis(subject.axes, subject.walk),
        "noise_of": subject.noise_of,
    }


def by_axis(axes: Sequence[str], values: Array) -> dict[str, Any]:
    """Return values (d,), or the columns of values (N, d), by the names of the axes."""
    return dict(zip(axes, values.T, strict=True))


def expected_sigma(axes: Sequence[str], unit: BiasUnit, rated: RatedProfile) -> dict[str, Any]:
    """Return the sigma of a map over temperature as JSON holds it."""
    return {"unit": unit.si, "temperature_degC": rated.temperature, **by_axis(axes, rated.sigma)}


def knots(profile: Profile) -> dict[str, Any]:
    """Return the set points of a profile as JSON holds them."""
    return {"knots": {"time_s": profile.time, "temperature_degC": profile.temperature}}


# before anything is recorded


def page_of_search(plan: SearchResult, lag_of: str, outlook: DetectabilityReport) -> PlanPage:
    """Return the page of a first soak; `lag_of` says where the lag of the body is from."""
    lines = [*_reasons(plan, lag_of), *plan_effects.brief(outlook)]
    table, sigma, pareto = _profiles(plan), _sigma_chart(plan), _pareto(plan)
    parts = [
        chosen_profile(plan.chosen.profile, plan.chamber.lag),
        ("Profiles of these hours", table),
        (plan_effects.HEADING, plan_effects.section(outlook)),
        (NOTES, lines),
        (sigma.title, sigma),
        (pareto.title, pareto),
    ]
    document = _search_document(plan, lines) | {"effects": plan_effects.document(outlook)}
    return PlanPage(_headline(plan), lines, document, table, sigma, parts)


def _headline(plan: SearchResult) -> str:
    """Return the recording to make, and the sigma that its map will have."""
    best, unit = plan.chosen, plan.subject.unit
    value, at, axis = best.worst
    low, high = plan.chamber.low, plan.chamber.high
    return (
        f"record: {best.profile.name} ({best.profile.hours:.3g} h); the map is then known to "
        f"{_size(best.score, unit)} (rms from {low:.4g} to {high:.4g} °C, worst axis), to "
        f"{_size(value, unit)} at worst ({plan.subject.axes[axis]}, {at:.3g} °C)"
    )


def _reasons(plan: SearchResult, lag_of: str) -> list[str]:
    """Return the reasons for the choice, and the assumptions it rests on, a sentence each."""
    subject, best, unit = plan.subject, plan.chosen, plan.subject.unit
    low, high = best.covered
    each = zip(subject.noise, subject.walk, subject.floor, strict=True)
    values = dict.fromkeys(
        f"noise {unit.text(n, '/sqrt(Hz)')}, walk {unit.text(k, '/sqrt(s)')} (Allan floor {_size(f, unit)})"
        for n, k, f in each
    )
    tuning = (
        "; a walk that was tuned wider than the unit's makes sigma too large: `driftlab allan` measures it on a log at "
        "rest, --walk takes it"
    )
    curve = (
        f"the curve is not known: {subject.map.kind} is planned as rough as it can be, and what it cannot follow "
        "is not counted; name a fitted map, be it of another unit of the product"
        if subject.shape is None
        else f"the curve is {subject.shape_of}; loops of hysteresis and effects of rate are not in sigma"
    )
    return [
        _beside_classic(plan),
        *_target(plan),
        *_limits(plan),
        f"the body follows the chamber with {plan.chamber.lag:.4g} s ({lag_of}) and comes to {low:.4g} to "
        f"{high:.4g} °C",
        f"it stands on {'; '.join(values)}: {subject.noise_of}{tuning if subject.noise_of == FILTERS else ''}",
        curve,
    ]


def _beside_classic(plan: SearchResult) -> str:
    classic, best = plan.classic, plan.chosen
    if classic is None or classic is best:
        return "no other profile of these hours is better"
    unit, ratio, passed = plan.subject.unit, classic.score / best.score, best.profile.reversals
    than = f"a {classic.profile.name} has {_size(classic.score, unit)}"
    if ratio < 1.1 or passed < 2:
        return f"{than}, about as much"
    return (
        f"{than}, {ratio:.2g} times as much: there a walk of the bias passes for a curve; here each temperature is "
        f"passed {passed} times, up and down, and it does not"
    )


def _target(plan: SearchResult) -> list[str]:
    if plan.target is None:
        return []
    unit, shortest = plan.subject.unit, plan.shortest
    asked = f"{plan.target * unit.factor:.4g} {unit.shown}"
    if shortest is None:
        return [f"{asked} is reached by no profile of any length that can be meant: see what limits it below"]
    return [f"{asked} is reached in {shortest.profile.hours:.3g} h at the shortest: {shortest.profile.name}"]


def _limits(plan: SearchResult) -> list[str]:
    """Return the temperatures at which the kind of map, and not the soak, limits the sigma."""
    best, unit = plan.chosen, plan.subject.unit
    if plan.subject.shape is None or best.alone > NOTEWORTHY * best.score:
        return []
    left = float(np.sqrt(max(best.score**2 - best.alone**2, 0.0)))
    return [
        f"of that, {_size(left, unit)} is what kind: {plan.subject.map.kind} cannot follow of the curve, at "
        f"any length, and {_size(best.alone, unit)} is noise: try another kind with --kind"
    ]


def _size(value: float, unit: BiasUnit) -> str:
    return f"{number(value * unit.factor, zeros=True)} {unit.shown}"


def _profiles(plan: SearchResult) -> TextTable:
    unit, low, high = plan.subject.unit, plan.chamber.low, plan.chamber.high

    def row(rated: RatedProfile) -> list[str]:
        value, at, _ = rated.worst
        sizes = [number(v * unit.factor, zeros=True) for v in (rated.score, value)]
        covered = f"{rated.covered[0]:.1f} to {rated.covered[1]:.1f}"
        short = "" if rated.share >= MIN_COVERAGE else " (!)"
        chosen = " (chosen)" if rated is plan.chosen else ""
        return [rated.profile.name + chosen, *sizes, f"{at:.1f}", covered + short]

    heads = ["profile", f"rms\n[{unit.shown}]", f"largest\n[{unit.shown}]", "at\n[°C]", "covers\n[°C]"]
    title = f"expected sigma of the map from {low:.4g} to {high:.4g} °C, worst axis (up to {plan.hours:g} h)"
    return TextTable(heads, list(map(row, plan.judged)), title)


def _sigma_chart(plan: SearchResult) -> Chart:
    """Return sigma over temperature, a panel an axis: of the chosen profile, and of the classic staircase."""
    best, classic, unit = plan.chosen, plan.classic, plan.subject.unit
    curves = [(best.temperature, best.sigma, "chosen")]
    if classic is not None and classic is not best:
        curves.append((classic.temperature, classic.sigma, classic.profile.name))
    caption = "one standard deviation of the map's error, without its mean over the soak"
    panels = sigma_panels(plan.subject.axes, curves, unit, rules=target_rule(plan.target, unit.factor))
    return Chart(panels, "temperature [°C]", "Predicted sigma of the map", caption)


def _pareto(plan: SearchResult) -> Chart:
    unit = plan.subject.unit
    hours, best = np.array([(p.hours, p.best.score) for p in plan.pareto]).T
    line = Line(hours, best * unit.factor, "best profile of up to so many hours", "series:0")
    caption = "Where the line is flat, more hours buy nothing: stop there."
    return hours_chart([line], plan.target, unit, "Gain of more hours", caption)


def _search_document(plan: SearchResult, notes: list[str]) -> dict[str, Any]:
    subject, chamber, best = plan.subject, plan.chamber, plan.chosen

    def content(rated: RatedProfile) -> dict[str, Any]:
        value, at, axis = rated.worst
        return {
            "name": rated.profile.name,
            "family": rated.profile.family,
            "hours": rated.profile.hours,
            "sigma_rms": by_axis(subject.axes, rated.rms),
            "sigma_largest": value,
            "at_degC": at,
            "axis": subject.axes[axis],
            "covered_degC": rated.covered,
        }

    shortest = None if plan.shortest is None else content(plan.shortest) | knots(plan.shortest.profile)
    settings = {"rate_K_s": chamber.rate, "lag_s": chamber.lag, "start_degC": chamber.start}
    return {
        **head(subject, chamber, plan.hours, chamber=settings),
        "curve_of": subject.shape_of,
        "profile": content(best) | knots(best.profile),
        "expected_sigma": expected_sigma(subject.axes, subject.unit, best),
        "pareto": [
            {
                "hours": point.hours,
                "sigma": point.best.score,
                "profile": point.best.profile.name,
                "staircase_sigma": None if point.classic is None else point.classic.score,
            }
            for point in plan.pareto
        ],
        "profiles": list(map(content, plan.judged)),
        "target": None if plan.target is None else {"sigma": plan.target, "shortest": shortest},
        "notes": notes,
    }
