"""Sentences on a line: changes, present state, limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.family.record import FIGURES, figure_name
from driftlab.spc.acknowledgements import Alarm
from driftlab.spc.capability import WORTH
from driftlab.spc.charts import LEVEL, MIN_UNITS, SIGMAS
from driftlab.units import number, units

if TYPE_CHECKING:
    from driftlab.spc.charts import ControlChart, LineReport, StepChange, Trend


def sentences(line: LineReport) -> list[str]:
    """Return the changes in their order, each that others share once; then the charts, and the limits."""
    if not line.controls:
        return ["Too few units for charts of the line."]
    judged = _against_baseline(line)
    lines = _changes(line)
    if all(len(chart.at) < MIN_UNITS for chart in line.controls):
        lines = ["Too few units to look for changes of the line."]
    elif not lines:
        lots = dict.fromkeys(change.of_lot for chart in line.controls for change in chart.changes)
        off = f"Off as a whole: lot {', '.join(lots)}. Beside that no" if lots else "No"
        within = "within these" if judged else "in"
        lines = [f"{off} change of the line {within} {units(len(line.units))}, {line.order}."]
    if any(chart.rules for chart in line.controls):
        places = sorted({int(k) for c in line.controls for f in c.patterns.values() for k in c.at[_beginnings(f)]})
        which = f"at {units(len(places))}: {_names(line, places)}" if places else "at no unit"
        lines.append(f"Run rules begin to alarm {which}.")
    if line.partial:
        soaked = "unit was" if len(line.partial) == 1 else "units were"
        of_charts = "" if line.baseline is None else ": no swing, no prediction on the charts"
        which = _names(line, [*line.partial])
        lines.append(f"{len(line.partial):,} {soaked} soaked over another range than the others ({which}){of_charts}.")
    return [*judged, *lines, *_differences(line), *_now(line, counted=not judged), *_limits(line)]


def in_tables(line: LineReport) -> set[str]:
    """Return the sentences whose figures the tables of changes and of capability have."""
    return {*_changes(line), *_limits(line)}


def _changes(line: LineReport) -> list[str]:
    """Return the changes in their order, then the trends."""
    lines = [_change(line, group) for group in _together(line.controls)]
    return lines + [_trend(line, chart) for chart in line.controls if chart.trend is not None]


MANY = 4  # times more alarms of a line in control where few units or long tails made the limits
NAMED = 5  # units that a sentence names
CHANCE = 0.05  # probability that units that are independent are said to resemble one another
ALIKE = 0.3  # autocorrelation from which on limits by neighbours are too narrow by a fifth


def alarms(line: LineReport) -> dict[int, list[Alarm]]:
    """Return the alarms of units out of control, by place in the line: T-squared, limits, EWMA, then run rules.

    Against frozen limits; of the EWMA and of run rules, on all charts, the unit at which they begin to alarm.
    """
    found: dict[int, list[Alarm]] = {}
    for joint in line.multivariate:
        for k in np.flatnonzero(joint.beyond).tolist():
            order = np.argsort(-np.nan_to_num(joint.contributions[k]))[:2]
            most = ", ".join(f"{figure_name(joint.quantities[i])} {joint.contributions[k, i]:.3g}" for i in order)
            about = f"{joint.axis} T-squared {joint.value[k]:.3g}"
            text = f"{about}, limit {joint.limit[k]:.3g} (of it {most})"
            found.setdefault(int(joint.at[k]), []).append(Alarm(about, text))
    for chart in line.controls:
        unit, of_units = line.shown(chart.quantity), (chart.value, *chart.limits)
        for k in np.flatnonzero(chart.beyond & chart.of_family).tolist():
            value, low, high = (values[k] * unit.factor for values in of_units)
            low = low if chart.quantity == "level" else max(low, 0.0)
            about = f"{_called(chart)} {number(value)} {unit.shown}"
            alarm = Alarm(about, f"{about}, limits {number(low)} to {number(high)}")
            found.setdefault(int(chart.at[k]), []).append(alarm)
        begun = {"the EWMA leaves its limits here": chart.drifting & chart.of_family, **chart.patterns}
        for what, where in begun.items():
            for k in _beginnings(where):
                text = f"{_called(chart)}: {what}"
                found.setdefault(int(chart.at[k]), []).append(Alarm(text, text))
    return dict(sorted(found.items()))


def _beginnings(alarms: NDArray[np.bool_]) -> list[int]:
    """Return the places (m,) of alarms before which there is none."""
    return np.flatnonzero(alarms & ~np.concatenate([[False], alarms[:-1]])).tolist()


def _against_baseline(line: LineReport) -> list[str]:
    """Return the number of units beyond frozen limits, their names, and the number that chance alone would give."""
    base = line.baseline
    if base is None or all(limits.quantity == LEVEL for limits in base.limits):
        return []
    frozen = [chart for chart in line.controls if chart.of_family]
    if not frozen:
        return [f"Nothing was held against frozen limits (of {base.units:,} units): no unit has such a figure."]
    charts = [(chart.at, chart.beyond) for chart in frozen] + [(one.at, one.beyond) for one in line.multivariate]
    places = sorted({int(k) for at, beyond in charts for k in at[beyond]})
    days = f", made from {base.first} to {base.last}" if base.first else ""
    by = f"frozen limits (of {base.units:,} units{days})"
    lacking = [f"{axis} {figure_name(name)}" for name in FIGURES for axis in line.axes if base.of(name, axis) is None]
    few = "too few of its units have them, or most are alike"
    beside = [f"No limits are frozen of {', '.join(lacking)}: {few}."] if lacking else []
    if places:
        names = _names(line, places)
        usual = sum(len(at) for at, _ in charts) / 370
        chance = f"of a line in control {usual:.2g} to {MANY * usual:.2g} would be by chance, of {len(charts)} charts"
        verb = "is" if len(places) == 1 else "are"
        return [f"{len(places):,} of {units(len(line.units))} {verb} beyond {by}: {names}; {chance}.", *beside]
    moved = ", ".join(_called(chart) for chart in frozen if chart.drifting[-1])
    if moved:
        single = f"No single unit of {len(line.units):,} is beyond {by}"
        return [f"{single}, but the EWMA is: the line may have moved, {moved}.", *beside]
    laws = [law for chart in frozen if (law := base.of(chart.quantity, chart.axis)) is not None]
    ends = np.array([SIGMAS, -SIGMAS])
    reach = max(float(np.max(np.abs(law.deviations(ends)))) for law in laws)
    seen = f"half of the units that are off by {reach:.2g} deviations in one figure, the widest limit, would be seen"
    count = sum(len(chart.at) for chart in frozen)
    return [f"None of {count:,} values of {units(len(line.units))} is beyond {by}; {seen}.", *beside]


def _names(line: LineReport, places: list[int]) -> str:
    """Return the units at the first places, and the number of the others."""
    return _first([line.units[k] for k in places])


def place(line: LineReport, k: int) -> str:
    """Return a unit of the line with its date and lot: `0121 (2026-05-06, lot L06)`."""
    about = ", ".join(filter(None, [line.dates[k], f"lot {line.lots[k]}" if line.lots[k] else ""]))
    return f"{line.units[k]} ({about})" if about else line.units[k]


def _trend(line: LineReport, chart: ControlChart) -> str:
    assert chart.trend is not None
    first, last = line.units[int(chart.at[0])], line.units[int(chart.at[-1])]
    size = by_how_much(line, chart, chart.trend)
    return f"{_called(chart)} {size} from unit {first} to {last}: a trend, no step."


def by_how_much(line: LineReport, chart: ControlChart, change: StepChange | Trend) -> str:
    """Return the size of a change: `rose by 30 %`, or in the unit of the quantity where it may be negative."""
    way = "rose" if change.after > change.before else "fell"
    unit = line.shown(chart.quantity)
    if chart.quantity == "level" or change.before <= 0:
        return f"{way} by {number(abs(change.after - change.before) * unit.factor)} {unit.shown}"
    share = 100 * abs(change.after / change.before - 1)
    return f"{way} by {share:.{0 if share >= 10 else 1}f} %"


def _together(controls: Iterable[ControlChart]) -> list[list[tuple[ControlChart, StepChange]]]:
    """Return the changes that are no lot's by the place that they may share, the surest of each first."""
    of_line = ((c, change) for c in controls for change in c.changes if not change.of_lot)
    rest = sorted(of_line, key=lambda one: one[1].p)
    groups: list[list[tuple[ControlChart, StepChange]]] = []
    while rest:
        first = rest[0][1]
        same = [one for one in rest if one[1].low <= first.high and first.low <= one[1].high]
        groups.append(same)
        rest = [one for one in rest if one not in same]
    return sorted(groups, key=lambda group: group[0][1].at)


