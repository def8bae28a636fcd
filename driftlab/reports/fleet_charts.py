"""The control charts of a line, a chart a quantity, a panel an axis, as pages and notebooks draw them. m values."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftlab.reports.charts import Chart, Line, LineStyle, Panel, Shade

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from driftlab.family.charted import Control
    from driftlab.family.charted import Line as OfUnits
    from fusion_core.chunk import Array

MOST = 5000  # points of a panel; more are drawn as the alarms and an even sample
LIMITS = 300  # points of a limit that differs from unit to unit
TITLES = {
    "residual": "Residual of the map, rms of 30 s averages",
    "noise": "White noise",
    "walk": "Walk of the bias",
    "swing": "Swing of the map",
    "coast": "Coast, rms of 10 min without a measurement",
    "level": "Level of the map, mean over the range",
}
CAPTION = (
    "A point a unit. Dashed: three sigma about the middle of a line in control, wider where a unit is measured less "
    "well. Dotted: limits of the EWMA. Broad: what is usual between the changes; shaded: where a change is, by 95 %."
)


def control_charts(line: OfUnits) -> list[Chart]:
    """Return the chart of each quantity; x is the place of the unit in the line, from 1."""
    found: list[Chart] = []
    for name in dict.fromkeys(chart.quantity for chart in line.controls):
        panels = tuple(_panel(line, chart) for chart in line.controls if chart.quantity == name)
        title = TITLES.get(name, name)
        caption = "" if found else CAPTION  # said once on a page
        found.append(Chart(panels, "unit", title, caption, named="units-of-the-line"))
    return found


def _panel(line: OfUnits, chart: Control) -> Panel:
    unit = line.shown(chart.quantity)

    def shown(values: Array) -> Array:
        return np.array([float(f"{v:.4g}") for v in (np.asarray(values) * unit.factor).tolist()])

    drawn = _drawn(chart)
    place = (chart.at + 1).astype(np.float64)
    few = np.unique(np.linspace(0, len(place) - 1, LIMITS).astype(int))
    out = np.flatnonzero(chart.beyond)
    lines = [
        *_usual(chart, shown),
        Line(place[drawn], shown(chart.value[drawn]), "unit", "data", style="points"),
        Line(place[out], shown(chart.value[out]), "beyond three sigma", "limit", style="points"),
        Line(place[drawn], shown(chart.ewma[drawn]), "EWMA", "estimate"),
        *_limits(place, few, (chart.low, chart.high), shown, "three sigma", "dashed"),
        *_limits(place, few, (chart.ewma_low, chart.ewma_high), shown, "limits of the EWMA", "dotted"),
    ]
    shades = tuple(Shade(change.low + 0.5, change.high + 1.5, "change", "refused") for change in chart.changes)
    value = chart.value[np.isfinite(chart.value)]
    wide = bool(np.min(value) > 0 and np.max(value) > 20 * np.median(value))
    span = None if wide else _span(chart, unit.factor)
    return Panel(tuple(lines), f"{chart.quantity} {chart.axis} [{unit.shown}]", shades, log=wide, span=span)


def _span(chart: Control, factor: float) -> tuple[float, float]:
    """Return from where to where y is drawn: all values, and the limits of most units.

    A unit that is measured badly has limits so wide that nothing else could be told apart.
    """
    all_of = np.concatenate(
        [chart.value, chart.ewma_low, chart.ewma_high, [np.median(chart.low), np.median(chart.high)]]
    )
    low, high = (float(v) * factor for v in (np.nanmin(all_of), np.nanmax(all_of)))
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - room, high + room


def _drawn(chart: Control) -> NDArray[np.intp]:
    """Return which values are drawn: all, or the alarms and an even sample."""
    m = len(chart.at)
    if m <= MOST:
        return np.arange(m)
    return np.union1d(np.linspace(0, m - 1, MOST).astype(np.intp), np.flatnonzero(chart.beyond))


def _usual(chart: Control, shown: Callable[[Array], Array]) -> list[Line]:
    """Return what is usual in each stretch; of a line without a change, the middle that the limits stand on."""
    last = float(chart.at[-1] + 1)
    if not chart.changes:
        return [Line(np.array([float(chart.at[0] + 1), last]), shown(np.full(2, chart.centre)), "usual", "reference")]
    starts = [float(chart.at[0] + 1), *(change.at + 1.0 for change in chart.changes)]
    stops = [*(start - 1.0 for start in starts[1:]), last]
    levels = [chart.changes[0].before, *(change.after for change in chart.changes)]
    return [
        Line(np.array([start, stop]), shown(np.full(2, level)), "usual", "reference")
        for start, stop, level in zip(starts, stops, levels, strict=True)
    ]


def _limits(
    place: Array,
    few: NDArray[np.intp],
    both: tuple[Array, Array],
    shown: Callable[[Array], Array],
    name: str,
    style: LineStyle,
) -> list[Line]:
    """Return two limits; one that is the same all along has two points."""
    role = "limit" if style == "dashed" else "estimate"
    steady = all(np.ptp(values) <= 0.02 * abs(both[1] - both[0]).max() for values in both)
    at = few[[0, -1]] if steady else few
    return [Line(place[at], shown(values[at]), name, role, style=style) for values in both]
