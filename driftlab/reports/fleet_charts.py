"""The control charts of a line, a chart a quantity, a panel an axis, as pages and notebooks draw them. m values.

How each quantity is distributed in each lot: boxes on one scale, as the page draws them. d axes.

Maps of a family as a fan: between which curves how many of the units lie, and those that are odd.

U units, d axes, G temperatures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from driftlab.reports.charts import SERIES, Chart, Line, LineStyle, Panel, Shade, series
from driftlab.units import BiasUnit
from fusion_core.chunk import Array

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from driftlab.spc.charts import ControlChart, LineReport
    from driftlab.spc.charts import LineReport as OfUnits


MAX_POINTS = 5000  # points of a panel; more are drawn as the alarms and an even sample
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


def _panel(line: OfUnits, chart: ControlChart) -> Panel:
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


def _span(chart: ControlChart, factor: float) -> tuple[float, float]:
    """Return from where to where y is drawn: all values, and the limits of most units.

    A unit that is measured badly has limits so wide that nothing else could be told apart.
    """
    all_of = np.concatenate(
        [chart.value, chart.ewma_low, chart.ewma_high, [np.median(chart.low), np.median(chart.high)]]
    )
    low, high = (float(v) * factor for v in (np.nanmin(all_of), np.nanmax(all_of)))
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - room, high + room


def _drawn(chart: ControlChart) -> NDArray[np.intp]:
    """Return which values are drawn: all, or the alarms and an even sample."""
    m = len(chart.at)
    if m <= MAX_POINTS:
        return np.arange(m)
    return np.union1d(np.linspace(0, m - 1, MAX_POINTS).astype(np.intp), np.flatnonzero(chart.beyond))


def _usual(chart: ControlChart, shown: Callable[[Array], Array]) -> list[Line]:
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


MAX_LOTS = 60  # lots that are drawn: the latest


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


def distributions(line: LineReport) -> list[Distribution]:
    """Return the distribution of each quantity by lot; none where the units have no lots."""
    lots = list(dict.fromkeys(lot for lot in line.lots if lot))
    if not lots:
        return []
    found = []
    for name in dict.fromkeys(chart.quantity for chart in line.controls):
        charts = [chart for chart in line.controls if chart.quantity == name]
        spans = [_lot_span(chart) for chart in charts]
        unit = line.shown(name)
        of = [_boxes(line, chart, span) for chart, span in zip(charts, spans, strict=True)]
        rows = [(lot, [boxes.get(lot) for boxes in of]) for lot in lots[-MAX_LOTS:]]
        scale = [(_text(low * unit.factor), _text(high * unit.factor)) for low, high in spans]
        title = TITLES.get(name, name)
        found.append(
            Distribution(title, unit.shown, [c.axis for c in charts], scale, rows, max(len(lots) - MAX_LOTS, 0))
        )
    return found


def _lot_span(chart: ControlChart) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(chart.value, (1, 99)))
    room = 0.05 * (high - low) or abs(high) or 1.0
    return low - room, high + room


def _boxes(line: LineReport, chart: ControlChart, span: tuple[float, float]) -> dict[str, Box]:
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


LABEL = "temperature [°C]"
SHARES = (5, 25, 50, 75, 95)
NAMED = SERIES - 1  # odd units with a colour of their own; the first colour is the fan's
EACH = 20  # units of which each is drawn: percentiles of so few say little
DRAWN = 40  # odd units on an axis at most


class FanFamily(Protocol):
    """What a fan needs beside the curves."""

    @property
    def unit(self) -> BiasUnit:
        """In which biases are shown."""

    @property
    def mean(self) -> Array | None:
        """The family's curve (d, G), SI."""

    @property
    def odd(self) -> Mapping[str, Sequence[Any]]:
        """By unit, why it is odd."""


