"""The figures of the loop, each said once; drawn from at most a few thousand points, however long the recordings.

N times, n of them drawn, d axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.judging.overview import thin
from driftlab.reports.charts import Chart, Line, Panel, Shade
from driftlab.reports.plots import clock

if TYPE_CHECKING:
    from driftlab.loop.outcome import Outcome
    from driftlab.loop.predicted import LeftOut
    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array

BEFORE, AFTER = "series:1", "series:0"
STRETCHES = 600  # of an error, whose smallest and largest value are drawn
ROOM = 0.35  # of the height of the lines, beyond them, that a wide band may take to either side
SHADES = (("refused_s", "refused, after", "refused"), ("motion_s", "moved", "moving"))


def prediction_chart(outcome: Outcome, axes: Sequence[str]) -> Chart:
    """Return what was measured and predicted of each axis, before and after, the errors below, and temperature."""
    rows = thin(len(outcome.t))
    zero = outcome.summaries[0]["t"]["first_row_s"]
    hours, unit = clock(outcome.t, zero)
    scale = (hours[-1] - hours[0]) / max(outcome.t[-1] - outcome.t[0], 1e-9) if len(hours) > 1 else 1.0
    shades = tuple(_shades(outcome, zero, scale))
    panels = []
    for k, axis in enumerate(axes):
        lines = tuple(_bias(outcome, hours, rows, k))
        panels.append(Panel(lines, f"bias {axis} [{outcome.unit.shown}]", shades, height=1.2, span=_span(lines)))
        lines = tuple(_errors(outcome, hours, rows, k))
        panels.append(Panel(lines, f"error {axis} [{outcome.unit.shown}]", shades, span=_span(lines)))
    if outcome.temperature is not None:
        line = Line(hours[rows], outcome.temperature[rows], "temperature", "temperature")
        panels.append(Panel((line,), "temperature [°C]", shades, height=0.7))
    return Chart(tuple(panels), f"time from the first row [{unit}]", "Measured and predicted, before and after")


def _sides(outcome: Outcome) -> Iterator[tuple[str, Array, Array, str]]:
    yield "before", outcome.before, outcome.before_sigma, BEFORE
    yield "after", outcome.after, outcome.after_sigma, AFTER


def _bias(outcome: Outcome, hours: Array, rows: Array, axis: int) -> Iterator[Line]:
    factor = outcome.unit.factor
    yield Line(hours[rows], outcome.reference[rows, axis] * factor, "measured", "reference")
    for name, values, sigma, role in _sides(outcome):
        middle, reach = values[rows, axis] * factor, 2 * sigma[rows, axis] * factor
        yield Line(hours[rows], middle, f"{name}, ± 2σ", role, middle - reach, middle + reach)


def _errors(outcome: Outcome, hours: Array, rows: Array, axis: int) -> Iterator[Line]:
    factor = outcome.unit.factor
    for name, _, sigma, role in _sides(outcome):
        reach = 2 * sigma[rows, axis] * factor
        yield Line(hours[rows], None, f"{name}, ± 2σ", role, -reach, reach)
    for name, values, _, role in _sides(outcome):
        error = (values - outcome.reference)[:, axis] * factor
        own = _extremes(error)
        yield Line(hours[own], error[own], f"{name}, ± 2σ", role)


def _extremes(values: Array) -> NDArray[np.int64]:
    """Return the rows of the smallest and the largest value of each stretch: no spike is left out."""
    if len(values) <= 2 * STRETCHES:
        return np.arange(len(values))
    filled: Array = np.where(np.isfinite(values), values, 0.0)
    parts = np.linspace(0, len(values), STRETCHES + 1).astype(int)
    found = [start + f(filled[start:stop]) for start, stop in pairwise(parts) for f in (np.argmin, np.argmax)]
    return np.unique(np.array(found, dtype=np.int64))


def _span(lines: tuple[Line, ...]) -> tuple[float, float] | None:
    """Return from where to where y is drawn: lines whole, and of their bands as much as leaves the lines legible."""
    found = _reach([line.y for line in lines])
    if found is None:
        return None
    low, high = found
    bands = _reach([end for line in lines for end in (line.low, line.high)]) or found
    room = (high - low) * ROOM or abs(high) * 0.1 or 1.0
    low, high = max(min(bands[0], low), low - room), min(max(bands[1], high), high + room)
    margin = 0.04 * (high - low)
    return low - margin, high + margin


def _reach(parts: Sequence[Array | None]) -> tuple[float, float] | None:
    values = [float(end) for part in parts if part is not None for end in (np.nanmin(part), np.nanmax(part))]
    return (min(values), max(values)) if np.all(np.isfinite(values)) and values else None


def _shades(outcome: Outcome, zero: float, scale: float) -> Iterator[Shade]:
    """Yield where the new model refused what was measured, and where the unit moved."""
    summary = outcome.summaries[1]
    for key, text, role in SHADES:
        for start, stop in summary.get(key, ()):
            begin = start - summary["updates"]["interval_s"]
            yield Shade((begin - zero) * scale, (stop - zero) * scale, text, role)


def loop_chart(outcome: Outcome, axes: Sequence[str]) -> Chart:
    """Return the error over temperature, before and after in one scale, warming up and cooling down apart."""
    assert outcome.temperature is not None
    rows = thin(len(outcome.t))
    t, T = outcome.t[rows], outcome.temperature[rows]
    warming = np.gradient(T, t) >= 0 if len(t) > 1 else np.ones(len(t), dtype=bool)
    panels = []
    for k, axis in enumerate(axes):
        errors = [(values - outcome.reference)[rows, k] * outcome.unit.factor for _, values, *_ in _sides(outcome)]
        for name, error in zip(("before", "after"), errors, strict=True):
            lines = []
            for text, role, own in (("warming up", "warming", warming), ("cooling down", "cooling", ~warming)):
                order = np.flatnonzero(own)[np.argsort(T[own], kind="stable")]
                lines.append(Line(T[order], error[order], text, role, style="points"))
            both = tuple(Line(T, one, "") for one in errors)
            panels.append(Panel(tuple(lines), f"error {axis} {name} [{outcome.unit.shown}]", span=_span(both)))
    caption = "A loop between warming up and cooling down is hysteresis or lag; a curve that both follow is the map's."
    return Chart(tuple(panels), "temperature [°C]", "Error over temperature", caption)


def left_out_chart(parts: Sequence[LeftOut], axes: Sequence[str], shown: BiasUnit) -> Chart:
    """Return the errors of what was left out of one recording, of the declared model and of the final one."""
    ends = np.array([end for part in parts for end in (part.t[0], part.t[-1])])
    zero, unit = float(ends.min()), clock(np.array([ends.min(), ends.max()]))[1]
    scale = {"s": 1.0, "min": 60.0, "h": 3600.0}[unit]
    panels = []
    for k, axis in enumerate(axes):
        lines = []
        for part in parts:
            for name, values, role in (("before", part.before, BEFORE), ("after", part.after, AFTER)):
                error = values[:, k] * shown.factor
                rows = _extremes(error)
                lines.append(Line((part.t[rows] - zero) / scale, error[rows], name, role))
        panels.append(Panel(tuple(lines), f"error {axis} [{shown.shown}]"))
    return Chart(tuple(panels), f"time [{unit}]", f"Left out of {parts[0].name}")
