"""What a line did over time: of each quantity and axis a control chart, where it changed, how well it keeps a limit.

A line changes where its units say so with at most one false change in twenty clean lines, over all charts together.
Limits of a chart stand on the first stretch without a change that has twenty units, else on the longest; or on a family
that is known, where it says what a quantity does in control.
n units, d axes; all values in SI.

The units of a line in the order in which they were made, and their quantities as arrays.

By date, several of one day as the manifest has them. n units, d axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from driftlab.config import Limits
from driftlab.family.record import FIGURES, UnitRecord
from driftlab.spc.capability import FEWEST, Capability, indices, share_beyond
from driftlab.spc.change_points import LevelStep, steps
from driftlab.spc.charts import (
    LEVEL,
    PER,
    SIGMAS,
    ChartScale,
    ControlChart,
    InControl,
    LineReport,
    LotPoint,
    StepChange,
    Trend,
    ewma,
    ewma_limit,
    in_control,
    normality,
    scale_of,
)
from driftlab.spc.sentences import sentences
from driftlab.units import RATE, BiasUnit
from fusion_core.chunk import Array

FALSE = 0.05  # changes found in a line without any, over all its charts
BASIS = 20  # units on which limits should stand


def line_of(
    records: Iterable[UnitRecord],
    limits: Limits | None,
    *,
    unit: BiasUnit | None = None,
    levels: Mapping[str, Array] | None = None,
    known: Mapping[str, Sequence[InControl]] | None = None,
) -> LineReport:
    """Return what a line did.

    Parameters
    ----------
    records : iterable of UnitRecord
        In the order of the manifest; gone through once. Failed units are left out.
    limits : Limits or None
        Of the config.
    unit : BiasUnit, optional
        Of the bias; that of the records, rad/s shown in deg/h, where it is left out.
    levels : mapping of str to (d,) array, optional
        By unit: the mean of its map (SI) over the family's range.
    known : mapping of str to sequence of InControl, optional
        By quantity: what each axis does in control (SI), on which its limits then stand, also of few units.
    """
    known = known or {}
    order = ordered(records, levels or {})
    if unit is None:
        unit = RATE if order.bias_unit in ("", RATE.si) else BiasUnit(order.bias_unit, order.bias_unit)
    names = (*FIGURES, *((LEVEL,) if levels else ()))
    charted = [
        (name, axis, k) for name in names for k, axis in enumerate(order.axes)
        if np.sum(np.isfinite(order.values[name][:, k])) >= (1 if name in known else FEWEST)
    ]  # fmt: skip
    controls = tuple(
        _control(order, name, axis, k, unit, FALSE / len(charted), known[name][k] if name in known else None)
        for name, axis, k in charted
    )
    left = [f"{a} {n}" for n in names for k, a in enumerate(order.axes) if (n, a, k) not in charted]
    line = LineReport(
        units=order.units, lots=order.lots, dates=order.dates, order=order.said, axes=order.axes, unit=unit,
        controls=controls, capability=_capability(controls, limits), too_few=tuple(left),
    )  # fmt: skip
    return replace(line, sentences=tuple(sentences(line)))


def _control(
    order: Order, name: str, axis: str, k: int, unit: BiasUnit, alpha: float, known: InControl | None
) -> ControlChart:
    values, sigmas = order.values[name][:, k], order.sigmas[name][:, k]
    at = np.flatnonzero(np.isfinite(values))
    value = values[at]
    scale = scale_of(value, size=name != LEVEL) if known is None else ChartScale("as it is")
    x, own = scale.to(value), _of_the_usual(scale, value, sigmas[at])
    whole = in_control(x, own).sigma(own) if len(x) >= FEWEST else np.zeros(len(x))  # no change is looked for
    found = _steps(x, whole, alpha, _runs([order.lots[place] for place in at]))
    trend = _trend(x, whole, found, scale)
    found = found if trend is None else []
    edges = [0, *(step.at for step in found), len(x)]
    stretches = list(pairwise(edges))
    start, stop = next((s for s in stretches if s[1] - s[0] >= BASIS), max(stretches, key=lambda s: s[1] - s[0]))
    law = in_control(x[start:stop], own[start:stop]) if known is None else known
    sigma = np.maximum(law.sigma(own), 1e-100)  # of values that do not vary
    z = (x - law.centre) / sigma
    w, reach, usual = ewma(z), ewma_limit(len(z)), float(np.median(sigma))
    flat = np.concatenate([(x[i:j] - np.median(x[i:j])) / sigma[i:j] for i, j in stretches])

    def back(y: Array) -> Array:
        return scale.back(law.centre + y)

    return ControlChart(
        quantity=name, axis=axis, unit=unit.si + PER.get(name, ""), at=at, value=value, scale=scale,
        normal=normality(flat), basis=(int(at[start]), int(at[stop - 1]) + 1),
        centre=float(scale.back(np.array(law.centre))), spread=law.spread, low=back(-SIGMAS * sigma),
        high=back(SIGMAS * sigma), ewma=back(w * usual), ewma_low=back(-reach * usual), ewma_high=back(reach * usual),
        beyond=np.abs(z) > SIGMAS, drifting=np.abs(w) > reach,
        changes=_changes(found, stretches, x, sigma, scale, at), lots=_lots(order, at, x, sigma, law, scale),
        trend=trend, of_family=known is not None,
    )  # fmt: skip


def _of_the_usual(scale: ChartScale, value: Array, sigma: Array) -> Array:
    """Return the deviations (n,) that values (n,) would have in the scale, were each as usual, as limits have it.

    What comes out large by chance has a large deviation of its own, and what comes out small a small one.
    """
    usual = float(np.median(value))
    if not usual > 0:
        return scale.sigma(value, sigma)
    own = scale.sigma(np.full(len(value), usual), sigma * np.minimum(1.0, usual / np.maximum(value, usual)))
    return np.maximum(own, np.median(own))


def _steps(x: Array, sigma: Array, alpha: float, blocks: list[tuple[int, int]]) -> list[LevelStep]:
    if not np.all(sigma > 0):
        return []
    return steps((x - np.median(x)) / sigma, np.median(sigma) / sigma, alpha, blocks)


def _trend(x: Array, sigma: Array, found: list[LevelStep], scale: ChartScale) -> Trend | None:
    """Return the trend of a line in which steps were found, if a straight line says more than they do.

    By the Bayesian information criterion, a step having a size and a place; a value counts to SIGMAS.
    """
    if not found:
        return None
    n, u = len(x), np.linspace(-1.0, 1.0, len(x))
    X, w = np.column_stack([np.ones(n), u]), 1 / sigma
    line = np.linalg.lstsq(X * w[:, None], x * w, rcond=None)[0]
    for _ in range(10):  # Huber's weights
        off = np.abs(x - X @ line) / sigma
        w = np.sqrt(np.minimum(1.345 / np.maximum(off, 1e-12), 1.0)) / sigma
        line = np.linalg.lstsq(X * w[:, None], x * w, rcond=None)[0]
    edges = [0, *(step.at for step in found), n]
    steps_of = np.concatenate([np.full(j - i, np.median(x[i:j])) for i, j in pairwise(edges)])
    cost = [float(np.sum(np.minimum(((x - model) / sigma) ** 2, SIGMAS**2))) for model in (X @ line, steps_of)]
    if cost[0] + 2 * np.log(n) >= cost[1] + (2 * len(found) + 1) * np.log(n):
        return None
    before, after = scale.back(line @ np.array([[1.0, 1.0], [-1.0, 1.0]])).tolist()
    return Trend(before, after)


def _runs(lots: list[str]) -> list[tuple[int, int]]:
    """Return from where to where units in a row are of one lot."""
    edges = [0, *(k for k in range(1, len(lots)) if lots[k] != lots[k - 1]), len(lots)]
    return list(pairwise(edges))


def _changes(
    found: list[LevelStep],
    stretches: list[tuple[int, int]],
    x: Array,
    sigma: Array,
    scale: ChartScale,
    at: NDArray[np.intp],
) -> tuple[StepChange, ...]:
    laws = [(float(np.median(x[i:j])), 1.2533 * float(np.median(sigma[i:j])) / np.sqrt(j - i)) for i, j in stretches]
    changes = []
    for step, (before, s), (after, r) in zip(found, laws[:-1], laws[1:], strict=True):
        places = (int(at[step.at]), int(at[step.low]), int(at[step.high]))
        was, now = scale.back(np.array([before, after])).tolist()
        changes.append(StepChange(*places, was, now, float(np.hypot(s, r)), step.p))
    return tuple(changes)


def _lots(
    order: Order, at: NDArray[np.intp], x: Array, sigma: Array, law: InControl, scale: ChartScale
) -> tuple[LotPoint, ...]:
    names = np.array(order.lots)[at]
    found = []
    for name in dict.fromkeys(names.tolist()):
        own = names == name
        weight = 1 / sigma[own] ** 2
        z = np.clip((x[own] - np.median(x[own])) / sigma[own], -SIGMAS, SIGMAS)
        mean = float(np.median(x[own]) + np.sum(weight * z * sigma[own]) / np.sum(weight))
        reach = SIGMAS / float(np.sqrt(np.sum(weight)))
        value, low, high = scale.back(np.array([mean, law.centre - reach, law.centre + reach])).tolist()
        found.append(LotPoint(name, int(np.sum(own)), value, low, high, abs(mean - law.centre) > reach))
    return tuple(found)


def _capability(controls: tuple[ControlChart, ...], limits: Limits | None) -> tuple[Capability, ...]:
    """Return the indices of each limited quantity: over the whole line, and since its last change."""
    declared = {} if limits is None else limits.declared
    found = []
    for chart in controls:
        if chart.quantity not in declared:
            continue
        limit = declared[chart.quantity]
        for since in dict.fromkeys([0, *(change.at for change in chart.changes[-1:])]):
            part = chart.at >= since
            if np.sum(part) < FEWEST:
                continue
            x = chart.scale.to(chart.value[part])
            n, beyond = len(x), int(np.sum(chart.value[part] > limit))
            spread = in_control(x, np.zeros(n)).spread
            said = indices(x, float(chart.scale.to(np.array(limit))), spread)
            found.append(
                Capability(
                    chart.quantity, chart.axis, limit, n, since, *said, beyond, *share_beyond(beyond, n),
                    chart.scale.name, normality(x),
                )
            )  # fmt: skip
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Order:
    """Units in order.

    Attributes
    ----------
    units, lots, dates : tuple of str
    said : str
        What the order stands on.
    axes : tuple of str
    bias_unit : str
        SI.
    values, sigmas : dict of str to (n, d) array
        By quantity; not a number where it is not known.
    """

    units: tuple[str, ...]
    lots: tuple[str, ...]
    dates: tuple[str, ...]
    said: str
    axes: tuple[str, ...]
    bias_unit: str
    values: dict[str, Array]
    sigmas: dict[str, Array]


def ordered(records: Iterable[UnitRecord], levels: Mapping[str, Array]) -> Order:
    """Return the units that are done, in order; `levels` (d,) by unit become the quantity `level`."""
    units: list[str] = []
    lots: list[str] = []
    dates: list[str] = []
    kept: list[tuple[list[float], list[float]]] = []
    axes: tuple[str, ...] = ()
    unit = ""
    for record in records:
        if record.state != "done":
            continue
        axes, unit = axes or record.axes, unit or record.bias_unit
        units.append(record.unit)
        lots.append(record.lot)
        dates.append(record.date)
        kept.append(_figures(record, len(axes)))
    place, said = _places(dates)
    n, d = len(units), len(axes)
    shape = (n, len(FIGURES), d)
    values = np.array([own for own, _ in kept], dtype=np.float64).reshape(shape)[place]
    sigmas = np.array([own for _, own in kept], dtype=np.float64).reshape(shape)[place]
    names = [units[k] for k in place]
    level = np.array([levels.get(name, np.full(d, np.nan)) for name in names], dtype=np.float64).reshape(n, d)
    return Order(
        units=tuple(names),
        lots=tuple(lots[k] for k in place),
        dates=tuple(dates[k] for k in place),
        said=said,
        axes=axes,
        bias_unit=unit,
        values={**{name: values[:, k] for k, name in enumerate(FIGURES)}, "level": level},
        sigmas={**{name: sigmas[:, k] for k, name in enumerate(FIGURES)}, "level": np.full((n, d), np.nan)},
    )


def _figures(record: UnitRecord, d: int) -> tuple[list[float], list[float]]:
    values: list[float] = []
    sigmas: list[float] = []
    for name in FIGURES:
        figure = record.figures.get(name)
        for kept, own in ((values, figure and figure.value), (sigmas, figure and figure.sigma)):
            numbers = [np.nan if v is None or not np.isfinite(v) else float(v) for v in own or ()]
            kept += (numbers + [np.nan] * d)[:d]
    return values, sigmas


def _places(dates: list[str]) -> tuple[list[int], str]:
    """Return the places of units in their order, and what it stands on."""
    when = [_time(date) for date in dates]
    known = sum(time is not None for time in when)
    if known == 0:
        return list(range(len(dates))), "in the order of the manifest, which has no dates"
    last, sorting = min(time for time in when if time is not None), []
    for k, time in enumerate(when):
        last = last if time is None else time
        sorting.append((last, k))
    said = "in the order of their dates"
    if known < len(dates):
        said += f"; {len(dates) - known} without a date follow the unit that is before them in the manifest"
    return [k for _, k in sorted(sorting)], said


def _time(date: str) -> float | None:
    try:
        found = datetime.fromisoformat(date)
    except ValueError:
        return None
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
