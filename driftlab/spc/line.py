"""Analysis of a line over time: of each quantity and axis a control chart, its changes, and its capability.

A line changes where its units say so with at most one false change in twenty clean lines, over all charts together.
Limits of a chart stand on the first stretch without a change that has twenty units, else on the longest; or on a family
that is known, where that has the law of a quantity in control. Units are in the order of their dates, several of one
day as the manifest has them.

Changes of the line that an odd lot explains, and odd lots that a change of the line explains, are taken out
(`reconcile`). n units, d axes; all values in SI.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from driftlab.config import Limits
from driftlab.family.baseline import Baseline, FrozenLimits, Together, covers, usable
from driftlab.family.outliers import SHAPE, LotOutlier
from driftlab.family.record import FIGURES, PER, UnitRecord, figure_name
from driftlab.family.tail_law import TailLaw
from driftlab.family.unit_records import RecordsOfUnits, at_places, figure_of
from driftlab.spc.capability import Capability, indices, share_beyond, why_no_index
from driftlab.spc.change_points import Course, LevelStep, course_of
from driftlab.spc.charts import (
    LEVEL,
    MIN_UNITS,
    ChartScale,
    ControlChart,
    InControl,
    LineReport,
    StepChange,
    Trend,
    TSquaredChart,
    far_out,
    in_control,
    scale_of,
)
from driftlab.spc.run_rules import RULES
from driftlab.spc.sentences import sentences
from driftlab.spc.stratification import differences, strata_of
from driftlab.spc.subgroups import LotPoint, lots_of
from driftlab.units import BiasUnit, default_unit
from fusion_core.chunk import Array

FALSE = 0.05  # changes found in a line without any, over all its charts
BASIS = 20  # units on which limits should stand
OF_THE_RANGE = ("swing", "coast")  # figures that a soak over a part of the range does not have


def line_of(
    records: Sequence[UnitRecord], limits: Limits | None, *, unit: BiasUnit | None = None,
    levels: Array | None = None, baseline: Baseline | None = None, rules: str | None = None, by: Iterable[str] = (),
) -> LineReport:  # fmt: skip
    """Return the report of a line.

    Parameters
    ----------
    records : sequence of UnitRecord
        In the order of the manifest. Failed units are left out.
    limits : Limits or None
        Of the config.
    unit : BiasUnit, optional
        Of the bias; that of the records, rad/s shown in deg/h, where it is left out.
    levels : (n, d) array, optional
        Of the n units that are done, in the order of their records: the mean of the map (SI) over the family's range.
    baseline : Baseline, optional
        Frozen laws, on which the limits of their quantities then stand, also of one unit.
    rules : str, optional
        Run rules beside three sigma, one of `driftlab.spc.run_rules.RULES`.
    by : iterable of str
        Columns by whose groups figures may differ, beside the manifest's own (`driftlab.spc.stratification`).
    """
    done = _done(records)
    line, place = _ordered(done, unit)
    known = {} if baseline is None else {(one.quantity, one.axis): one for one in baseline.limits}
    part = _partial(line, baseline)
    levels = None if levels is None else levels[place]
    left_out = part if baseline is not None else np.zeros_like(part)
    quantities = _Quantities(at_places(done, place), line.axes, levels, left_out, known)
    line = replace(line, baseline=baseline, partial=tuple(np.flatnonzero(part).tolist()))
    enough = quantities.enough()
    alpha = FALSE / max(sum(enough.values()), 1)
    of_rules, everywhere = RULES.get(rules or "", {}), np.arange(len(line.units))
    controls = tuple(
        _control(line, name, line.axes.index(axis), quantities, alpha, known.get((name, axis)), of_rules, everywhere)
        for (name, axis), there in enough.items() if there
    )  # fmt: skip
    too_few = tuple(f"{axis} {figure_name(name)}" for (name, axis), there in enough.items() if not there)
    line = replace(line, controls=controls, capability=_capability(controls, limits), too_few=too_few)
    strata = {column: [names[k] for k in place] for column, names in strata_of(done, by).items()}
    line = replace(line, multivariate=_multivariate(line), differences=differences(line, strata))
    return replace(line, sentences=tuple(sentences(line)))


def _partial(line: LineReport, baseline: Baseline | None) -> NDArray[np.bool_]:
    """Return the units (n,) that were soaked over another range than those of a baseline, or than most."""
    spans = [None if low != low else (low, high) for low, high in line.domains.tolist()]
    if baseline is not None:
        return np.array([not baseline.covered(span) for span in spans], dtype=bool)
    some = np.array([span for span in spans if span is not None])
    if len(some) < MIN_UNITS:
        return np.zeros(len(spans), dtype=bool)
    low, high = np.median(some, axis=0).tolist()
    return np.array([span is not None and not covers(span, (low, high)) for span in spans], dtype=bool)


@dataclass(frozen=True, eq=False)
class _Quantities:
    """The quantities of units in the order of a line, read one at a time, as a line may be long."""

    records: Sequence[UnitRecord]
    axes: tuple[str, ...]
    levels: Array | None
    partial: NDArray[np.bool_]
    known: Mapping[tuple[str, str], FrozenLimits]  # by quantity and axis

    def read(self, name: str) -> Array:
        """Return values and deviations (2, n, d) of a quantity, NaN where they are not known."""
        if name == LEVEL and self.levels is not None:
            return np.stack([self.levels, np.full(self.levels.shape, np.nan)])
        values = figure_of(self.records, name, len(self.axes))
        if name in OF_THE_RANGE:
            values[:, self.partial] = np.nan
        for k, axis in enumerate(self.axes):
            limits = self.known.get((name, axis))
            if limits is not None and limits.scale == "log":  # nothing shows: there is no logarithm
                values[:, ~(values[0, :, k] > 0), k] = np.nan
        return values

    def enough(self) -> dict[tuple[str, str], bool]:
        """Return True where there are units enough for a chart, by quantity and axis."""
        names = (*FIGURES, *(() if self.levels is None else (LEVEL,)))
        count = {name: np.sum(np.isfinite(self.read(name)[0]), axis=0) for name in names}
        return {
            (name, axis): bool(count[name][k] >= (1 if (name, axis) in self.known else MIN_UNITS))
            for name in names for k, axis in enumerate(self.axes)
        }  # fmt: skip


def _control(
    line: LineReport, name: str, k: int, quantities: _Quantities, alpha: float, known: FrozenLimits | None,
    rules: Mapping[str, Callable[[Array], NDArray[np.bool_]]], everywhere: NDArray[np.intp],
) -> ControlChart:  # fmt: skip
    """Return the chart of a quantity of axis k."""
    at = np.flatnonzero(np.isfinite(quantities.read(name)[0, :, k]))
    at = everywhere if len(at) == len(everywhere) else at  # charts of all units have the same places
    value, lots = quantities.read(name)[0, at, k], np.array(line.lots, dtype=np.str_)[at]
    scale = scale_of(value, size=name != LEVEL) if known is None else ChartScale(known.scale)
    frozen = None if known is None else InControl(known.centre, known.spread, known.share)
    usual = float(np.median(value) if frozen is None else scale.back(np.array(frozen.centre)))
    figures = partial(_figures, quantities, name, k, at, scale, usual, None if known is None else known.own)
    x, own = scale.to(value), figures()[1]
    whole = in_control(x, own).sigma(own) if len(x) >= MIN_UNITS else np.zeros(len(x))  # no change is looked for
    course = course_of(x, whole, alpha, _runs(lots.tolist()))
    level_steps, trend = course.steps, _trend(course, scale)
    stretches = list(pairwise([0, *(step.at for step in level_steps), len(x)]))
    start, stop = next((s for s in stretches if s[1] - s[0] >= BASIS), max(stretches, key=lambda s: s[1] - s[0]))
    law = in_control(x[start:stop], own[start:stop]) if frozen is None else frozen
    sigma = np.maximum(law.sigma(own.astype(np.float32).astype(np.float64)), 1e-100)  # of values that do not vary
    return ControlChart(
        quantity=name, axis=line.axes[k], unit=line.unit.si + PER.get(name, ""), at=at, scale=scale, figures=figures,
        basis=(int(at[start]), int(at[stop - 1]) + 1), centre=float(scale.back(np.array(law.centre))),
        changes=_changes(level_steps, stretches, x, sigma, scale, at),
        lots=_lots(lots, x, sigma, law, scale, known),
        trend=trend, law=law, rules=rules, phi=course.phi, frozen=known,
    )  # fmt: skip


def _multivariate(line: LineReport) -> tuple[TSquaredChart, ...]:
    """Return the charts of T-squared of the axes of which the baseline has a covariance."""
    result = []
    for together in () if line.baseline is None else line.baseline.together:
        z = {name: np.full(len(line.units), np.nan) for name in together.quantities}
        for chart in line.controls:
            if chart.axis == together.axis and chart.quantity in z:
                z[chart.quantity][chart.at] = chart.z
        value, limit, contributions = together.judged(z)
        at = np.flatnonzero(np.isfinite(value))
        if not len(at):
            continue
        result.append(TSquaredChart(together.axis, together.quantities, at, value[at], limit[at], contributions[at]))
    return tuple(result)


def baseline_of(line: LineReport, levels: Sequence[InControl]) -> Baseline:
    """Return the limits of a line, frozen; those of levels, which lots may shift, are `levels`, an axis each.

    Centres are those of the last stretch without a change. Tails and covariances are of deviations from the middle of
    each stretch; tails of a quantity are learnt from all axes. A quantity of which most values are the same has none.
    """
    frozen: list[FrozenLimits] = []
    scores: dict[str, dict[str, Array]] = {axis: {} for axis in line.axes}
    for axis, level in zip(line.axes, levels, strict=True):
        frozen.append(FrozenLimits(quantity=LEVEL, axis=axis, scale="as it is", **vars(level)))
    for name in dict.fromkeys(chart.quantity for chart in line.controls):
        charts = [chart for chart in line.controls if chart.quantity == name]
        u = np.stack([_about_stretches(line, chart) for chart in charts], axis=1)
        tails = None if name == LEVEL else TailLaw.of(u)
        for k, chart in enumerate(charts):
            if name == LEVEL:
                spread = levels[line.axes.index(chart.axis)].spread
                scores[chart.axis][name] = u[:, k] * chart.law.spread / max(spread, 1e-300)
                continue
            own = None if tails is None else tails.column(k)
            if own is None or not usable(own):  # most values are the same: there are no limits of the others
                continue
            law = chart.law
            limits = FrozenLimits(
                quantity=name, axis=chart.axis, scale=chart.scale.name, centre=law.centre + _moved(chart),
                spread=law.spread, share=law.share, own=float(np.median(chart.figures()[1])), tails=own,
            )  # fmt: skip
            frozen.append(limits)
            scores[chart.axis][name] = limits.scores(u[:, k])
    joint = (Together.of(axis, of_axis) for axis, of_axis in scores.items())
    when = {time: date[:10] for date in line.dates if (time := _time(date)) is not None}
    dates = [when[time] for time in sorted(when)] or [""]
    return Baseline(
        units=len(line.units), first=dates[0], last=dates[-1], domain=_domain(line), limits=tuple(frozen),
        together=tuple(one for one in joint if one is not None),
    )  # fmt: skip


def _moved(chart: ControlChart) -> float:
    """Return by how much the last stretch without a change is off that on which the limits stand, in the scale."""
    since = chart.changes[-1].at if chart.changes else 0
    x, last = chart.scale.to(chart.value), chart.at >= since
    basis = (chart.at >= chart.basis[0]) & (chart.at < chart.basis[1])
    return float(np.median(x[last]) - np.median(x[basis])) if since and np.sum(last) >= MIN_UNITS else 0.0


def _domain(line: LineReport) -> tuple[float, float] | None:
    """Return the temperatures, degC, between which most units were soaked."""
    known = line.domains[np.isfinite(line.domains[:, 0])]
    if not len(known):
        return None
    low, high = np.median(known, axis=0).tolist()
    return low, high


def _about_stretches(line: LineReport, chart: ControlChart) -> Array:
    """Return the deviations (U,) from the middle of each stretch without a change, in sigmas; NaN where not known."""
    z = np.full(len(line.units), np.nan)
    z[chart.at] = chart.z
    for start, stop in pairwise([0, *(change.at for change in chart.changes), len(z)]):
        part = z[start:stop]
        part -= np.nanmedian(part) if np.any(np.isfinite(part)) else 0.0
    return z


def _figures(
    quantities: _Quantities, name: str, k: int, at: NDArray[np.intp], scale: ChartScale, usual: float,
    least: float | None,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the values (m,), SI, of a quantity of axis k, and the deviations in the scale that they would have.

    Were each as `usual` (SI): what comes out large by chance has a large deviation of its own, what comes out small a
    small one. None is below the `least`, which is frozen with limits and is else the middle one: limits that are frozen
    do not depend on what other units are judged with a unit.
    """
    value, sigma = quantities.read(name)[:, at, k]
    if not usual > 0:
        return value, scale.sigma(value, sigma)
    own = scale.sigma(np.full(len(value), usual), sigma * np.minimum(1.0, usual / np.maximum(value, usual)))
    return value, np.maximum(own, np.median(own) if least is None else least)


