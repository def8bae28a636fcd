"""The charts of a fleet: control charts of its line, distributions by lot, and the fan of its maps.

A control chart has a panel an axis. A distribution has boxes on one scale. A fan shows between which curves how many of
the units lie, and those that are odd. m values, U units, d axes, G temperatures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.family.outliers import Outlier
from driftlab.reports.charts import SERIES, Chart, Line, LineStyle, Panel, Shade, axis_panels, series
from driftlab.spc.charts import ControlChart, LineReport
from driftlab.units import BiasUnit, number, rounded
from fusion_core.chunk import Array

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


def control_charts(line: LineReport) -> list[Chart]:
    """Return the chart of each quantity; x is the place of the unit in the line, from 1."""
    result: list[Chart] = []
    for name, charts in _by_quantity(line).items():
        panels = tuple(_panel(line, chart) for chart in charts)
        caption = "" if result else CAPTION  # once on a page
        result.append(Chart(panels, "unit", TITLES.get(name, name), caption, named="units-of-the-line"))
    return result


def _by_quantity(line: LineReport) -> dict[str, list[ControlChart]]:
    """Return the charts of each quantity."""
    quantities = dict.fromkeys(chart.quantity for chart in line.controls)
    return {name: [chart for chart in line.controls if chart.quantity == name] for name in quantities}


def _panel(line: LineReport, chart: ControlChart) -> Panel:
    unit = line.shown(chart.quantity)

    def shown(values: Array) -> Array:
        return np.array([rounded(v, 4) for v in (np.asarray(values) * unit.factor).tolist()], dtype=np.float64)

    drawn = _drawn(chart)
    place = (chart.at + 1).astype(np.float64)
    few = np.unique(np.linspace(0, len(place) - 1, LIMITS).astype(int))
    out = np.flatnonzero(chart.beyond)
    lines = [
        *_usual(chart, shown),
        Line(place[drawn], shown(chart.value[drawn]), "unit", "data", style="points"),
        Line(place[out], shown(chart.value[out]), "beyond three sigma", "limit", style="points"),
        Line(place[drawn], shown(chart.ewma[drawn]), "EWMA", "estimate"),
        *_limits(place, few, (chart.low, chart.high), shown, ewma=False),
        *_limits(place, few, (chart.ewma_low, chart.ewma_high), shown, ewma=True),
    ]
    shades = tuple(Shade(change.low + 0.5, change.high + 1.5, "change", "refused") for change in chart.changes)
    value = chart.value[np.isfinite(chart.value)]
    wide = bool(np.min(value) > 0 and np.max(value) > 20 * np.median(value))
    span = None if wide else _span(chart, unit.factor)
    return Panel(tuple(lines), f"{chart.quantity} {chart.axis} [{unit.shown}]", shades, log=wide, span=span)


def _span(chart: ControlChart, factor: float) -> tuple[float, float]:
    """Return from where to where y is drawn: all values, and the limits of most units.

    A unit that is measured badly has limits so wide that nothing else could be distinguished.
    """
    all_of = np.concatenate(
        [chart.value, chart.ewma_low, chart.ewma_high, [np.median(chart.low), np.median(chart.high)]]
    )
    low, high = (float(v) * factor for v in (np.nanmin(all_of), np.nanmax(all_of)))
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - room, high + room


def _drawn(chart: ControlChart) -> NDArray[np.intp]:
    """Return the values that are drawn: all, or the alarms and an even sample."""
    m = len(chart.at)
    if m <= MAX_POINTS:
        return np.arange(m)
    return np.union1d(np.linspace(0, m - 1, MAX_POINTS).astype(np.intp), np.flatnonzero(chart.beyond))


def _usual(chart: ControlChart, shown: Callable[[Array], Array]) -> list[Line]:
    """Return the usual level of each stretch; of a line without a change, the middle that the limits stand on."""
    starts = [float(chart.at[0] + 1), *(change.at + 1.0 for change in chart.changes)]
    stops = [*(start - 1.0 for start in starts[1:]), float(chart.at[-1] + 1)]
    first = chart.changes[0].before if chart.changes else chart.centre
    levels = [first, *(change.after for change in chart.changes)]
    return [
        Line(np.array([start, stop]), shown(np.full(2, level)), "usual", "reference")
        for start, stop, level in zip(starts, stops, levels, strict=True)
    ]


def _limits(
    place: Array, few: NDArray[np.intp], both: tuple[Array, Array], shown: Callable[[Array], Array], *, ewma: bool
) -> list[Line]:
    """Return two limits, of the values or of the EWMA; one that is the same all along has two points."""
    name, role = ("limits of the EWMA", "estimate") if ewma else ("three sigma", "limit")
    style: LineStyle = "dotted" if ewma else "dashed"
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
    result = []
    for name, charts in _by_quantity(line).items():
        spans, unit = [_lot_span(chart) for chart in charts], line.shown(name)
        boxes = [_boxes(line, chart, span) for chart, span in zip(charts, spans, strict=True)]
        rows = [(lot, [by_lot.get(lot) for by_lot in boxes]) for lot in lots[-MAX_LOTS:]]
        scale = [(number(low * unit.factor, zeros=True), number(high * unit.factor, zeros=True)) for low, high in spans]
        axes, left_out = [chart.axis for chart in charts], max(len(lots) - MAX_LOTS, 0)
        result.append(Distribution(TITLES.get(name, name), unit.shown, axes, scale, rows, left_out))
    return result


def _lot_span(chart: ControlChart) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(chart.value, (1, 99)))
    room = 0.05 * (high - low) or abs(high) or 1.0
    return low - room, high + room


def _boxes(line: LineReport, chart: ControlChart, span: tuple[float, float]) -> dict[str, Box]:
    low, high = span
    factor, names = line.shown(chart.quantity).factor, np.array(line.lots)[chart.at]
    boxes = {}
    for lot in chart.lots:
        values = np.percentile(chart.value[names == lot.name], (5, 25, 50, 75, 95))
        places = np.clip(100 * (values - low) / (high - low), 0, 100).tolist()
        boxes[lot.name] = Box(lot.n, number(values[2] * factor, zeros=True), lot.out, *places)
    return boxes


LABEL = "temperature [°C]"
SHARES = (5, 25, 50, 75, 95)
NAMED = SERIES - 1  # odd units with a colour of their own; the first colour is the fan's
EACH = 20  # units of which each is drawn: percentiles of so few say little
DRAWN = 40  # odd units on an axis at most


@dataclass(frozen=True, eq=False)
class MapFan:
    """The maps of a fleet's units.

    Attributes
    ----------
    T : (G,) array
        degC.
    curves : (U, d, G) array
        Over T, SI.
    drawn : sequence of str
        Whose they are.
    axes : sequence of str
    unit : BiasUnit
        In which biases are shown.
    mean : (d, G) array or None
        The family's curve, SI.
    odd : mapping of str to sequence of Outlier
        By unit, why it is odd.
    """

    T: Array
    curves: Any
    drawn: Sequence[str]
    axes: Sequence[str]
    unit: BiasUnit
    mean: Array | None
    odd: Mapping[str, Sequence[Outlier]]

    def fan(self, ranges: Array) -> Chart:
        """Return the fan of the curves, and how many units were measured at each temperature.

        `ranges` (n, 2) are the temperatures that each unit was soaked at, from and to, degC.
        """
        T, (low, high) = self.T, ranges.T
        near = 0.5 * float(np.diff(T).max())  # a soak reaches the temperature of the grid that it comes nearest to
        count = np.array([np.sum((low <= at + near) & (at - near <= high)) for at in T], dtype=np.float64)
        line, span = Line(T, count, "units measured", "data"), (0.0, 1.1 * max(count.max(), 1.0))
        below = Panel((line,), "units measured", height=0.6, span=span)
        panels = self._panels(percentiles(self.curves), self.curves, self.mean, "bias")
        return Chart(
            (*panels, below),
            LABEL,
            "Maps of the units",
            self._caption("Below: at how many units' soaks this temperature was."),
        )

    def spread(self) -> Chart:
        """Return the fan of the curves less their median."""
        bands = percentiles(self.curves)
        middle = bands[SHARES.index(50)].astype(self.curves.dtype)
        panels = self._panels(bands - middle, self.curves - middle, None, "less the median:")
        return Chart(panels, LABEL, "Deviation from the median of the units", self._caption(""))

    def _panels(self, bands: Array, curves: Any, mean: Array | None, quantity: str) -> tuple[Panel, ...]:
        # what else is odd than a shape is not to be seen in a map
        bent = {name: {axis for one in odd if one.T is not None for axis in one.axis.split()}
                for name, odd in self.odd.items()}  # fmt: skip
        bent = {name: axes for name, axes in bent.items() if axes}
        named = [name for name in self.drawn if name in bent][:NAMED]
        looks = {name: (name, series(k + 1)) for k, name in enumerate(named)}
        T, factor = self.T, self.unit.factor

        def lines(axis: int) -> Iterator[Line]:
            five, quarter, half, most, all_but_five = bands[:, axis] * factor
            yield Line(T, None, "90 % of the units", "estimate", five, all_but_five)
            yield Line(T, None, "half of the units (darker)", "estimate", quarter, most)
            yield Line(T, half, "median", "estimate")
            if mean is not None:
                yield Line(T, mean[axis] * factor, "mean of the family", "sigma", style="dashed")
            if len(self.drawn) <= EACH:
                for curve in curves[:, axis]:
                    yield Line(T, np.asarray(curve, dtype=np.float64) * factor, "a unit", "data")
            odd = [k for k, name in enumerate(self.drawn) if self.axes[axis] in bent.get(name, ())]
            for k in odd[:DRAWN]:
                name, role = looks.get(self.drawn[k], ("more odd units", "limit"))
                yield Line(T, np.asarray(curves[k, axis], dtype=np.float64) * factor, name, role)

        return axis_panels(self.axes, lines, quantity, self.unit.shown, height=1.2)

    def _caption(self, more: str) -> str:
        U = len(self.drawn)
        return (
            f"Of {U:,} unit{'s' * (U != 1)}: broad band 5 to 95 %, narrow band 25 to 75 %, at each temperature on its "
            f"own. Lines with a unit's name: of an odd shape on this axis. {more}"
        ).strip()


def percentiles(curves: Any) -> Array:
    """Return percentiles SHARES (5, d, G) of curves (U, d, G), an axis at a time."""
    bands = [np.nanpercentile(curves[:, k], SHARES, axis=0) for k in range(curves.shape[1])]
    return np.stack(bands, axis=1).astype(np.float64)
