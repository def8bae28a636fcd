"""A recording as a figure: every channel over time."""

from __future__ import annotations

from collections.abc import Mapping

from driftlab.evaluation.overview import thin
from driftlab.reports.charts import Chart, Clock, Line, Panel, series
from fusion_core.chunk import Array


def chart(columns: Mapping[str, Array], labels: Mapping[str, tuple[str, ...]], units: Mapping[str, str]) -> Chart:
    """Return the channels (N,) or (N, d) below one another, over `time` (N,), s; `labels` are of their columns."""
    time = columns["time"]
    rows, clock = thin(len(time)), Clock(float(time[0]), float(time[-1]))
    t, panels = clock(time[rows]), []
    for name in (name for name in columns if name != "time"):
        values = columns[name][rows].reshape(len(rows), -1)
        d = values.shape[1]
        texts = [name] if d == 1 else labels.get(name) or [str(k) for k in range(d)]
        roles = ["data"] if d == 1 else [series(k) for k in range(d)]
        lines = tuple(Line(t, *column) for column in zip(values.T, texts, roles, strict=True))
        panels.append(Panel(lines, f"{name} [{units[name]}]" if name in units else name))
    return Chart(tuple(panels), f"time [{clock.unit}]", "Every channel")
