"""Charts, each described once: a page draws it so that one can zoom, matplotlib for a notebook or a file.

A chart is a column of panels over one x axis. What a line is (its `role`) decides how it looks, everywhere alike. The
parts that charts share stand at the end: a panel an axis, bands, the clock, and marked stretches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from driftlab.units import rounded
from fusion_core.chunk import Array

POWERS = np.array([float(10**k) for k in range(23)])  # each is exact
LineStyle = Literal["line", "dashed", "dotted", "points"]


@dataclass(frozen=True)
class Look:
    """The look of a role: its colour on light and on dark ground, and the width of its line in points."""

    light: str
    dark: str
    width: float = 1.4


# distinct to readers who do not see all colours (Okabe and Ito), and by width: what is given is broad and pale, what
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
    "limit": Look("#8d9299", "#7f858d", 0.8),
    "alarm": Look("#b3261e", "#ff7a70", 1.2),
    "other": Look("#00795a", "#3ecf9f"),
    "series:0": Look("#0072b2", "#56b4e9"),
    "series:1": Look("#c24e00", "#ff9a4d"),
    "series:2": Look("#00795a", "#3ecf9f"),
    "series:3": Look("#a0457a", "#e08ebd"),
    "series:4": Look("#8a6d00", "#e8c547"),
    "series:5": Look("#5b4bb5", "#a99cf0"),
    "refused": Look("#a0457a", "#e08ebd"),
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
            "lines": [_line_content(line, place(line.x)) for line in panel.lines],
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
        "x": [numbers(x, 9) for x in xs],
        "panels": panels,
    }


def _line_content(line: Line, x: int) -> dict[str, Any]:
    columns = {"y": line.y, "low": line.low, "high": line.high}
    values = {name: numbers(column) for name, column in columns.items() if column is not None}
    return {"name": line.name, "role": line.role, "style": line.style, "x": x, **values}


def numbers(values: Array, digits: int = 6) -> list[float | None]:
    """Return values with so many digits, as `rounded` does one by one; None for one that is not finite.

    A whole number of at most 15 digits by a power of ten up to 22 is what the text of both is read as; what lies near
    the middle of two such numbers is left to the text.
    """
    values = np.asarray(values, dtype=np.float64)
    with np.errstate(all="ignore"):
        places = digits - 1 - np.floor(np.log10(np.abs(values)))
        sure = np.abs(places) < len(POWERS)
        power = POWERS[np.where(sure, np.abs(places), 0).astype(np.int64)]
        scaled = np.where(places < 0, values / power, values * power)
        whole = np.rint(scaled)
        short: list[float | None] = np.where(places < 0, whole * power, whole / power).tolist()
        unsure = np.flatnonzero(~sure | (np.abs(np.abs(scaled - whole) - 0.5) < 1e-3))
    for k in unsure.tolist():
        short[k] = rounded(float(values[k]), digits)
    return short


def band(x: Array, middle: Array, reach: Array, name: str, role: str = "estimate") -> Line:
    """Return a line within a band that reaches as far to either side."""
    return Line(x, middle, name, role, middle - reach, middle + reach)


def band_alone(x: Array, reach: Array, name: str, role: str) -> Line:
    """Return a band about zero."""
    return Line(x, None, name, role, -reach, reach)


def axis_panels(
    axes: Sequence[str],
    lines_of: Callable[[int], Iterable[Line]],
    quantity: str,
    unit: str,
    *,
    legibly: bool = False,
    **how: Any,
) -> tuple[Panel, ...]:
    """Return a panel an axis: the lines of axis k are `lines_of(k)`, and `how` is of each panel.

    With `legibly` wide bands are drawn as far as `legible` says, and what is beyond is written in the label.
    """
    panels = []
    for k, axis in enumerate(axes):
        lines = tuple(lines_of(k))
        span = legible(lines) if legibly else None
        label = f"{quantity} {axis} [{unit}]{_beyond(lines, span)}"
        panels.append(Panel(lines, label, span=span, **how))
    return tuple(panels)


def _beyond(lines: Iterable[Line], span: tuple[float, float] | None) -> str:
    """Return in words how far lines go beyond what is drawn; empty where all is drawn."""
    values = _finite(line.y for line in lines)
    out = values[(values < span[0]) | (values > span[1])] if span else values[:0]
    return f", spikes of {np.min(out):.3g} to {np.max(out):.3g} are cut" if len(out) else ""


def temperature_panel(t: Array, T: Array, shades: tuple[Shade, ...], **how: Any) -> Panel:
    """Return the temperature over time."""
    return Panel((Line(t, T, "temperature", "temperature"),), "temperature [°C]", shades, **how)


def positive(values: Array) -> Array:
    """Return values that a logarithm can show, NaN in place of the others."""
    return np.where(values > 0, values, np.nan)


def target_rule(target: float | None, factor: float) -> tuple[Rule, ...]:
    """Return the level that is asked for, if one is."""
    return () if target is None else (Rule(target * factor, "asked for"),)


BAND = 0.5  # of the height of the lines, beyond them, that a wide band may take to either side


@dataclass(frozen=True)
class Clock:
    """The time axis of a figure, from `zero` to `end`, s."""

    zero: float
    end: float

    @property
    def unit(self) -> str:
        """The unit of time that suits the figure."""
        length = self.end - self.zero
        return "s" if length < 600 else "min" if length < 7200 else "h"

    @property
    def label(self) -> str:
        """The label of the axis, where it begins at the first row."""
        return f"time from the first row [{self.unit}]"

    def __call__(self, t: Array) -> Array:
        """Return times in s as they are drawn."""
        return (t - self.zero) * {"s": 1.0, "min": 1 / 60, "h": 1 / 3600}[self.unit]


def legible(lines: Iterable[Line]) -> tuple[float, float] | None:
    """Return from where to where y is drawn: lines but for spikes, and of bands as much as leaves the lines legible."""
    lines = tuple(lines)
    values = _finite(line.y for line in lines)
    if not len(values):
        return None
    low, high = without_spikes(values)
    ends = _finite(end for line in lines for end in (line.low, line.high))
    room = (high - low) * BAND or abs(high) * 0.1 or 1.0
    bottom = max(float(np.min(ends, initial=low)), low - room)
    top = min(float(np.max(ends, initial=high)), high + room)
    margin = (top - bottom) * 0.04 or room
    return bottom - margin, top + margin


FAR, FEW = 3.0, 0.01  # of the width that 80 % of the values have, beyond it; share of all that may be cut


def without_spikes(values: Array, few: float = FEW) -> tuple[float, float]:
    """Return from where to where values are drawn: all, or without a few far ones that would squash the others."""
    low, high = np.percentile(values, (10, 90))
    room = FAR * (high - low)
    far = (values < low - room) | (values > high + room)
    spikes = not np.any(far[:-2] & far[1:-1] & far[2:])  # three in a row are no spike
    drawn = values[~far] if room and spikes and np.sum(far) <= max(1.0, few * len(values)) else values
    return float(np.min(drawn)), float(np.max(drawn))


def _finite(parts: Iterable[Array | None]) -> Array:
    """Return the finite values of arrays, in one."""
    joined = np.concatenate([np.zeros(0), *(part for part in parts if part is not None)])
    return np.asarray(joined[np.isfinite(joined)], dtype=np.float64)


def span_shades(
    spans: Iterable[tuple[float, float]], clock: Clock, text: str, role: str, before: float = 0.0
) -> tuple[Shade, ...]:
    """Return stretches of time (s) as shades, each from `before` s before its first epoch on."""
    edges = [clock(np.array([start - before, stop])).tolist() for start, stop in spans]
    return tuple(Shade(start, stop, text, role) for start, stop in edges)
