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
from driftlab.reports.charts import Chart, Line, Panel
from driftlab.reports.over_time import clock, legible, marked

if TYPE_CHECKING:
    from driftlab.loop.outcome import Outcome
    from driftlab.loop.predicted import LeftOut
    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array

BEFORE, AFTER = "series:1", "series:0"
STRETCHES = 600  # of an error, whose smallest and largest value are drawn


def prediction_chart(outcome: Outcome, axes: Sequence[str]) -> Chart:
    """Return what was measured and predicted of each axis, before and after, the errors below, and temperature."""
    rows = thin(len(outcome.t))
    at, unit = clock(outcome.summaries[0]["t"]["first_row_s"], float(outcome.t[-1]))
    t, shades = at(outcome.t), marked(outcome.summaries[1], at, "refused, after")
    panels = []
    for k, axis in enumerate(axes):
        lines = tuple(_bias(outcome, t, rows, k))
        panels.append(Panel(lines, f"bias {axis} [{outcome.unit.shown}]", shades, height=1.2, span=legible(lines)))
        lines = tuple(_errors(outcome, t, rows, k))
        panels.append(Panel(lines, f"error {axis} [{outcome.unit.shown}]", shades, span=legible(lines)))
    if outcome.temperature is not None:
        line = Line(t[rows], outcome.temperature[rows], "temperature", "temperature")
        panels.append(Panel((line,), "temperature [°C]", shades, height=0.7))
    return Chart(tuple(panels), f"time from the first row [{unit}]", "Measured and predicted, before and after")


def _sides(outcome: Outcome) -> Iterator[tuple[str, Array, Array, str]]:
    yield "before", outcome.before, outcome.before_sigma, BEFORE
    yield "after", outcome.after, outcome.after_sigma, AFTER


def _bias(outcome: Outcome, t: Array, rows: Array, axis: int) -> Iterator[Line]:
    factor = outcome.unit.factor
    yield Line(t[rows], outcome.reference[rows, axis] * factor, "measured", "reference")
    for name, values, sigma, role in _sides(outcome):
        middle, reach = values[rows, axis] * factor, 2 * sigma[rows, axis] * factor
        yield Line(t[rows], middle, f"{name}, ± 2σ", role, middle - reach, middle + reach)


def _errors(outcome: Outcome, t: Array, rows: Array, axis: int) -> Iterator[Line]:
    factor = outcome.unit.factor
    for name, _, sigma, role in _sides(outcome):
        reach = 2 * sigma[rows, axis] * factor
        yield Line(t[rows], None, f"{name}, ± 2σ", role, -reach, reach)
    for name, values, _, role in _sides(outcome):
        error = (values - outcome.reference)[:, axis] * factor
        own = _extremes(error)
        yield Line(t[own], error[own], f"{name}, ± 2σ", role)


def _extremes(values: Array) -> NDArray[np.int64]:
    """Return the rows of the smallest and the largest value of each stretch: no spike is left out."""
    if len(values) <= 2 * STRETCHES:
        return np.arange(len(values))
    filled: Array = np.where(np.isfinite(values), values, 0.0)
    parts = np.linspace(0, len(values), STRETCHES + 1).astype(int)
    found = [start + f(filled[start:stop]) for start, stop in pairwise(parts) for f in (np.argmin, np.argmax)]
    return np.unique(np.array(found, dtype=np.int64))


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
            panels.append(Panel(tuple(lines), f"error {axis} {name} [{outcome.unit.shown}]", span=legible(both)))
    caption = "A loop between warming up and cooling down is hysteresis or lag; a curve that both follow is the map's."
    return Chart(tuple(panels), "temperature [°C]", "Error over temperature", caption)


def left_out_chart(parts: Sequence[LeftOut], axes: Sequence[str], shown: BiasUnit) -> Chart:
    """Return the errors of what was left out of one recording, of the declared model and of the final one."""
    ends = np.array([end for part in parts for end in (part.t[0], part.t[-1])])
    at, unit = clock(float(ends.min()), float(ends.max()))
    panels = []
    for k, axis in enumerate(axes):
        lines = []
        for part in parts:
            for name, values, role in (("before", part.before, BEFORE), ("after", part.after, AFTER)):
                error = values[:, k] * shown.factor
                rows = _extremes(error)
                lines.append(Line(at(part.t[rows]), error[rows], name, role))
        panels.append(Panel(tuple(lines), f"error {axis} [{shown.shown}]"))
    return Chart(tuple(panels), f"time [{unit}]", f"Left out of {parts[0].name}")
