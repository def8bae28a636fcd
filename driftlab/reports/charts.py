"""What a figure shows, said once: a page draws it so that one can zoom, matplotlib for a notebook or a file.

A chart is a column of panels over one x axis. What a line is (its `role`) decides how it looks, everywhere alike.

What figures over time have in common: the clock, how much of a wide band is drawn, and marked stretches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from fusion_core.chunk import Array


LineStyle = Literal["line", "dashed", "dotted", "points"]


@dataclass(frozen=True)
class Look:
    """How a role is drawn: its colour on light and on dark ground, and the width of its line in points."""

    light: str
    dark: str
    width: float = 1.4


# told apart by readers who do not see all colours (Okabe and Ito), and by width: what is given is broad and pale, what
# is estimated thin above it
LOOKS = {
    "estimate": Look("#0072b2", "#56b4e9"),
    "reference": Look("#b4b4b4", "#7c7c7c", 4.8),
    "coast": Look("#c24e00", "#ff9a4d", 1.8),
    "error": Look("#0072b2", "#56b4e9"),
    "sigma": Look("#6b6b6b", "#a8a8a8", 1.0),
    "data": Look("#8c8c8c", "#9c9c9c", 1.0),
    "warming": Look("#c24e00", "#ff9a4d", 1.2),
    "cooling": Look("#0072b2", "#56b4e9", 1.2),
    "temperature": Look("#333333", "#d6d6d6", 1.2),
    "nis": Look("#0072b2", "#56b4e9", 1.0),
    "limit": Look("#b3261e", "#ff7a70", 1.2),
    "other": Look("#00795a", "#3ecf9f"),
    "series:0": Look("#0072b2", "#56b4e9"),
    "series:1": Look("#c24e00", "#ff9a4d"),
    "series:2": Look("#00795a", "#3ecf9f"),
    "series:3": Look("#a0457a", "#e08ebd"),
    "series:4": Look("#8a6d00", "#e8c547"),
    "series:5": Look("#5b4bb5", "#a99cf0"),
    "refused": Look("#c24e00", "#ff9a4d"),
    "moving": Look("#6b6b6b", "#a8a8a8"),
    "hole": Look("#b3261e", "#ff7a70"),
    "reached": Look("#00795a", "#3ecf9f"),
}
SERIES = sum(role.startswith("series:") for role in LOOKS)


def series(k: int) -> str:
    """Return the role of the k-th of several that are compared."""
    return f"series:{k % SERIES}"


@dataclass(frozen=True, eq=False)
class Line:
    """A line, points, or a band.

    Attributes
    ----------
    x : (N,) array
        Rising.
    y : (N,) array or None
        Not a number where there is nothing; None for a band alone.
    name : str
        For the legend; the same name in several panels is one entry.
    role : str
        One of LOOKS.
    low, high : (N,) arrays or None
        A band around it.
    style : str
        How it is drawn.
    """

    x: Array
    y: Array | None
    name: str
    role: str = "estimate"
    low: Array | None = None
    high: Array | None = None
    style: LineStyle = "line"


@dataclass(frozen=True)
class Shade:
    """A stretch of x that is marked, from `start` to `stop`, and what it is."""

    start: float
    stop: float
    text: str
    role: str = "refused"


@dataclass(frozen=True)
class Rule:
    """A level y that is marked, and what it is."""

    y: float
    text: str
    role: str = "limit"


@dataclass(frozen=True, eq=False)
class Panel:
    """Lines over the chart's x; `label` is of y, with its unit, `height` relative to other panels.

    `span` is from where to where y is drawn; None: as far as lines, bands and rules reach.
    """

    lines: tuple[Line, ...]
    label: str
    shades: tuple[Shade, ...] = ()
    rules: tuple[Rule, ...] = ()
    log: bool = False
    height: float = 1.0
    span: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Chart:
    """Panels below one another over one x axis.

    Attributes
    ----------
    panels : tuple of Panel
    label : str
        Of x, with its unit.
    title : str
        What it is, for a heading.
    caption : str
        What one should know to read it.
    log : bool
        Whether x is drawn by its logarithm.
    named : str
        Id of a script of the page with what each whole number of x, from 1, is called; empty where x is a number.
    """

    panels: tuple[Panel, ...]
    label: str
    title: str = ""
    caption: str = ""
    log: bool = False
    named: str = ""


def content(chart: Chart) -> dict[str, Any]:
    """Return a chart as JSON holds it; each x is there once, None where a value is not a finite number."""
    xs: list[Array] = []

    def place(x: Array) -> int:
        for k, known in enumerate(xs):
            if known is x or np.array_equal(known, x):
                return k
        xs.append(x)
        return len(xs) - 1

    panels = [
        {
            "label": panel.label,
            "log": panel.log,
            "height": panel.height,
            "span": panel.span,
            "lines": [_line(line, place(line.x)) for line in panel.lines],
            "shades": [vars(shade) for shade in panel.shades],
            "rules": [vars(rule) for rule in panel.rules],
        }
        for panel in chart.panels
    ]
    return {
        "title": chart.title,
        "label": chart.label,
        "log": chart.log,
        **({"named": chart.named} if chart.named else {}),
        "x": [_numbers(x, 9) for x in xs],
        "panels": panels,
    }


def _line(line: Line, x: int) -> dict[str, Any]:
    columns = {"y": line.y, "low": line.low, "high": line.high}
    held = {name: _numbers(values) for name, values in columns.items() if values is not None}
    return {"name": line.name, "role": line.role, "style": line.style, "x": x, **held}


def _numbers(values: Array, digits: int = 6) -> list[float | None]:
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=np.float64).tolist()]


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
