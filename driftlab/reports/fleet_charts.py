"""The charts of a fleet: control charts of its line, distributions by lot, and the fan of its maps.

A control chart has a panel an axis. A distribution has boxes on one scale. A fan shows between which curves how many of
the units lie, and those that are odd. m values, U units, d axes, G temperatures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.family.outliers import Outlier
from driftlab.family.record import UnitRecord, figure_name
from driftlab.reports.charts import SERIES, Chart, Line, LineStyle, Panel, Shade, axis_panels, series, without_spikes
from driftlab.spc.charts import ControlChart, LineReport
from driftlab.units import BiasUnit, number, rounded
from fusion_core.chunk import Array

MAX_POINTS = 5000  # points of a panel; more are drawn as the alarms and an even sample
MAX_LOTS = 60  # lots that are drawn: the latest
MANY = 0.05  # share of the units that may lie beyond an axis
LIMITS = 300  # points of a limit that differs from unit to unit
TITLES = {
    "residual": "Residual of the map, rms of 30 s averages",
    "noise": "White noise",
    "walk": "Walk of the bias",
    "swing": "Swing of the map",
    "coast": "Prediction over 10 min without updates, rms of its error",
    "level": "Level of the map, mean over the range",
}
CAPTION = (
    "A point a unit; one far off stands at the edge, its value in the label. "
    "Dashed: three sigma about the middle of a line in control, wider where a unit is measured less "
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


def joint_charts(line: LineReport) -> list[Chart]:
    """Return the chart of T-squared, a panel an axis; none where no limits are frozen."""
    panels = []
    for joint in line.multivariate:
        place, out = (joint.at + 1).astype(np.float64), joint.beyond
        drawn = np.union1d(np.linspace(0, len(place) - 1, MAX_POINTS).astype(np.intp), np.flatnonzero(out))
        value, few = np.array([rounded(v, 4) for v in joint.value.tolist()]), np.unique([0, len(place) - 1])
        span = (0.0, 1.1 * float(max(np.percentile(joint.value, 100 * (1 - MANY)), 2 * np.max(joint.limit))))
        shown = np.minimum(value, span[1])
        lines = (
            Line(place[drawn], shown[drawn], "unit", "data", style="points"),
            Line(place[out], shown[out], "beyond the limit", "alarm", style="points"),
            Line(place[few], joint.limit[few], "limit", "limit", style="dashed"),
        )
        panels.append(Panel(lines, f"T-squared {joint.axis}", span=span))
    if not panels:
        return []
    names = ", ".join(map(figure_name, line.multivariate[0].quantities))
    caption = f"{names} of an axis together, by their frozen covariance: units that are unusual in what goes with what."
    return [Chart(tuple(panels), "unit", "T-squared", caption, named="units-of-the-line")]


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
    value = chart.value[np.isfinite(chart.value)]
    low, high = without_spikes(value, MANY)
    cut = np.flatnonzero((chart.value < low) | (chart.value > high))
    wide = not len(cut) and bool(np.min(value) > 0 and np.max(value) > 20 * np.median(value))
    drawn_at = np.clip(chart.value, low, high)
    lines = [
        *_usual(chart, shown),
        Line(place[drawn], shown(drawn_at[drawn]), "unit", "data", style="points"),
        Line(place[out], shown(drawn_at[out]), "beyond three sigma", "alarm", style="points"),
        Line(place[drawn], shown(chart.ewma[drawn]), "EWMA", "estimate"),
        *_limits(place, few, (chart.low, chart.high), shown, ewma=False),
        *_limits(place, few, (chart.ewma_low, chart.ewma_high), shown, ewma=True),
    ]
    shades = tuple(Shade(change.low + 0.5, change.high + 1.5, "change", "refused") for change in chart.changes)
    span = None if wide else _span(chart, (low, high), unit.factor)
    names = ", ".join(f"{line.units[chart.at[k]]} at {chart.value[k] * unit.factor:.3g}" for k in cut[:NAMED])
    names += f" and {len(cut) - NAMED} more" if len(cut) > NAMED else ""
    label = f"{figure_name(chart.quantity)} {chart.axis} [{unit.shown}]{'; beyond the axis: ' if names else ''}{names}"
    return Panel(tuple(lines), label, shades, log=wide, span=span)


def _span(chart: ControlChart, ends: tuple[float, float], factor: float) -> tuple[float, float]:
    """Return from where to where y is drawn: values between `ends`, and the limits of most units.

    A unit that is measured badly has limits so wide that nothing else could be distinguished.
    """
    all_of = np.concatenate([ends, chart.ewma_low, chart.ewma_high, [np.median(chart.low), np.median(chart.high)]])
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
    name = "limits of the EWMA" if ewma else "three sigma"
    style: LineStyle = "dotted" if ewma else "dashed"
    steady = all(np.ptp(values) <= 0.02 * abs(both[1] - both[0]).max() for values in both)
    at = few[[0, -1]] if steady else few
    return [Line(place[at], shown(values[at]), name, "limit", style=style) for values in both]


def distributions(line: LineReport) -> list[dict[str, Any]]:
    """Return the distribution of each quantity, a row a lot, a column an axis; none where the units have no lots.

    Each has `title`, `unit`, `axes`, the values at either end of the boxes of each axis (`scale`), the number of lots
    that are not drawn (`left_out`), and `rows` of a lot and its boxes, None where it has no value on an axis.
    """
    lots = list(dict.fromkeys(lot for lot in line.lots if lot))
    if not lots:
        return []
    result = []
    for name, charts in _by_quantity(line).items():
        spans, unit = [_lot_span(chart) for chart in charts], line.shown(name)
        boxes = [_boxes(line, chart, span) for chart, span in zip(charts, spans, strict=True)]
        result.append(
            {
                "title": TITLES.get(name, name),
                "unit": unit.shown,
                "axes": [chart.axis for chart in charts],
                "scale": [[number(end * unit.factor, zeros=True) for end in span] for span in spans],
                "rows": [(lot, [by_lot.get(lot) for by_lot in boxes]) for lot in lots[-MAX_LOTS:]],
                "left_out": max(len(lots) - MAX_LOTS, 0),
            }
        )
    return result


def _lot_span(chart: ControlChart) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(chart.value, (1, 99)))
    room = 0.05 * (high - low) or abs(high) or 1.0
    return low - room, high + room


def _boxes(line: LineReport, chart: ControlChart, span: tuple[float, float]) -> dict[str, dict[str, Any]]:
    """Return the units of each lot on one axis: how many, the median as a text, and places in per cent of the scale.

    `out` is where the lot's mean is beyond the limits of the line.
    """
    low, high = span
    factor, names = line.shown(chart.quantity).factor, np.array(line.lots)[chart.at]
    boxes = {}
    for lot in chart.lots:
        values = np.percentile(chart.value[names == lot.name], SHARES)
        places = np.clip(100 * (values - low) / (high - low), 0, 100).tolist()
        places = dict(zip(("low", "quarter", "half", "most", "high"), places, strict=True))
        boxes[lot.name] = {"n": lot.n, "text": number(values[2] * factor, zeros=True), "out": lot.out, **places}
    return boxes


LABEL = "temperature [°C]"
SHARES = (5, 25, 50, 75, 95)
NAMED = SERIES - 1  # odd units with a colour of their own; the first colour is the fan's
EACH = 20  # units of which each is drawn: percentiles of so few say little
DRAWN = 40  # odd units on an axis at most


@dataclass(frozen=True)
class SharedEffectRow:
    """An effect that the units share.

    Attributes
    ----------
    name : str
    sentence : str
        What it is, how large, and how sure.
    unit : str
        Of the sizes by lot, as they are shown.
    lots : tuple of (lot, units, axis, size, sigma)
        Its mean size in each lot, in `unit`.
    """

    name: str
    sentence: str
    unit: str = ""
    lots: tuple[tuple[str, int, str, float, float], ...] = ()

    @property
    def axes(self) -> list[str]:
        """The axes of `lots`, in their order."""
        return list(dict.fromkeys(axis for _, _, axis, _, _ in self.lots))

    @property
    def rows(self) -> list[tuple[str, int, list[str]]]:
        """Of each lot its name, its units, and a text an axis: the size, and by how much it may be off (1 sigma)."""
        rows: dict[str, tuple[int, dict[str, str]]] = {}
        for lot, n, axis, size, sigma in self.lots:
            rows.setdefault(lot, (n, {}))[1][axis] = f"{size:.3g} ± {sigma:.2g}"
        return [(lot, n, [texts.get(axis, "–") for axis in self.axes]) for lot, (n, texts) in rows.items()]


@dataclass(frozen=True, eq=False)
class FleetOverview:
    """The content of the page.

    Attributes
    ----------
    title : str
        Of the fleet.
    records : sequence of UnitRecord
        In the order of the manifest.
    unit : BiasUnit
        In which biases are shown.
    line : LineReport
    T : (G,) array
        degC.
    curves : (U, d, G) array
        Maps of the units over T, single precision will do.
    drawn : sequence of str
        Whose they are.
    mean : (d, G) array or None
        The family's curve.
    odd : mapping of str to sequence of Outlier
        By unit.
    effects : sequence of SharedEffectRow
    links : mapping of str to str
        Units' pages, relative to this one.
    remarks : sequence of str
        What else should be known.
    """

    title: str
    records: Sequence[UnitRecord]
    unit: BiasUnit
    line: LineReport
    T: Array
    curves: Any
    drawn: Sequence[str]
    mean: Array | None = None
    odd: Mapping[str, Sequence[Outlier]] = field(default_factory=dict)
    effects: Sequence[SharedEffectRow] = ()
    links: Mapping[str, str] = field(default_factory=dict)
    remarks: Sequence[str] = ()


def map_charts(overview: FleetOverview, ranges: Array) -> list[Chart]:
    """Return the fan of the units' curves, and that of what they are less their median.

    Below the first, how many units were measured at each temperature: `ranges` (n, 2) are those that each unit was
    soaked at, from and to, degC.
    """
    curves, T, U = overview.curves, overview.T, len(overview.drawn)
    if not U:
        return []
    caption = (
        f"Of {U:,} unit{'s' * (U != 1)}: broad band 5 to 95 %, narrow band 25 to 75 %, at each temperature on its "
        "own. Lines with a unit's name: of an odd shape on this axis."
    )
    low, high = ranges.T
    near = 0.5 * float(np.diff(T).max())  # a soak reaches the temperature of the grid that it comes nearest to
    count = np.array([np.sum((low <= at + near) & (at - near <= high)) for at in T], dtype=np.float64)
    line, span = Line(T, count, "units measured", "data"), (0.0, 1.1 * max(count.max(), 1.0))
    bands, below = percentiles(curves), Panel((line,), "units measured", height=0.6, span=span)
    panels = (*_fan(overview, bands, curves, overview.mean, "bias"), below)
    more = f"{caption} Below: at how many units' soaks this temperature was."
    charts = [Chart(panels, LABEL, "Maps of the units", more)]
    if U > 1:
        middle = bands[SHARES.index(50)].astype(curves.dtype)
        panels = _fan(overview, bands - middle, curves - middle, None, "less the median:")
        charts.append(Chart(panels, LABEL, "Deviation from the median of the units", caption))
    return charts


def _fan(overview: FleetOverview, bands: Array, curves: Any, mean: Array | None, quantity: str) -> tuple[Panel, ...]:
    drawn, axes = overview.drawn, overview.line.axes
    # what else is odd than a shape is not to be seen in a map
    bent = {name: {axis for one in odd if one.T is not None for axis in one.axis.split()}
            for name, odd in overview.odd.items()}  # fmt: skip
    bent = {name: axes for name, axes in bent.items() if axes}
    named = [name for name in drawn if name in bent][:NAMED]
    looks = {name: (name, series(k + 1)) for k, name in enumerate(named)}
    T, factor = overview.T, overview.unit.factor

    def lines(axis: int) -> Iterator[Line]:
        five, quarter, half, most, all_but_five = bands[:, axis] * factor
        yield Line(T, None, "90 % of the units", "estimate", five, all_but_five)
        yield Line(T, None, "half of the units (darker)", "estimate", quarter, most)
        yield Line(T, half, "median", "estimate")
        if mean is not None:
            yield Line(T, mean[axis] * factor, "mean of the family", "sigma", style="dashed")
        if len(drawn) <= EACH:
            for curve in curves[:, axis]:
                yield Line(T, np.asarray(curve, dtype=np.float64) * factor, "a unit", "data")
        odd = [k for k, name in enumerate(drawn) if axes[axis] in bent.get(name, ())]
        for k in odd[:DRAWN]:
            name, role = looks.get(drawn[k], ("more odd units", "alarm"))
            yield Line(T, np.asarray(curves[k, axis], dtype=np.float64) * factor, name, role)

    return axis_panels(axes, lines, quantity, overview.unit.shown, height=1.2)


def percentiles(curves: Any) -> Array:
    """Return percentiles SHARES (5, d, G) of curves (U, d, G), an axis at a time."""
    bands = [np.nanpercentile(curves[:, k], SHARES, axis=0) for k in range(curves.shape[1])]
    return np.stack(bands, axis=1).astype(np.float64)
