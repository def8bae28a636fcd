"""Figures of the loop; drawn from at most a few thousand points, however long the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.overview import thin
from driftlab.loop.gates import FAST, SLOW
from driftlab.loop.state import name_of
from driftlab.reports.plots import COLOURS, LIMITS, REFERENCE, clock, margins, room

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftlab.loop.outcome import Outcome
    from driftlab.loop.predicted import LeftOut
    from driftlab.loop.verdict import Verdict
    from driftlab.units import BiasUnit

BEFORE, AFTER = REFERENCE, COLOURS[0]
WARMING, COOLING = "#c8553d", "#0b6e99"
MOST = 1.5  # ratio of errors that is drawn


def left_out_figure(parts: Sequence[LeftOut], axes: Sequence[str], shown: BiasUnit) -> Figure:
    """Draw the errors of what was left out of one recording over time, of the declared model and of the final one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 1.8 * len(axes) + 0.6))
    panels = figure.subplots(len(axes), 1, sharex=True, squeeze=False, gridspec_kw=margins(figure))[:, 0]
    for k, part in enumerate(parts):
        hours, unit = clock(part.t)
        for axis, panel in enumerate(panels):
            for name, values, colour in (("before", part.before, BEFORE), ("after", part.after, AFTER)):
                label = name if k == 0 else None
                panel.plot(hours, values[:, axis] * shown.factor, color=colour, lw=0.9, label=label)
            panel.set_ylabel(f"error {axes[axis]} [{shown.shown}]")
            panel.ticklabel_format(axis="y", scilimits=LIMITS)
            panel.grid(alpha=0.25)
    for panel in panels:
        panel.axhline(0, color="#333333", lw=0.5)
    panels[0].legend(ncols=2, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    panels[-1].set_xlabel(f"time [{unit}]")
    return figure


def bias_figure(outcome: Outcome, axes: Sequence[str]) -> Figure:
    """Draw the bias that was measured and those that were predicted, before and after, with two deviations."""
    from matplotlib.figure import Figure

    d = len(axes)
    figure = Figure(figsize=(10, 1.8 * d + 0.6))
    panels = figure.subplots(d, 1, sharex=True, squeeze=False, gridspec_kw=margins(figure))[:, 0]
    keep = thin(len(outcome.t))
    hours, unit = clock(outcome.t, outcome.summaries[0]["t"]["first_row_s"])
    for axis, panel in enumerate(panels):
        panel.plot(
            hours[keep], outcome.reference[keep, axis] * outcome.unit.factor, color="#333333", lw=0.9, label="measured"
        )
        for name, values, sigma, colour in (
            ("before", outcome.before, outcome.before_sigma, BEFORE),
            ("after", outcome.after, outcome.after_sigma, AFTER),
        ):
            middle, spread = values[keep, axis] * outcome.unit.factor, 2 * sigma[keep, axis] * outcome.unit.factor
            panel.fill_between(hours[keep], middle - spread, middle + spread, color=colour, alpha=0.15, lw=0)
            panel.plot(hours[keep], middle, color=colour, lw=0.9, label=name)
        panel.set_ylabel(f"bias {axes[axis]} [{outcome.unit.shown}]")
        panel.ticklabel_format(axis="y", scilimits=LIMITS)
        panel.grid(alpha=0.25)
    panels[0].legend(ncols=3, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    panels[-1].set_xlabel(f"time from the first row [{unit}]")
    return figure


def error_figure(outcome: Outcome, axes: Sequence[str]) -> Figure:
    """Draw the error of the open-loop prediction over time, before and after, with two deviations; and temperature."""
    from matplotlib.figure import Figure

    d = len(axes)
    figure = Figure(figsize=(10, 1.8 * (d + 1) + 0.5))
    rows = d + int(outcome.temperature is not None)
    panels = figure.subplots(rows, 1, sharex=True, squeeze=False, gridspec_kw=margins(figure))[:, 0]
    keep = thin(len(outcome.t))
    hours, unit = clock(outcome.t, outcome.summaries[0]["t"]["first_row_s"])
    for axis in range(d):
        for name, values, sigma, colour in (
            ("before", outcome.before, outcome.before_sigma, BEFORE),
            ("after", outcome.after, outcome.after_sigma, AFTER),
        ):
            error, spread = (
                (values - outcome.reference)[:, axis] * outcome.unit.factor,
                2 * sigma[keep, axis] * outcome.unit.factor,
            )
            panels[axis].fill_between(hours[keep], -spread, spread, color=colour, alpha=0.15, lw=0)
            panels[axis].plot(hours[keep], error[keep], color=colour, lw=0.9, label=name)
        panels[axis].axhline(0, color="#333333", lw=0.5)
        panels[axis].set_ylabel(f"error {axes[axis]} [{outcome.unit.shown}]")
        panels[axis].ticklabel_format(axis="y", scilimits=LIMITS)
        panels[axis].grid(alpha=0.25)
    panels[0].legend(ncols=2, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    if outcome.temperature is not None:
        panels[-1].plot(hours[keep], outcome.temperature[keep], color="#333333", lw=1)
        panels[-1].set_ylabel("temperature [°C]")
    panels[-1].set_xlabel(f"time from the first row [{unit}]")
    panels[-1].grid(alpha=0.25)
    return figure


def loop_figure(outcome: Outcome, axes: Sequence[str]) -> Figure:
    """Draw the error over temperature, before and after, warming up and cooling down in two colours."""
    from matplotlib.figure import Figure

    d = len(axes)
    assert outcome.temperature is not None
    figure = Figure(figsize=(10, 2.1 * d + 0.5))
    panels = figure.subplots(
        d, 2, sharex=True, sharey="row", squeeze=False, gridspec_kw=margins(figure) | {"wspace": 0.04}
    )
    keep = thin(len(outcome.t))
    t, T = outcome.t[keep], outcome.temperature[keep]
    rate = np.gradient(T, t) if len(t) > 1 else np.zeros(len(t))
    for axis in range(d):
        for column, values in enumerate((outcome.before, outcome.after)):
            panel = panels[axis, column]
            error = (values - outcome.reference)[:, axis] * outcome.unit.factor
            error = error[keep]
            for name, rows, colour in (("warming up", rate >= 0, WARMING), ("cooling down", rate < 0, COOLING)):
                panel.plot(T[rows], error[rows], ".", ms=2, color=colour, label=name)
            panel.grid(alpha=0.25)
        panels[axis, 0].set_ylabel(f"error {axes[axis]} [{outcome.unit.shown}]")
        panels[axis, 0].ticklabel_format(axis="y", scilimits=LIMITS)
    for column, title in enumerate(("before", "after")):
        panels[0, column].set_title(title, fontsize=10)
        panels[-1, column].set_xlabel("temperature [°C]")
    panels[0, 0].legend(fontsize=8, markerscale=4, frameon=False)
    return figure


def ratio_figure(verdict: Verdict) -> Figure:
    """Draw by how much each effect changes the error on what was left out, and what is needed."""
    from matplotlib.figure import Figure

    rows = [(name_of(f.effect), f.trial.evidence.ratio, AFTER) for f in verdict.findings]
    rows += [(name_of(trial.term.effect), trial.evidence.ratio, BEFORE) for trial in verdict.rejected]
    left = room([name for name, *_ in rows], 10)
    figure = Figure(figsize=(max(10, left + 7), 0.28 * len(rows) + 1.1))
    panel = figure.subplots(gridspec_kw=margins(figure, left=left))
    places = np.arange(len(rows))[::-1]
    shown = [min(float(np.sqrt(ratio)), MOST) for _, ratio, _ in rows]
    panel.barh(places, shown, color=[colour for *_, colour in rows], height=0.7)
    for needed, label, style in (
        (FAST, "needed, seen at fast times too", "--"),
        (SLOW, "needed, at slow times alone", ":"),
    ):
        panel.axvline(float(np.sqrt(needed)), color=WARMING, ls=style, label=label)
    panel.set_yticks(places, [name for name, *_ in rows])
    panel.set_xlim(0, MOST)
    panel.set_xlabel("error on left-out recordings, with / without [1]   (blue: added; others beside these)")
    panel.grid(alpha=0.25, axis="x")
    panel.legend(fontsize=8, ncols=2, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    return figure
