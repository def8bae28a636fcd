"""How each quantity is distributed in each lot: boxes on one scale, as the page draws them. d axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from driftlab.reports.fleet_charts import TITLES

if TYPE_CHECKING:
    from driftlab.family.charted import Control, Line

MOST = 60  # lots that are drawn: the latest


@dataclass(frozen=True)
class Box:
    """The units of one lot on one axis.

    Attributes
    ----------
    n : int
    text : str
        The median, with its unit's digits; an arrow where the lot's mean is beyond the limits of the line.
    out : bool
        Whether it is.
    low, quarter, half, most, high : float
        5, 25, 50, 75, 95 %, as per cent of the scale.
    """

    n: int
    text: str
    out: bool
    low: float
    quarter: float
    half: float
    most: float
    high: float


@dataclass(frozen=True)
class Distribution:
    """One quantity, a row a lot, a column an axis.

    Attributes
    ----------
    title, unit : str
    axes : list of str
    scale : list of (str, str)
        Of each axis, the values at either end of its boxes.
    rows : list of (lot, boxes)
        None where a lot has no value on an axis.
    left_out : int
        Lots that are not drawn.
    """

    title: str
    unit: str
    axes: list[str]
    scale: list[tuple[str, str]]
    rows: list[tuple[str, list[Box | None]]]
    left_out: int


def distributions(line: Line) -> list[Distribution]:
    """Return the distribution of each quantity by lot; none where the units have no lots."""
    lots = list(dict.fromkeys(lot for lot in line.lots if lot))
    if not lots:
        return []
    found = []
    for name in dict.fromkeys(chart.quantity for chart in line.controls):
        charts = [chart for chart in line.controls if chart.quantity == name]
        spans = [_span(chart) for chart in charts]
        unit = line.shown(name)
        of = [_boxes(line, chart, span) for chart, span in zip(charts, spans, strict=True)]
        rows = [(lot, [boxes.get(lot) for boxes in of]) for lot in lots[-MOST:]]
        scale = [(_text(low * unit.factor), _text(high * unit.factor)) for low, high in spans]
        title = TITLES.get(name, name)
        found.append(Distribution(title, unit.shown, [c.axis for c in charts], scale, rows, max(len(lots) - MOST, 0)))
    return found


def _span(chart: Control) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(chart.value, (1, 99)))
    room = 0.05 * (high - low) or abs(high) or 1.0
    return low - room, high + room


def _boxes(line: Line, chart: Control, span: tuple[float, float]) -> dict[str, Box]:
    low, high = span
    factor, names = line.shown(chart.quantity).factor, np.array(line.lots)[chart.at]
    found = {}
    for lot in chart.lots:
        values = np.percentile(chart.value[names == lot.name], (5, 25, 50, 75, 95))
        places = np.clip(100 * (values - low) / (high - low), 0, 100).tolist()
        found[lot.name] = Box(lot.n, _text(values[2] * factor), lot.out, *places)
    return found


def _text(value: float) -> str:
    return f"{value:#.3g}".rstrip(".")