def _change(line: LineReport, group: list[tuple[ControlChart, StepChange]]) -> str:
    chart, change = group[0]
    text = f"{_called(chart)} {by_how_much(line, chart, change)} from unit {place(line, change.at)} on"
    if change.high > change.low:
        text += f" (95 %: between {line.units[change.low]} and {line.units[change.high]})"
    others = [f"{_called(c)} {by_how_much(line, c, other)}" for c, other in group[1:]]
    return f"{text}{'; about there also ' if others else ''}{', '.join(others)}."


def _called(chart: ControlChart) -> str:
    return f"{chart.axis} {figure_name(chart.quantity)}"


def _now(line: LineReport, *, counted: bool) -> list[str]:
    """Return the present state; `counted`: with the number of values beyond three sigma."""
    from scipy.special import ndtri

    out = [_called(c) for c in line.controls if c.drifting[-1] and c.at[-1] >= len(line.units) - 10]
    values = sum(len(chart.at) for chart in line.controls)
    beyond = sum(int(np.sum(chart.beyond)) for chart in line.controls)
    lines = [f"The EWMA is out of its limits at the end of the line: {', '.join(out)}."] if out else []
    lines += _came_back(line) + _off_lots(line)
    if counted:  # else the units beyond frozen limits are
        lines.append(
            f"{beyond:,} of {values:,} values lie beyond three sigma; of a line in control {_usual(line):.0f} would, "
            "its sigma being known no better than from these units."
        )
    chance = float(-ndtri(CHANCE / max(len(line.controls), 1)))  # of any of so many charts
    # what is added to it for its bias scatters as well
    least = {n: max(ALIKE, chance * (1 + 3 / n) / np.sqrt(n)) for n in {len(c.at) for c in line.controls}}
    charts = [c for c in line.controls if c.phi >= least[len(c.at)]]
    alike = [f"{_called(c)} {c.phi:.2g}" for c in sorted(charts, key=lambda c: -c.phi)]
    if alike:
        lines.append(
            f"Units resemble those before them (autocorrelation: {_first(alike)}): changes are "
            "reported beyond that, and limits by neighbours alarm more often than they say."
        )
    if line.too_few:
        lines.append(f"Too few units for a chart: {', '.join(line.too_few)}.")
    return lines


