"""The charts of a line: control charts, distributions against limits and by lot.

A control chart has a panel an axis, a distribution against its limit a histogram and a normal probability plot an axis,
one by lot has boxes on one scale. m values, U units, d axes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.family.partitions import by_lot
from driftlab.family.record import figure_name
from driftlab.reports.charts import SERIES, Chart, Line, LineStyle, Panel, Shade, numbers, without_spikes
from driftlab.spc.capability import D2, Capability
from driftlab.spc.charts import D4, ControlChart, LineReport
from driftlab.units import BiasUnit, number
from fusion_core.chunk import Array, Flags

NAMED = SERIES - 1  # units far off that a label names
SHARES = (5, 25, 50, 75, 95)
MAX_POINTS = 5000  # points of a panel; more are drawn as the alarms and an even sample
MAX_RANGES = 1000  # moving ranges of a panel, beside those beyond the limit
MAX_LOTS = 60  # lots that are drawn: the latest
MANY = 0.05  # share of the units that may lie beyond an axis
CURVE = 20  # points of a trend
MAX_NAMES = 5000  # units up to which a page has the names of all, not of those alone that are drawn
TICKS = 50  # under an axis, more or less
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
    "well. Dotted: limits of the EWMA. Broad: what is usual between the changes; shaded: where a change is, by 95 %. "
    "Below, the moving range: how far a unit is from the one before it, in sigmas; of a line in control one in 110 is "
    "beyond the limit."
)


def control_charts(line: LineReport) -> list[Chart]:
    """Return the chart of each quantity; x is the place of the unit in the line, from 1."""
    result: list[Chart] = []
    for name, charts in _by_quantity(line).items():
        panels = tuple(panel for chart in charts for panel in (_panel(line, chart), *_ranges(chart)))
        caption = "" if result else CAPTION  # once on a page
        result.append(Chart(panels, "unit", TITLES.get(name, name), caption, named="units-of-the-line"))
    return result


def joint_charts(line: LineReport) -> list[Chart]:
    """Return the chart of T-squared, a panel an axis; none where no limits are frozen."""
    panels = []
    for joint in line.multivariate:
        place, out = (joint.at + 1).astype(np.float64), joint.beyond
        drawn = _drawn(out)
        value, few = _short(joint.value), np.unique([0, len(place) - 1])
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


def charts_of_units(line: LineReport) -> tuple[list[Chart], dict[int, str]]:
    """Return the charts over the units of a line, and name and date of units by their place, from 0 on.

    Of many, those that charts and axes show.
    """
    charts, places = [*joint_charts(line), *control_charts(line)], np.arange(len(line.units))
    if len(places) > MAX_NAMES:
        shown = [one.x for chart in charts for panel in chart.panels for one in panel.lines]
        ticks = np.arange(0, len(places) + 1, 10 ** int(np.log10(len(places) / TICKS)))[1:]
        places = np.unique(np.concatenate([ticks, *shown]).astype(np.int64)) - 1
    return charts, {k: f"{line.units[k]}\n{line.dates[k][:10]}".rstrip() for k in places.tolist()}


def _by_quantity(line: LineReport) -> dict[str, list[ControlChart]]:
    """Return the charts of each quantity."""
    quantities = dict.fromkeys(chart.quantity for chart in line.controls)
    return {name: [chart for chart in line.controls if chart.quantity == name] for name in quantities}


def _panel(line: LineReport, chart: ControlChart) -> Panel:
    unit = line.shown(chart.quantity)

    def shown(values: Array) -> Array:
        return _short(values * unit.factor)

    drawn = _drawn(chart.beyond)
    place = (chart.at + 1).astype(np.float64)
    few = np.unique(np.linspace(0, len(place) - 1, LIMITS).astype(int))
    out = np.flatnonzero(chart.beyond)
    every = chart.value
    value = every[np.isfinite(every)]
    low, high = without_spikes(value, MANY)
    spikes = bool(np.any((value < low) | (value > high)))
    wide = not spikes and bool(np.min(value) > 0 and np.max(value) > 20 * np.median(value))
    span = None if wide else _span(chart, (low, high), unit.factor)
    low, high = (0.0, np.inf) if span is None else (span[0] / unit.factor, span[1] / unit.factor)
    cut = np.flatnonzero((every < low) | (every > high))
    drawn_at, (ewma, *ewma_limits) = np.clip(every, low, high), chart.ewma
    lines = [
        *_usual(chart, shown),
        Line(place[drawn], shown(drawn_at[drawn]), "unit", "data", style="points"),
        Line(place[out], shown(drawn_at[out]), "beyond three sigma", "alarm", style="points"),
        Line(place[drawn], shown(ewma[drawn]), "EWMA", "estimate"),
        *_limits(place, few, chart.limits, shown, ewma=False),
        *_limits(place, few, (ewma_limits[0], ewma_limits[1]), shown, ewma=True),
    ]
    shades = tuple(Shade(change.low + 0.5, change.high + 1.5, "change", "refused") for change in chart.changes)
    names = ", ".join(f"{line.units[chart.at[k]]} at {every[k] * unit.factor:.3g}" for k in cut[:NAMED])
    names += f" and {len(cut) - NAMED} more" if len(cut) > NAMED else ""
    label = f"{figure_name(chart.quantity)} {chart.axis} [{unit.shown}]{'; beyond the axis: ' if names else ''}{names}"
    return Panel(tuple(lines), label, shades, log=wide, span=span)


def _ranges(chart: ControlChart) -> tuple[Panel, ...]:
    """Return the panel of the moving ranges; none of a single unit."""
    place, value = (chart.at[1:] + 1).astype(np.float64), chart.ranges
    if not len(value):
        return ()
    out, top = value > D4, 2.5 * D4
    few = np.unique(np.linspace(0, len(value) - 1, MAX_RANGES).astype(np.intp))
    shown = _short(np.minimum(value, top))
    ends = (chart.at[[0, -1]] + 1).astype(np.float64)  # as wide as the values above
    lines = (
        Line(place[few], shown[few], "moving range", "data"),
        Line(place[out], shown[out], "beyond three sigma", "alarm", style="points"),
        Line(ends, np.full(2, D2), "usual", "reference"),
        Line(ends, np.full(2, D4), "limit of the moving range", "limit", style="dashed"),
    )
    label = f"moving range, {figure_name(chart.quantity)} {chart.axis} [sigma]"
    return (Panel(lines, label, height=0.45, span=(0.0, max(1.1 * D4, float(np.max(shown))))),)


def _span(chart: ControlChart, ends: tuple[float, float], factor: float) -> tuple[float, float]:
    """Return from where to where y is drawn: values between `ends`, and the limits of most units.

    A unit that is measured badly has limits so wide that nothing else could be distinguished.
    """
    all_of = np.concatenate([ends, *chart.ewma[1:], [np.median(limit) for limit in chart.limits]])
    low, high = (float(v) * factor for v in (np.nanmin(all_of), np.nanmax(all_of)))
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - room, high + room


def _short(values: Array) -> Array:
    """Return values (m,) with four digits."""
    return np.array(numbers(values, 4), dtype=np.float64)


def _drawn(out: Flags) -> NDArray[np.intp]:
    """Return the values that are drawn, of which some are out (m,): all, or those and an even sample."""
    return np.union1d(np.linspace(0, len(out) - 1, MAX_POINTS).astype(np.intp), np.flatnonzero(out))


def _usual(chart: ControlChart, shown: Callable[[Array], Array]) -> list[Line]:
    """Return the usual level of each stretch; of a line without a change, the middle that the limits stand on."""
    if chart.trend is not None:
        first, last = chart.scale.to(np.array([chart.trend.before, chart.trend.after])).tolist()
        level = chart.scale.back(np.linspace(first, last, CURVE))
        return [Line(np.linspace(chart.at[0] + 1.0, chart.at[-1] + 1.0, CURVE), shown(level), "usual", "reference")]
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
                "chart": lot_chart(line, name, lots[-MAX_LOTS:]),
            }
        )
    return result


def lot_chart(line: LineReport, name: str, lots: list[str]) -> Chart:
    """Return the X-bar-S chart of a quantity: mean and deviation of each lot, two panels an axis."""
    unit, panels = line.shown(name), list[Panel]()
    for chart in _by_quantity(line)[name]:
        at = {lot: k + 1.0 for k, lot in enumerate(lots)}
        points = [point for point in chart.lots if point.name in at]
        if not points:
            continue
        x = np.array([at[point.name] for point in points])
        called = f"{figure_name(name)} {chart.axis}"
        mean = np.array([(point.mean, point.low, point.high) for point in points]).T * unit.factor
        out = np.array([point.out for point in points])
        panels.append(Panel(_points(x, mean, out), f"mean, {called} [{unit.shown}]", height=0.7))
        factor, of = _deviation_unit(chart.scale.name, unit)
        s = np.array([(point.deviation, point.deviation_low, point.deviation_high) for point in points]).T * factor
        uneven, known = np.array([point.uneven for point in points]), np.isfinite(s[0])
        if np.any(known):
            drawn = _points(x[known], s[:, known], uneven[known])
            panels.append(Panel(drawn, f"deviation, {called} [{of}]", height=0.7))
    return Chart(tuple(panels), "lot", f"{TITLES.get(name, name)}, X-bar-S by lot", named="lots-of-the-line")


def _deviation_unit(scale: str, unit: BiasUnit) -> tuple[float, str]:
    """Return the factor and the unit in which deviations in a scale are shown."""
    if scale == "log":
        return 100.0, "% of the value"
    return (float(np.sqrt(unit.factor)), f"sqrt({unit.shown})") if scale == "sqrt" else (unit.factor, unit.shown)


def _points(x: Array, values: Array, out: Flags) -> tuple[Line, ...]:
    value, low, high = map(_short, values)
    return (
        Line(x, value, "lot", "data"),
        Line(x, value, "lot", "data", style="points"),
        Line(x[out], value[out], "beyond the limits of so many units", "alarm", style="points"),
        Line(x, low, "limits of so many units", "limit", style="dashed"),
        Line(x, high, "limits of so many units", "limit", style="dashed"),
    )


def _lot_span(chart: ControlChart) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(chart.value, (1, 99)))
    room = 0.05 * (high - low) or abs(high) or 1.0
    return low - room, high + room


def _boxes(line: LineReport, chart: ControlChart, span: tuple[float, float]) -> dict[str, dict[str, Any]]:
    """Return the units of each lot on one axis: how many, the median as a text, and places in per cent of the scale.

    `out` is where the lot's mean is beyond the limits of the line.
    """
    (low, high), members = span, by_lot(line.lots[k] for k in chart.at.tolist())
    factor, of_units, boxes = line.shown(chart.quantity).factor, chart.value, dict[str, dict[str, Any]]()
    for lot in chart.lots:
        values = np.percentile(of_units[members[lot.name]], SHARES)
        places = np.clip(100 * (values - low) / (high - low), 0, 100).tolist()
        places = dict(zip(("low", "quarter", "half", "most", "high"), places, strict=True))
        boxes[lot.name] = {"n": lot.n, "text": number(values[2] * factor, zeros=True), "out": lot.out, **places}
    return boxes


AGAINST = (
    "Above, how many units have such a value; below, the values in order over the normal scores that the values of so "
    "many normal units would have: near the line they are normal, and of each place 95 % would lie within the band. "
    "Shaded: above the limit."
)
WIDE = 5.0  # largest value over the smallest, from which on x is logarithmic where the scale is
SCORES = 400  # points of a probability plot: all ends, and an even sample of the middle
ENDS = 50  # of them on either side
LAW = 80  # points of the law over a histogram
BINS = (8, 60)  # of a histogram, at least and at most


def limit_charts(line: LineReport) -> list[Chart]:
    """Return the distribution of each limited quantity against its limit, in the units that are shown.

    Of each axis a histogram of all units, and since the last change of its chart, and their normal probability plot.
    """
    result: list[Chart] = []
    for name, charts in _by_quantity(line).items():
        rows = {row.axis: row for row in line.capability if row.quantity == name}  # the latest of each axis
        charts = [chart for chart in charts if chart.axis in rows]
        if not charts:
            continue
        unit, limit = line.shown(name), next(iter(rows.values())).limit
        log = all(chart.scale.name == "log" for chart in charts)
        low, high = _ends(charts, limit)
        edges = _edges(charts, low, high, log=log)
        panels: list[Panel] = []
        for chart in charts:
            above = Shade(limit * unit.factor, edges[-1] * unit.factor, "above the limit", "hole")
            panels += _against(chart, rows[chart.axis], edges, unit.factor, above)
        caption = "" if result else AGAINST
        title, label = f"{TITLES.get(name, name)}, against its limit", f"{figure_name(name)} [{unit.shown}]"
        result.append(Chart(tuple(panels), label, title, caption, log=log and high > WIDE * low))
    return result


def _ends(charts: list[ControlChart], limit: float) -> tuple[float, float]:
    """Return from where to where values are drawn: all but a few far ones, and the limit."""
    spans = [without_spikes(chart.value, MANY) for chart in charts]
    low, high = min([limit, *(span[0] for span in spans)]), max([limit, *(span[1] for span in spans)])
    room = 0.04 * (high - low) or 0.1 * abs(high) or 1.0
    return max(low - room, 0.8 * low), high + room


def _edges(charts: list[ControlChart], low: float, high: float, *, log: bool) -> Array:
    """Return the edges of bins that suit the axis of least spread (Freedman and Diaconis), even in the scale."""
    first, last = (np.log(low), np.log(high)) if log else (low, high)
    widths = []
    for chart in charts:
        x = np.log(chart.value) if log else chart.value
        quarter, most = np.percentile(x, (25, 75))
        widths.append(2 * (most - quarter) / len(x) ** (1 / 3))
    width = min(widths) or (last - first) / BINS[0]
    edges = np.linspace(first, last, int(np.clip(np.ceil((last - first) / width), *BINS)) + 1)
    return np.exp(edges) if log else edges


def _against(chart: ControlChart, row: Capability, edges: Array, factor: float, above: Shade) -> list[Panel]:
    """Return histogram and probability plot of one axis; the plot is of the units of the capability's row."""
    from scipy.special import ndtr

    now = chart.value[chart.at >= row.since]
    x = chart.scale.to(now)
    mean, sd = float(np.mean(x)), float(np.std(x, ddof=1))
    called = f"{figure_name(chart.quantity)} {chart.axis}"
    out = chart.value[(chart.value < edges[0]) | (chart.value > edges[-1])] * factor
    ends = dict.fromkeys(f"{end(out):.3g}" for end in (np.min, np.max) if len(out))
    beyond = f"; beyond the axis: {len(out):,} at {' to '.join(ends)}" if ends else ""
    bars = [_bars(chart.value, edges, factor, "all units", "data")]
    if row.since:
        bars.append(_bars(now, edges, factor, "since the last change", "estimate"))
    if row.trusted:
        middle = np.interp(np.linspace(0.5, len(edges) - 1.5, LAW), np.arange(len(edges)), edges)  # of bins anywhere
        places = np.interp(middle, edges, np.arange(len(edges)))
        sides = (np.interp(places + half, np.arange(len(edges)), edges) for half in (-0.5, 0.5))
        low, high = (ndtr((chart.scale.to(np.maximum(end, 1e-300)) - mean) / sd) for end in sides)
        bars.append(Line(middle * factor, len(x) * (high - low), "normal law", "sigma"))
    p = "p < 0.0001" if row.normal < 1e-4 else f"p = {row.normal:.2g}"
    plot = Panel(
        _plot(chart, now, edges, factor, "estimate" if row.since else "data"),
        f"normal score [1], {called}; {p}",
        (above,),
        height=0.9,
    )
    return [Panel(tuple(bars), f"units [1], {called}{beyond}", (above,), height=0.7), plot]


