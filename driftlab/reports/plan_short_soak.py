"""What a plan with a family shows: a table of parts and hours, sentences, charts, JSON and a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.maps.assessment import text
from driftlab.planning.short_soak import SHARES, ShortSoak, ShortSoakPlan
from driftlab.reports.charts import Chart, Line, Panel, Rule
from driftlab.reports.pages import write_page
from driftlab.reports.plan import profile_chart, setpoints

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.units import BiasUnit


def headline(found: ShortSoakPlan, unit: BiasUnit) -> str:
    """Return what to soak, and what comes of it."""
    best, chamber = found.chosen, found.chamber
    what = (
        f"soak {best.saw[0]:.3g} to {best.saw[1]:.3g} °C ({_part(best)}) in {best.profile.hours:.3g} h: with the "
        f"family of {found.family.units} units the map is then known to {_said(best.score, unit)} from "
        f"{chamber.low:.4g} to {chamber.high:.4g} °C (rms, worst axis, level included)"
    )
    if found.reached:
        return what
    return f"{_said(found.target or 0.0, unit)} is reached by no part and no length of the table; the nearest: {what}"


def lines(found: ShortSoakPlan, unit: BiasUnit, noise_of: str) -> list[str]:
    """Return what the family is worth, and on what the plan stands, a sentence each."""
    best = found.chosen
    said = [f"the same soak without the family leaves {_said(best.own_score, unit)}, with the best polynomial"]
    if found.target is not None:
        asked = _said(found.target, unit)
        said.append(
            f"without the family {asked} takes {found.own_hours:.3g} h"
            if found.own_hours is not None
            else f"without the family no part and no length of the table reaches {asked}"
        )
    noise, walk = (f"{text(float(np.max(v)) * unit.factor)} {unit.shown}" for v in (found.noise, found.walk))
    said.append(f"it stands on noise {noise}/sqrt(Hz) and walk {walk}/sqrt(s), worst axis: {noise_of}")
    bands = found.family.bands
    if bands is None:
        said.append("sigma stands on a Gaussian law: too few units saw the whole range to measure it on them")
    else:
        said.append(f"sigma is as measured on {bands.units} units left out of the family")
    said.append("a unit that is not as the family is off by more: `driftlab fit-map --family` says whether it is")
    return said


def _part(short: ShortSoak) -> str:
    return "the whole range" if short.share == 1 else f"the {short.place} {100 * short.share:.0f} % of the range"


def _said(value: float, unit: BiasUnit) -> str:
    return f"{text(value * unit.factor)} {unit.shown}"


def cells(found: ShortSoakPlan, unit: BiasUnit) -> tuple[list[str], list[list[str]]]:
    """Return the heads of the table's columns, and its rows: sigma with the family, and the error without."""
    heads = ["range", *(f"{hours:.3g} h" for hours in found.hours)]
    rows = []
    for share in SHARES:
        row = [f"{100 * share:.0f} %"]
        for hours in found.hours:
            best = found.best(share, hours)
            row.append(
                "" if best is None
                else f"{text(best.score * unit.factor)} ({text(best.own_score * unit.factor)})\n{best.place}"
            )  # fmt: skip
        rows.append(row)
    return heads, rows


def table(found: ShortSoakPlan, unit: BiasUnit) -> Table:
    """Return it for a terminal."""
    from rich.table import Table

    heads, rows = cells(found, unit)
    title = f"expected sigma over the range with the family (without) [{unit.shown}]"
    result = Table(title=title, title_justify="left")
    for head in heads:
        result.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        result.add_row(*row)
    return result


def hours_chart(found: ShortSoakPlan, unit: BiasUnit) -> Chart:
    """Return sigma over the length of the soak, a line for each share of the range."""
    drawn = []
    for k, share in enumerate(SHARES):
        own = sorted((s for s in found.tried if s.share == share), key=lambda s: s.profile.hours)
        hours = np.array([s.profile.hours for s in own])
        if len(own):
            with_family = np.array([s.score for s in own]) * unit.factor
            drawn.append(Line(hours, with_family, f"{100 * share:.0f} % of the range", f"series:{k}"))
    whole = sorted((s for s in found.tried if s.share == 1), key=lambda s: s.profile.hours)
    if whole:
        hours, alone = (np.array(v) for v in zip(*((s.profile.hours, s.own_score) for s in whole), strict=True))
        drawn.append(Line(hours, alone * unit.factor, "all of it, without the family", "data", style="dashed"))
    target = () if found.target is None else (Rule(found.target * unit.factor, "asked for"),)
    panel = Panel(tuple(drawn), f"sigma, rms of the worst axis [{unit.shown}]", rules=target, log=True)
    return Chart(
        (panel,), "length [h]", "How short a soak may be", "each point: the best place of that share", log=True
    )


def sigma_chart(found: ShortSoakPlan, unit: BiasUnit) -> Chart:
    """Return sigma over temperature of what was chosen, with the family and without."""
    best = found.chosen
    panels = []
    for axis, name in enumerate(found.family.axes):
        drawn = (
            Line(best.temperature, best.sigma[:, axis] * unit.factor, "with the family", "series:0"),
            Line(best.temperature, best.own[:, axis] * unit.factor, "without", "series:1", style="dashed"),
        )
        panels.append(Panel(drawn, f"sigma {name} [{unit.shown}]", log=True))
    return Chart(
        tuple(panels), "temperature [°C]", "How sure the map will be", "one standard deviation, level included"
    )


def document(found: ShortSoakPlan, unit: BiasUnit, said: list[str]) -> dict[str, Any]:
    """Return the plan as JSON holds it: SI, temperatures in degC."""
    best, axes = found.chosen, found.family.axes
    return {
        "schema": 1,
        "driftlab": __version__,
        "hours": found.hours[0],
        "range": [found.chamber.low, found.chamber.high],
        "unit": unit.si,
        "channel": found.family.channel,
        "units": found.family.units,
        "noise": dict(zip(axes, found.noise, strict=True)),
        "walk": dict(zip(axes, found.walk, strict=True)),
        "profile": _as_json(best)
        | {"knots": {"time_s": best.profile.time, "temperature_degC": best.profile.temperature}},
        "expected_sigma": {
            "unit": unit.si,
            "temperature_degC": best.temperature,
            **{axis: best.sigma[:, k] for k, axis in enumerate(axes)},
        },
        "tried": [_as_json(short) for short in found.tried],
        "target": None if found.target is None
        else {"sigma": found.target, "reached": found.reached, "hours_without_family": found.own_hours},
        "notes": said,
    }  # fmt: skip


def _as_json(short: ShortSoak) -> dict[str, Any]:
    return {
        "share": short.share,
        "place": short.place,
        "hours": short.profile.hours,
        "name": short.profile.name,
        "covered_degC": short.saw,
        "sigma": short.score,
        "without_family": short.own_score,
    }


def write_report(path: Path, found: ShortSoakPlan, unit: BiasUnit, said: list[str], title: str) -> None:
    """Write the page."""
    heads, rows = cells(found, unit)
    profile, lag = found.chosen.profile, found.chamber.lag
    shown = profile_chart(profile, lag, "What to soak", f"{profile.name}; the set points are in setpoints.csv")
    write_page(
        path, "plan_family", title=title, lead=headline(found, unit), notes=said, heads=heads, rows=rows,
        profile=shown, charts=[hours_chart(found, unit), sigma_chart(found, unit)], setpoints=setpoints(profile),
    )  # fmt: skip