def _came_back(line: LineReport) -> list[str]:
    """Return in a sentence the frozen charts whose EWMA left its limits, and is within them at their last unit."""
    charts = [c for c in line.controls if c.of_family and np.any(c.drifting) and not c.drifting[-1]]
    each = [f"{_called(c)} from {line.units[c.at[_beginnings(c.drifting)[0]]]} on" for c in charts]
    return [f"The EWMA left its limits and came back: {_first(each)}."] if each else []


def _off_lots(line: LineReport) -> list[str]:
    """Return in a sentence the lots whose mean or deviation is beyond frozen limits, and the number by chance."""
    lots = [(lot, c) for c in line.controls if c.of_family for lot in c.lots if lot.name and lot.n > 1]
    off = [f"lot {lot.name} {_called(c)} mean" for lot, c in lots if lot.out]
    off += [f"lot {lot.name} {_called(c)} deviation" for lot, c in lots if lot.uneven]
    if not off:
        return []
    count = 2 * len(lots)
    verb = "is" if len(off) == 1 else "are"
    return [
        f"{len(off):,} of {count:,} means and deviations of lots {verb} beyond frozen limits, by chance "
        f"{count / 370:.2g} would be: {_first(off)}."
    ]


def _differences(line: LineReport) -> list[str]:
    """Return the figures that differ between groups of units, the least probable first."""
    lines = []
    for one in sorted(line.differences, key=lambda one: one.p):
        unit = line.shown(one.quantity)
        value, others = (f"{number(x * unit.factor)} {unit.shown}" for x in (one.value, one.others))
        chance = "p < 1e-15" if one.p < 1e-15 else f"p = {one.p:.1g}"
        figure = f"{figure_name(one.quantity).capitalize()} of {one.axis}"
        lines.append(
            f"{figure} differs by {one.column} ({chance}): {value} in the {units(one.units)} of {one.group}, where "
            f"those beside them have {others}."
        )
    return lines


