"""A recording as a figure: every channel over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from driftlab.judging.overview import thin
from driftlab.reports.plots import COLOURS, LIMITS, clock, margins, plain_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fusion_core.chunk import Array


def figure(columns: Mapping[str, Array], labels: Mapping[str, tuple[str, ...]], units: Mapping[str, str]) -> Figure:
    """Draw the channels (N,) or (N, d) below one another, over `time` (N,), s."""
    from matplotlib.figure import Figure

    names = [name for name in columns if name != "time"]
    result = Figure(figsize=(10, 1.8 * len(names) + 0.6))
    grid = result.subplots(len(names), 1, sharex=True, squeeze=False, gridspec_kw=margins(result))
    panels: list[Axes] = list(grid[:, 0])
    keep = thin(len(columns["time"]))
    t, unit = clock(columns["time"][keep])
    for name, panel in zip(names, panels, strict=True):
        values = columns[name][keep].reshape(len(keep), -1)
        texts = labels.get(name) or [str(k) for k in range(values.shape[1])]
        for k, (column, text) in enumerate(zip(values.T, texts, strict=True)):
            panel.plot(t, column, lw=0.8, color=COLOURS[k % len(COLOURS)], label=text)
        if values.shape[1] > 1:
            panel.legend(ncols=values.shape[1], fontsize=8, frameon=False, loc="upper right")
        panel.set_ylabel(plain_label(f"{name} [{units[name]}]" if name in units else name))
        panel.ticklabel_format(axis="y", scilimits=LIMITS)
        panel.grid(alpha=0.25)
    panels[-1].set_xlabel(f"time [{unit}]")
    return result