def _trend(course: Course, scale: ChartScale) -> Trend | None:
    if course.slope is None:
        return None
    middle, half = course.slope.tolist()
    return Trend(*scale.back(np.array([middle - half, middle + half])).tolist())


def _runs(lots: list[str]) -> list[tuple[int, int]]:
    """Return from where to where units in a row are of one lot."""
    return list(pairwise([0, *(k for k in range(1, len(lots)) if lots[k] != lots[k - 1]), len(lots)]))


def _changes(
    level_steps: Sequence[LevelStep], stretches: list[tuple[int, int]], x: Array, sigma: Array, scale: ChartScale,
    at: NDArray[np.intp],
) -> tuple[StepChange, ...]:  # fmt: skip
    laws = [(float(np.median(x[i:j])), 1.2533 * float(np.median(sigma[i:j])) / np.sqrt(j - i)) for i, j in stretches]
    changes = []
    for step, (before, s), (after, r) in zip(level_steps, laws[:-1], laws[1:], strict=True):
        places = (int(at[step.at]), int(at[step.low]), int(at[step.high]))
        was, now = scale.back(np.array([before, after])).tolist()
        changes.append(StepChange(*places, was, now, float(np.hypot(s, r)), step.p))
    return tuple(changes)


def _lots(
    names: NDArray[np.str_], x: Array, sigma: Array, law: InControl, scale: ChartScale, known: FrozenLimits | None
) -> tuple[LotPoint, ...]:
    """Return the points of lots; where tails are known, limits of a deviation are those of its normal scores."""
    off, points = x - law.centre, []
    found = spreads = lots_of(names, off, sigma, None if known is None else float(np.median(sigma)))
    if known is not None and known.tails is not None:
        spreads = lots_of(names, known.scores(off / sigma) * sigma, sigma, float(np.median(sigma)))
    for (name, of_lot), (_, spread) in zip(found, spreads, strict=True):
        of_lot[5:] = spread[5:] * (of_lot[4] / spread[4] if spread[4] > 0 else 1.0)
        mean, low, high = scale.back(law.centre + of_lot[1:4]).tolist()
        out = bool(not of_lot[2] <= of_lot[1] <= of_lot[3])
        points.append(LotPoint(name, int(of_lot[0]), mean, low, high, out, *of_lot[4:].tolist()))
    return tuple(points)


