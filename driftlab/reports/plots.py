"""Figures of a run, as SVG text; drawn from at most a few thousand points, however long the recording."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.judging.overview import SMOOTHED, thin
from driftlab.judging.yardsticks import moving_average

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fusion_core.chunk import Array
    from fusion_core.contracts import Sensor

COLOURS = ("#0b6e99", "#c8553d", "#4c8c4a", "#7a5195")
REFERENCE = "#bdbdbd"
LIMITS = (-4, 5)  # powers of ten beyond which an axis gets its factor written above: wide numbers push the label out


def bias_figure(runs: dict[str, dict[str, Array]], sensor: Sensor, first_row: float | None = None) -> Figure:
    """Draw, axis by axis, the 30 s average of a sensor, the estimates and the coasting predictions, and temperature.

    The runs are of one recording; their names go into the legend (an empty one for a single run). Time counts from
    the recording's first row.
    """
    from matplotlib.figure import Figure

    first = next(iter(runs.values()))
    d = first["bias"].shape[1]
    has_T = "temperature" in first
    figure = Figure(figsize=(10, 2.1 * (d + has_T) + 0.6))
    panels = np.atleast_1d(figure.subplots(d + has_T, 1, sharex=True, gridspec_kw=margins(figure)))
    keep = thin(len(first["t"]))
    hours, unit = clock(first["t"], first_row)
    reference = first.get("reference")
    if reference is None:
        reference = moving_average(first["t"], first["rate"], first["tau"], first["still"].astype(bool))
    factor, average = sensor.factor, plain_label(f"{sensor.channel}, 30 s average")
    for axis in range(d):
        panel: Axes = panels[axis]
        panel.plot(hours[keep], reference[keep, axis] * factor, color=REFERENCE, lw=0.8, label=average)
        for k, (name, run) in enumerate(runs.items()):
            width = 1.0 if k == len(runs) - 1 else 2.8  # a later one leaves it visible
            t = clock(run["t"], first_row)[0]
            line = {"color": COLOURS[k % len(COLOURS)], "lw": width}
            _draw_run(panel, run, t, axis, factor, plain_label(name), line)
        panel.set_ylabel(f"bias {sensor.axes[axis]} [{sensor.shown}]")
        panel.ticklabel_format(axis="y", scilimits=LIMITS)
        panel.grid(alpha=0.25)
    panels[0].legend(ncols=3, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    if has_T:
        panels[-1].plot(hours[keep], first["temperature"][keep], color="#333333", lw=1)
        panels[-1].set_ylabel("temperature [°C]")
        panels[-1].grid(alpha=0.25)
    panels[-1].set_xlabel(f"time from the first row [{unit}]")
    return figure


def _draw_run(
    panel: Axes, run: dict[str, Array], t: Array, axis: int, factor: float, name: str, line: dict[str, Any]
) -> None:
    """Draw the estimate and the prediction of one axis with two deviations each, over the times t (N,)."""
    rows = thin(len(t))
    t, colour = t[rows], line["color"]
    coasting = np.isfinite(run["coast"][rows, 0])
    bias, sigma, coast, spread = (
        run[column][rows, axis] * factor for column in ("bias", "bias_sigma", "coast", "coast_sigma")
    )
    low, high = (bias - 2 * sigma)[coasting], (bias + 2 * sigma)[coasting]
    panel.plot(t[coasting], bias[coasting], label=f"{name} estimate".strip(), **line)
    panel.fill_between(t[coasting], low, high, color=colour, alpha=0.15, lw=0)
    panel.fill_between(t, coast - 2 * spread, coast + 2 * spread, color=colour, alpha=0.08, lw=0)
    panel.plot(t, coast, ls="--", label=f"{name} coasting".strip(), **line)
    if SMOOTHED in run:
        label = f"{name} given all of it".strip()
        panel.plot(t, run[SMOOTHED][rows, axis] * factor, color="black", lw=0.8, ls=":", label=label)


def margins(figure: Figure, left: float = 0.8, bottom: float = 0.5) -> dict[str, float]:
    """Return fixed margins, in inches: a layout fitted to the labels draws everything once more, 0.3 s a figure."""
    width, height = figure.get_size_inches()
    return {
        "left": left / width, "right": 1 - 0.1 / width, "bottom": bottom / height, "top": 1 - 0.6 / height,
        "hspace": 0.08,
    }  # fmt: skip


def room(names: Sequence[str], size: float) -> float:
    """Return the inches that the widest of these names takes beside an axis, at a font size in points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(size=size)
    widths = [text_to_path.get_text_width_height_descent(name, font, False)[0] for name in names]
    return 0.2 + max(widths, default=0.0) / 72


def plain_label(name: str) -> str:
    """Return a name for a legend: matplotlib takes what is between two $ for a formula."""
    return name.replace("$", r"\$")


def svg(figure: Figure) -> str:
    """Return a figure as SVG text, the same for the same data."""
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "driftlab", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()[buffer.getvalue().index("<svg") :]


def clock(t: Array, first_row: float | None = None) -> tuple[Array, str]:
    """Return the time from the first row (or else the first sample) in a unit that suits it, and the unit."""
    zero = (t[0] if len(t) else 0.0) if first_row is None else first_row
    span = t[-1] - zero if len(t) else 0.0
    for limit, scale, unit in ((600.0, 1.0, "s"), (7200.0, 60.0, "min")):
        if span < limit:
            return (t - zero) / scale, unit
    return (t - zero) / 3600.0, "h"
