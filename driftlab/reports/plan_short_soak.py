"""A plan with a family as a page: a table of parts of the range and hours, sentences, charts and JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.maps.assessment import text
from driftlab.planning.search import RatedProfile
from driftlab.planning.short_soak import SHARES, ShortSoakPlan
from driftlab.reports import plan as plan_page
from driftlab.reports.charts import Chart, Line
from driftlab.reports.family_map import GAUSSIAN, measured_on
from driftlab.reports.plan import NOTES, PlanPage, chosen_profile, hours_chart, sigma_panels
from driftlab.reports.tables import TextTable
from driftlab.units import BiasUnit


def page_of(plan: ShortSoakPlan, unit: BiasUnit, noise_of: str) -> PlanPage:
    """Return the page of a plan; `noise_of` says where noise and walk are from."""
    lines, table = _lines(plan, unit, noise_of), _sigmas(plan, unit)
    chart, sigma = _hours(plan, unit), _sigma(plan, unit)
    parts = [
        chosen_profile(plan.chosen.profile, plan.chamber.lag),
        ("Expected sigma with the family (without), at the best place", table),
        (NOTES, lines),
        (chart.title, chart),
        (sigma.title, sigma),
    ]
    return PlanPage(_headline(plan, unit), lines, _document(plan, unit, lines), table, chart, parts)


def _headline(plan: ShortSoakPlan, unit: BiasUnit) -> str:
    """Return the soak to make, and the sigma that its map will have."""
    best, chamber = plan.chosen, plan.chamber
    part = "the whole range" if best.share == 1 else f"the {best.place} {100 * best.share:.0f} % of the range"
    soak = (
        f"soak {best.covered[0]:.3g} to {best.covered[1]:.3g} °C ({part}) in {best.profile.hours:.3g} h: with the "
        f"family of {plan.family.units} units the map is then known to {_size(best.score, unit)} from "
        f"{chamber.low:.4g} to {chamber.high:.4g} °C (rms, worst axis, level included)"
    )
    if plan.reached:
        return soak
    return f"{_size(plan.target or 0.0, unit)} is reached by no part and no length of the table; the nearest: {soak}"


def _lines(plan: ShortSoakPlan, unit: BiasUnit, noise_of: str) -> list[str]:
    """Return the gain by the family, and the assumptions of the plan, a sentence each."""
    without = f"the same soak without the family leaves {_size(plan.chosen.own_score, unit)}, with the best polynomial"
    sentences = [without]
    if plan.target is not None:
        target = _size(plan.target, unit)
        sentences.append(
            f"without the family {target} takes {plan.own_hours:.3g} h"
            if plan.own_hours is not None
            else f"without the family no part and no length of the table reaches {target}"
        )
    noise, walk = (_size(float(np.max(v)), unit) for v in (plan.noise, plan.walk))
    bands = plan.family.bands
    return [
        *sentences,
        f"it stands on noise {noise}/sqrt(Hz) and walk {walk}/sqrt(s), worst axis: {noise_of}",
        GAUSSIAN if bands is None else measured_on(bands.units),
        "a unit that is not as the family is off by more: `driftlab fit-map --family` says whether it is",
    ]


def _size(value: float, unit: BiasUnit) -> str:
    return f"{text(value * unit.factor)} {unit.shown}"


def _sigmas(plan: ShortSoakPlan, unit: BiasUnit) -> TextTable:
    """Return sigma with the family, and the error without, by share of the range and hours."""

    def cell(best: RatedProfile | None) -> str:
        if best is None:
            return ""
        return f"{text(best.score * unit.factor)} ({text(best.own_score * unit.factor)})\n{best.place}"

    rows = [[f"{100 * share:.0f} %", *(cell(plan.best(share, hours)) for hours in plan.hours)] for share in SHARES]
    title = f"expected sigma over the range with the family (without) [{unit.shown}]"
    return TextTable(["range", *(f"{hours:.3g} h" for hours in plan.hours)], rows, title, texts=0)


def _hours(plan: ShortSoakPlan, unit: BiasUnit) -> Chart:
    """Return sigma over the length of the soak, a line for each share of the range."""
    drawn, without = [], []
    for k, share in enumerate(SHARES):
        soaks = sorted((soak for soak in plan.tried if soak.share == share), key=lambda soak: soak.profile.hours)
        if not soaks:
            continue
        hours, sigma, alone = np.array([(soak.profile.hours, soak.score, soak.own_score) for soak in soaks]).T
        sigma, alone = np.minimum.accumulate([sigma, alone], axis=1)  # who has more hours may stop earlier
        drawn.append(Line(hours, sigma * unit.factor, f"{100 * share:.0f} % of the range", f"series:{k}"))
        if share == 1:
            without.append(Line(hours, alone * unit.factor, "all of it, without the family", "data", style="dashed"))
    caption = "each point: the best place of that share"
    return hours_chart([*drawn, *without], plan.target, unit, "Sigma by length of soak", caption)


def _sigma(plan: ShortSoakPlan, unit: BiasUnit) -> Chart:
    """Return sigma over temperature of what was chosen, with the family and without."""
    best = plan.chosen
    curves = [(best.temperature, best.sigma, "with the family"), (best.temperature, best.without_family, "without")]
    panels = sigma_panels(plan.family.axes, curves, unit)
    return Chart(panels, "temperature [°C]", "Predicted sigma of the map", "one standard deviation, level included")


def _document(plan: ShortSoakPlan, unit: BiasUnit, notes: list[str]) -> dict[str, Any]:
    best, axes = plan.chosen, plan.family.axes

    def content(soak: RatedProfile) -> dict[str, Any]:
        return {
            "share": soak.share,
            "place": soak.place,
            "hours": soak.profile.hours,
            "name": soak.profile.name,
            "covered_degC": soak.covered,
            "sigma": soak.score,
            "without_family": soak.own_score,
        }

    target = {"sigma": plan.target, "reached": plan.reached, "hours_without_family": plan.own_hours}
    return {
        "schema": 1,
        "driftlab": __version__,
        "hours": plan.hours[0],
        "range": [plan.chamber.low, plan.chamber.high],
        "unit": unit.si,
        "channel": plan.family.channel,
        "units": plan.family.units,
        "noise": plan_page.by_axis(axes, plan.noise),
        "walk": plan_page.by_axis(axes, plan.walk),
        "profile": content(best) | plan_page.knots(best.profile),
        "expected_sigma": plan_page.expected_sigma(axes, unit, best),
        "tried": list(map(content, plan.tried)),
        "target": None if plan.target is None else target,
        "notes": notes,
    }