def _capability(controls: tuple[ControlChart, ...], limits: Limits | None) -> tuple[Capability, ...]:
    """Return the indices of each limited quantity: over the whole line, and since its last change."""
    declared = {} if limits is None else limits.declared
    rows: list[Capability] = []
    for chart in controls:
        if chart.quantity not in declared:
            continue
        limit = declared[chart.quantity]
        for since in dict.fromkeys([0, *(change.at for change in chart.changes[-1:])]):
            part = chart.at >= since
            if np.sum(part) < MIN_UNITS:
                continue
            values = chart.value[part]
            x, n, beyond = chart.scale.to(values), len(values), int(np.sum(values > limit))
            limit_x = float(chart.scale.to(np.array(limit)))
            normal, why_not = why_no_index(x, far_out(x), limit_x, trend=chart.trend is not None)
            found = (np.nan,) * 6 if why_not else indices(x, limit_x)
            rows.append(
                Capability(
                    chart.quantity, chart.axis, limit, n, since, *found, beyond, *share_beyond(beyond, n),
                    chart.scale.name, normal, why_not, chart.trend is not None,
                )
            )  # fmt: skip
    return tuple(rows)


def _done(records: Sequence[UnitRecord]) -> Sequence[UnitRecord]:
    if isinstance(records, RecordsOfUnits):
        return records.in_state("done")
    return [record for record in records if record.state == "done"]


