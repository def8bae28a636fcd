"""A recording as a figure: every channel over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from driftlab.evaluation.overview import thin
from driftlab.reports.charts import Chart, Line, Panel, clock, series

if TYPE_CHECKING:
    from fusion_core.chunk import Array


def chart(columns: Mapping[str, Array], labels: Mapping[str, tuple[str, ...]], units: Mapping[str, str]) -> Chart:
    """Return the channels (N,) or (N, d) below one another, over `time` (N,), s; `labels` are of their columns."""
    time = columns["time"]
    keep = thin(len(time))
    at, unit = clock(float(time[0]), float(time[-1]))
    t, panels = at(time[keep]), []
    for name in columns:
        if name == "time":
            continue
        values = columns[name][keep].reshape(len(keep), -1)
        if values.shape[1] == 1:
            lines: tuple[Line, ...] = (Line(t, values[:, 0], name, "data"),)
        else:
            texts = labels.get(name) or [str(k) for k in range(values.shape[1])]
            lines = tuple(Line(t, y, text, series(k)) for k, (y, text) in enumerate(zip(values.T, texts, strict=True)))
        panels.append(Panel(lines, f"{name} [{units[name]}]" if name in units else name))
    return Chart(tuple(panels), f"time [{unit}]", "Every channel")