def _first(texts: Sequence[str]) -> str:
    """Return the first texts, and the number of the others."""
    more = f" and {len(texts) - NAMED:,} more" if len(texts) > NAMED else ""
    return ", ".join(texts[:NAMED]) + more


def _usual(line: LineReport) -> float:
    """Return the expected number of values of a line in control beyond three sigma, by limits of so many units."""
    from scipy.special import ndtr, stdtr

    return sum(
        len(c.at) * 2 * float(ndtr(-SIGMAS) if c.of_family else stdtr(WORTH * (c.basis[1] - c.basis[0] - 1), -SIGMAS))
        for c in line.controls
    )


def _limits(line: LineReport) -> list[str]:
    lines = []
    for name in dict.fromkeys(row.quantity for row in line.capability):
        rows = [row for row in line.capability if row.quantity == name]
        latest = {row.axis: row for row in sorted(rows, key=lambda row: row.since)}
        unit, why = line.shown(name), {row.axis: row.why_not for row in latest.values() if row.why_not}
        most = max(latest.values(), key=lambda row: (row.beyond / row.n, not row.trusted))
        known = [row for row in latest.values() if row.trusted]
        worst = min(known, key=lambda row: row.ppk) if known and most.trusted else most
        since = f" since unit {line.units[worst.since]}" if worst.since else ""
        limit = f"{figure_name(name)}, limit {worst.limit * unit.factor:.6g} {unit.shown}"
        if worst.trusted:
            indices = (
                f"Cpk {worst.cpk:.2f} (95 %: {worst.cpk_low:.2f} to {worst.cpk_high:.2f}), "
                f"Ppk {worst.ppk:.2f} ({worst.ppk_low:.2f} to {worst.ppk_high:.2f})"
            )
            text = f"{limit}: {worst.axis} is worst{since}, {indices}, {worst.beyond:,} of {worst.n:,} units above"
        else:
            share = f"{100 * worst.share_low:.3g} to {100 * worst.share_high:.3g} %"
            above = f"{worst.beyond:,} of {worst.n:,} units above (95 %: {share})"
            text = f"{limit}: {worst.axis} is worst{since}, {above}"
        reasons = "; ".join(
            f"no index of {', '.join(axis for axis in why if why[axis] == reason)}: {reason}"
            for reason in dict.fromkeys(why.values())
        )
        text += ", of a line with a trend" * (worst.trend and worst.trusted)
        lines.append(f"{text}{'; ' * bool(reasons)}{reasons}.")
    return lines