def _ordered(records: Sequence[UnitRecord], unit: BiasUnit | None) -> tuple[LineReport, NDArray[np.intp]]:
    """Return a line of units in their order, and their places (n,) among the records."""
    axes: tuple[str, ...] = ()
    si = ""
    columns: tuple[list[str], ...] = ([], [], [])
    domains = array("d")
    for record in records:
        axes, si = axes or record.axes, si or record.bias_unit
        for column, text in zip(columns, (record.unit, record.lot, record.date), strict=True):
            column.append(text)
        domains.extend(record.domain or (np.nan, np.nan))
    place, order = _places(columns[2])
    units, lots, dates = (tuple(column[k] for k in place) for column in columns)
    unit = default_unit(si) if unit is None else unit
    spans = np.frombuffer(domains).reshape(len(place), 2)[place]
    return LineReport(units=units, lots=lots, dates=dates, domains=spans, order=order, axes=axes, unit=unit), place


def _places(dates: list[str]) -> tuple[NDArray[np.intp], str]:
    """Return the places of units in their order, and its basis."""
    when = np.array([np.nan if (time := _time(date)) is None else time for date in dates])
    known = np.flatnonzero(np.isfinite(when))
    if not len(known):
        return np.arange(len(dates)), "in the order of the manifest, which has no dates"
    before = np.searchsorted(known, np.arange(len(dates)), "right")  # units with a date, up to each
    when = np.append(np.min(when[known]), when[known])[before]
    basis = "in the order of their dates"
    if len(known) < len(dates):
        basis += f"; {len(dates) - len(known)} without a date follow the unit that is before them in the manifest"
    return np.argsort(when, kind="stable"), basis


