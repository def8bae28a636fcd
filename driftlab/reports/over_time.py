"""What figures over time have in common: the clock, how much of a wide band is drawn, and marked stretches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.reports.charts import Line, Shade

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from fusion_core.chunk import Array

BAND = 0.5  # of the height of the lines, beyond them, that a wide band may take to either side


def clock(zero: float, end: float) -> tuple[Callable[[Array], Array], str]:
    """Return what turns times in s into those since `zero`, in a unit that suits a figure until `end`, and the unit."""
    scale, unit = 1 / 3600, "h"
    if end - zero < 600:
        scale, unit = 1.0, "s"
    elif end - zero < 7200:
        scale, unit = 1 / 60, "min"
    return lambda t: (t - zero) * scale, unit


def legible(lines: Iterable[Line]) -> tuple[float, float] | None:
    """Return from where to where y is drawn: lines whole, and of their bands as much as leaves the lines legible."""
    lines = tuple(lines)
    values = _finite(line.y for line in lines)
    if not len(values):
        return None
    low, high = float(np.min(values)), float(np.max(values))
    ends = _finite(end for line in lines for end in (line.low, line.high))
    room = (high - low) * BAND or abs(high) * 0.1 or 1.0
    bottom = max(float(np.min(ends, initial=low)), low - room)
    top = min(float(np.max(ends, initial=high)), high + room)
    margin = (top - bottom) * 0.04 or room
    return bottom - margin, top + margin


def _finite(parts: Iterable[Array | None]) -> Array:
    """Return the finite values of arrays, in one."""
    joined = np.concatenate([np.zeros(0), *(part for part in parts if part is not None)])
    return np.asarray(joined[np.isfinite(joined)], dtype=np.float64)


def marked(summary: dict[str, Any], at: Callable[[Array], Array], refused: str = "refused") -> tuple[Shade, ...]:
    """Return where the filter refused what it measured, and where the unit moved; `at` is of `clock`."""
    found = []
    for name, text, role in (("refused_s", refused, "refused"), ("motion_s", "moved", "moving")):
        for start, stop in summary.get(name, ()):
            begin, end = at(np.array([start - summary["updates"]["interval_s"], stop])).tolist()
            found.append(Shade(begin, end, text, role))
    return tuple(found)
