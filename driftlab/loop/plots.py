"""Figures of the loop; drawn from at most a few thousand points, however long the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from driftlab.loop.search import name_of
from driftlab.overview import thin
from driftlab.plots import COLOURS, LIMITS, REFERENCE, clock, margins, room
from driftlab.summary import DEG_H

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftlab.loop.closing import Outcome
    from driftlab.loop.verdict import Verdict

BEFORE, AFTER = REFERENCE, COLOURS[0]
WARMING, COOLING = "#c8553d", "#0b6e99"


def error_figure(outcome: Outcome, axes: Sequence[str]) -> Figure:
    """Draw the error of the open-loop prediction over time, before and after, with two deviations; and temperature."""
    from matplotlib.figure import Figure

    d = len(axes)
    figure = Figure(figsize=(10, 1.8 * (d + 1) + 0.5))
    panels = np.atleast_1d(figure.subplots(d + 1, 1, sharex=True, gridspec_kw=margins(figure)))
    keep = thin(len(outcome.t))
    hours, unit = clock(outcome.t)
    for axis in range(d):
        for name, values, sigma, colour in (
            ("before", outcome.before, outcome.before_sigma, BEFORE),
            ("after", outcome.after, outcome.after_sigma, AFTER),
        ):
            error, spread = (values - outcome.reference)[:, axis] * DEG_H, 2 * sigma[keep, axis] * DEG_H
            panels[axis].fill_between(hours[keep], -spread, spread, color=colour, alpha=0.15, lw=0)
            panels[axis].plot(hours[keep], error[keep], color=colour, lw=0.9, label=name)
        panels[axis].axhline(0, color="#333333", lw=0.5)
        panels[axis].set_ylabel(f"error {axes[axis]} [deg/h]")
        panels[axis].ticklabel_format(axis="y", scilimits=LIMITS)
        panels[axis].grid(alpha=0.25)
    panels[0].legend(ncols=2, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    panels[-1].plot(hours[keep], outcome.temperature[keep], color="#333333", lw=1)
    panels[-1].set_ylabel("temperature [°C]")
    panels[-1].set_xlabel(f"time [{unit}]")
    panels[-1].grid(alpha=0.25)
    return figure


def loop_figure(outcome: Outcome, axes: Sequence[str]) -> Figure:
    """Draw the error over temperature, before and after, warming up and cooling down in two colours."""
    from matplotlib.figure import Figure

    d = len(axes)
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
            error = (values - outcome.reference)[:, axis] * DEG_H
            error = error[keep]
            for name, rows, colour in (("warming up", rate >= 0, WARMING), ("cooling down", rate < 0, COOLING)):
                panel.plot(T[rows], error[rows], ".", ms=2, color=colour, label=name)
            panel.grid(alpha=0.25)
        panels[axis, 0].set_ylabel(f"error {axes[axis]} [deg/h]")
        panels[axis, 0].ticklabel_format(axis="y", scilimits=LIMITS)
    for column, title in enumerate(("before", "after")):
        panels[0, column].set_title(title, fontsize=10)
        panels[-1, column].set_xlabel("temperature [°C]")
    panels[0, 0].legend(fontsize=8, markerscale=4, frameon=False)
    return figure


def score_figure(verdict: Verdict) -> Figure:
    """Draw what each effect gains and what it would have to gain."""
    from matplotlib.figure import Figure

    rows = [(name_of(f.addition.effect), f.addition.gain, f.addition.threshold, AFTER) for f in verdict.findings]
    rows += [(name_of(t.effect), t.gain, t.threshold, BEFORE) for t in verdict.rejected]
    left = room([name for name, *_ in rows], 10)
    figure = Figure(figsize=(max(10, left + 7), 0.28 * len(rows) + 1.1))
    panel = figure.subplots(gridspec_kw=margins(figure, left=left))
    places = np.arange(len(rows))[::-1]
    panel.barh(places, [max(gain, 0.1) for _, gain, _, _ in rows], color=[colour for *_, colour in rows], height=0.7)
    panel.plot([threshold for _, _, threshold, _ in rows], places, "|", ms=12, mew=2, color=WARMING, label="needed")
    panel.set_yticks(places, [name for name, *_ in rows])
    panel.set_xscale("log")
    panel.set_xlim(left=0.1)
    panel.set_xlabel("gain in log-likelihood [nats]   (blue: kept; for those not kept, beside the effects that were)")
    panel.grid(alpha=0.25, axis="x")
    panel.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    return figure


def collinearity_figure(verdict: Verdict) -> Figure:
    """Draw the correlations of the effects' innovations."""
    from matplotlib.figure import Figure

    k = len(verdict.names)
    side, names = max(2.2, 0.45 * k), room(verdict.names, 8)
    figure = Figure(figsize=(names + side + 1.2, 0.1 + side + names))
    width, height = figure.get_size_inches()
    panel = figure.add_axes((names / width, names / height, side / width, side / height))
    image = panel.imshow(verdict.collinearity, vmin=0, vmax=1, cmap="Blues")
    panel.set_xticks(range(k), verdict.names, rotation=60, ha="right", fontsize=8)
    panel.set_yticks(range(k), verdict.names, fontsize=8)
    for i in range(k):
        for j in range(k):
            value = verdict.collinearity[i, j]
            panel.text(
                j, i, f"{value:.2f}", ha="center", va="center", fontsize=6, color="white" if value > 0.6 else "black"
            )
    place = ((names + side + 0.2) / width, names / height, 0.15 / width, side / height)
    figure.colorbar(image, cax=figure.add_axes(place), label="correlation of innovations [1]")
    return figure