def fan(T: Array, curves: Any, drawn: Sequence[str], axes: Sequence[str], family: FanFamily, ranges: Array) -> Chart:
    """Return the fan of curves (U, d, G), and how many units were measured at each temperature.

    `ranges` (n, 2) are the temperatures that each unit was soaked at, from and to, degC.
    """
    bands = percentiles(curves)
    mean = family.mean
    panels = [
        _map_panel(T, bands[:, k], curves[:, k], drawn, axis, family, None if mean is None else mean[k], "bias")
        for k, axis in enumerate(axes)
    ]
    near = 0.5 * float(np.diff(T).max())  # a soak reaches the temperature of the grid that it comes nearest to
    count = np.array([np.sum((ranges[:, 0] <= at + near) & (at - near <= ranges[:, 1])) for at in T], dtype=np.float64)
    panels.append(
        Panel(
            (Line(T, count, "units measured", "data"),),
            "units measured",
            height=0.6,
            span=(0.0, 1.1 * max(count.max(), 1.0)),
        )
    )
    return Chart(
        tuple(panels),
        LABEL,
        "Maps of the units",
        _caption(len(drawn), "Below: at how many units' soaks this temperature was."),
    )


def spread(T: Array, curves: Any, drawn: Sequence[str], axes: Sequence[str], family: FanFamily) -> Chart:
    """Return the fan of curves (U, d, G) less their median."""
    bands = percentiles(curves)
    middle = bands[SHARES.index(50)].astype(curves.dtype)
    panels = [
        _map_panel(T, bands[:, k] - middle[k], curves[:, k] - middle[k], drawn, axis, family, None, "less the median:")
        for k, axis in enumerate(axes)
    ]
    return Chart(tuple(panels), LABEL, "By how much the units differ", _caption(len(drawn), ""))


def percentiles(curves: Any) -> Array:
    """Return percentiles SHARES (5, d, G) of curves (U, d, G), an axis at a time."""
    found = [np.nanpercentile(curves[:, k], SHARES, axis=0) for k in range(curves.shape[1])]
    return np.stack(found, axis=1).astype(np.float64)


def _map_panel(
    T: Array, bands: Array, own: Any, drawn: Sequence[str], axis: str, family: FanFamily, mean: Array | None, what: str
) -> Panel:
    unit = family.unit
    five, quarter, half, most, all_but_five = (band * unit.factor for band in bands)
    lines = [
        Line(T, None, "90 % of the units", "estimate", five, all_but_five),
        Line(T, None, "half of the units (darker)", "estimate", quarter, most),
        Line(T, half, "median", "estimate"),
    ]
    if mean is not None:
        lines.append(Line(T, mean * unit.factor, "mean of the family", "sigma", style="dashed"))
    if len(drawn) <= EACH:
        lines += [Line(T, np.asarray(one, dtype=np.float64) * unit.factor, "a unit", "data") for one in own]
    bent = {name: [axis for one in found for axis in one.axis.split()] for name, found in _bent(family).items()}
    colours = {name: series(k + 1) for k, name in enumerate([name for name in drawn if name in bent][:NAMED])}
    odd = [k for k, name in enumerate(drawn) if axis in bent.get(name, ())]
    for k in odd[:DRAWN]:
        name = drawn[k]
        look = (name, colours[name]) if name in colours else ("more odd units", "limit")
        lines.append(Line(T, np.asarray(own[k], dtype=np.float64) * unit.factor, *look))
    return Panel(tuple(lines), f"{what} {axis} [{unit.shown}]", height=1.2)


def _bent(family: FanFamily) -> dict[str, list[Any]]:
    """Return, by unit, what is odd about its shape: what else is odd is not to be seen in a map."""
    found = {name: [one for one in odd if one.T is not None] for name, odd in family.odd.items()}
    return {name: odd for name, odd in found.items() if odd}


def _caption(U: int, more: str) -> str:
    return (
        f"Of {U:,} unit{'s' * (U != 1)}: broad band 5 to 95 %, narrow band 25 to 75 %, at each temperature on its own. "
        f"Lines with a unit's name: of an odd shape on this axis. {more}"
    ).strip()