def _bars(values: Array, edges: Array, factor: float, name: str, role: str) -> Line:
    """Return a histogram: x rises from edge to edge, so it falls within a thousandth of a bin."""
    count, _ = np.histogram(values, edges)
    slope = 1e-3 * np.diff(edges)
    x = np.column_stack([edges[:-1] + slope, edges[1:] - slope])
    x[0, 0], x[-1, -1] = edges[0], edges[-1]
    y = np.repeat(count, 2).astype(np.float64)
    return Line(x.ravel() * factor, y, name, role, np.zeros_like(y), y)


def _plot(chart: ControlChart, values: Array, edges: Array, factor: float, role: str) -> tuple[Line, ...]:
    """Return a normal probability plot: values in their order (Blom's places), and where each would be by 95 %."""
    from scipy.special import betaincinv, ndtri

    n, x = len(values), chart.scale.to(values)
    few = np.arange(n)
    if n > SCORES:
        few = np.unique(np.r_[few[:ENDS], np.linspace(ENDS, n - ENDS, SCORES - 2 * ENDS).astype(int), few[-ENDS:]])
    rank = few + 1
    z, ordered = ndtri((rank - 0.375) / (n + 0.25)), np.sort(values)[few]
    low, high = (ndtri(betaincinv(rank, n + 1 - rank, q)) for q in (0.025, 0.975))
    law, inside = chart.scale.back(np.mean(x) + np.std(x, ddof=1) * z), (ordered >= edges[0]) & (ordered <= edges[-1])
    shown = (law >= edges[0]) & (law <= edges[-1])
    return (
        Line(edges[[0, -1]] * factor, np.full(2, np.nan), "", "data"),  # as wide as the histogram
        Line(law[shown] * factor, z[shown], "normal law", "sigma", low[shown], high[shown]),
        Line(ordered[inside] * factor, z[inside], "unit", role, style="points"),
    )