def _time(date: str) -> float | None:
    try:
        time = datetime.fromisoformat(date)
    except ValueError:
        return None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def reconcile(lots: Sequence[LotOutlier], line: LineReport) -> tuple[tuple[LotOutlier, ...], LineReport]:
    """Return the lots that are off by themselves, and the line beside them.

    A lot that is off the others shows as two changes of the line, one where it begins and one back where it ends: these
    are the lot's. A lot that is like the units before or after it, as far as the line has not changed, is not off by
    itself: the change is the line's. The curve of a unit is watched by its level.
    """
    by_themselves, controls = [], {(chart.quantity, chart.axis): chart for chart in line.controls}
    for lot in lots:
        key = (LEVEL if lot.what == SHAPE else lot.what, lot.axis)
        if key not in controls:
            by_themselves.append(lot)
            continue
        controls[key], own = _apart(lot, controls[key], line)
        by_themselves += [lot] if own else []
    line = replace(line, controls=tuple(controls.values()))
    return tuple(by_themselves), replace(line, sentences=tuple(sentences(line)))


def _apart(lot: LotOutlier, chart: ControlChart, line: LineReport) -> tuple[ControlChart, bool]:
    """Return the chart with the changes that are the lot's, and whether the lot is off by itself."""
    lots = np.array(line.lots)
    places = np.flatnonzero(lots == lot.lot)
    start, stop = int(places[0]), int(places[-1]) + 1
    if stop - start > len(places):  # mixed with others: no stretch of the line
        return chart, True
    begins = [change for change in chart.changes if change.low <= start <= change.high]
    ends = [change for change in chart.changes if change.low <= stop <= change.high]
    if begins and ends and (begins[0].after > begins[0].before) != (ends[0].after > ends[0].before):
        own = (begins[0], ends[0])
        marked = (replace(change, of_lot=lot.lot) if change in own else change for change in chart.changes)
        return replace(chart, changes=tuple(marked)), True
    return chart, not _as_neighbours(chart, lots == lot.lot, start, stop)


def _as_neighbours(chart: ControlChart, own: NDArray[np.bool_], start: int, stop: int) -> bool:
    """Return True if a change of the line explains an odd lot: it came where the lot began, or before, and stayed."""
    if not chart.changes:
        return False
    edges = np.array([0, *(change.at for change in chart.changes), len(own)])
    middle = (start + stop) // 2
    k = int(np.searchsorted(edges, middle, "right")) - 1
    inside = (chart.at >= edges[k]) & (chart.at < edges[k + 1])
    x, of_lot = chart.scale.to(chart.value), own[chart.at]
    rest, outside = inside & ~of_lot, ~inside & ~of_lot
    if not np.any(of_lot) or not np.any(outside):
        return False
    if not np.any(rest):
        return True
    off = abs(np.median(x[of_lot]) - np.median(x[rest]))
    return bool(off < abs(np.median(x[of_lot]) - np.median(x[outside])) / 2)
