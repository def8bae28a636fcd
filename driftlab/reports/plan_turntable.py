"""The page of a plan for a turntable: the sequence, the sigma of each term, and what the plan rests on."""

from __future__ import annotations

import numpy as np

from driftlab.planning.turntable import GAP, NEAR, ORDER, SETTLE, TurntablePlan
from driftlab.reports.charts import Chart, Line, Panel, series
from driftlab.reports.plan import NOTES, PlanPage, chosen_profile, head, knots
from driftlab.reports.tables import TextTable
from driftlab.reports.triad import unit_of
from driftlab.triad.model import AXES, GROUPS, TERMS


def page_of(plan: TurntablePlan) -> PlanPage:
    """Return the page of a plan."""
    best, unit = plan.chosen, plan.subject.unit
    worst = {name: float(np.max(best.sigma[:, some])) for name, some in GROUPS.items()}
    sizes = []
    for name, value in worst.items():
        shown, factor = unit_of(GROUPS[name][0], unit)
        sizes.append(f"{name} to {value * factor:.2g} {shown}")
    rate, low, high = np.rad2deg(plan.rate), plan.chamber.low, plan.chamber.high
    headline = (
        f"record: {best.levels} temperatures from {low:.4g} to {high:.4g} °C, at each {best.rounds} "
        f"round{'s' * (best.rounds > 1)} of x, y and z, {rate:.4g} deg/s both ways; {', '.join(sizes)} (one sigma, "
        "where it is largest)"
    )
    start, stop = best.segments[0][:2]
    lines = [
        "segments.csv is the table that `stimulus: {kind: rate_table, segments: segments.csv}` reads; the recording "
        "has to begin with the profile of setpoints.csv",
        f"a segment lasts {stop - start:.0f} s, after {GAP:.0f} s to turn the unit over; its first {SETTLE:.0f} s are "
        "left out",
        f"each term is taken for a parabola over temperature (order {ORDER}), and the table and its axes as exact",
        f"of sequences within {100 * (NEAR - 1):.0f} % of the best, the one with the most temperatures is taken: it "
        "shows a curve that is no parabola",
    ]
    rows = [
        [f"{one.levels} temperatures, {one.rounds} rounds" + " (chosen)" * (one is best), f"{len(one.segments)}"]
        + [f"{np.max(one.sigma[:, some]) * unit_of(some[0], unit)[1]:.2g}" for some in GROUPS.values()]
        for one in sorted(plan.tried, key=lambda one: one is not best)
    ]
    heads = [f"{name}\n[{unit_of(some[0], unit)[0]}]" for name, some in GROUPS.items()]
    table = TextTable(["sequence", "segments", *heads], rows)
    chart = _chart(plan)
    parts = [chosen_profile(best.profile, plan.chamber.lag), ("Sequences of these hours", table), (NOTES, lines)]
    document = {
        **head(plan.subject, plan.chamber, plan.hours, table_rate_rad_s=plan.rate),
        "headline": headline, "notes": lines, "levels": best.levels, "rounds": best.rounds, **knots(best.profile),
        "segments": [one._asdict() for one in best.segments],
        "sigma": {"temperature_degC": best.temperature, **dict(zip(TERMS, best.sigma.T, strict=True))},
    }  # fmt: skip
    return PlanPage(headline, lines, document, table, chart, [*parts, (chart.title, chart)])


def _chart(plan: TurntablePlan) -> Chart:
    """Return the sigma of the terms over temperature."""
    best, T = plan.chosen, plan.chosen.temperature
    panels = []
    for name, some in GROUPS.items():
        shown, factor = unit_of(some[0], plan.subject.unit)
        lines = [Line(T, best.sigma[:, j] * factor, TERMS[j], series(k % len(AXES))) for k, j in enumerate(some)]
        panels.append(Panel(tuple(lines), f"sigma, {name} [{shown}]"))
    return Chart(tuple(panels), "temperature [°C]", "Sigma of the terms", "One standard deviation that is expected.")
