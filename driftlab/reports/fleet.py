"""The report of a fleet: what its units are like, which are odd, what the line did, and a row a unit.

One page for any number of units. Percentiles, charts and limits stand on all of them; of more than ROWS units the table
holds the odd, the failed and an even sample, and says so. U units with a map, d axes, G temperatures; values in SI.

The units of a fleet as the columns of a table that a page sorts and filters by itself.

Numbers are in the units that are shown, with four digits: of 5,000 units with eighteen figures that is a megabyte.

The tables of a line: its changes, and how well it keeps its limits.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.evaluation.limits import worst
from driftlab.family.outliers import describe
from driftlab.family.record import FIGURES
from driftlab.reports.fleet_charts import control_charts, distributions, fan, spread
from driftlab.reports.pages import embedded, write_page
from driftlab.spc.charts import PER
from driftlab.spc.sentences import by_how_much, place

if TYPE_CHECKING:
    from driftlab.family.outliers import Outlier
    from driftlab.family.record import UnitRecord
    from driftlab.reports.charts import Chart
    from driftlab.spc.charts import LineReport
    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array


FIRST = 20  # of them that are to be seen without opening the list
LISTED = 200  # odd or failed units in the lists of the page; all are in its table


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
        found: dict[str, tuple[int, dict[str, str]]] = {}
        for lot, n, axis, size, sigma in self.lots:
            found.setdefault(lot, (n, {}))[1][axis] = f"{size:.3g} ± {sigma:.2g}"
        return [(lot, n, [said.get(axis, "–") for axis in self.axes]) for lot, (n, said) in found.items()]


@dataclass(frozen=True, eq=False)
class FleetOverview:
    """What the page shows.

    Attributes
    ----------
    title : str
        Of the fleet.
    records : iterable of UnitRecord
        In the order of the manifest; gone through once.
    unit : BiasUnit
        In which biases are shown.
    line : Line
    T : (G,) array
        degC.
    curves : (U, d, G) array
        Maps of the units over T, single precision will do.
    drawn : sequence of str
        Whose they are.
    mean : (d, G) array or None
        The family's curve.
    odd : mapping of str to sequence of Odd
        By unit.
    effects : sequence of CommonEffect
    links : mapping of str to str
        Units' pages, relative to this one.
    numbers : sequence of (str, str)
        Of the run: what, and a text.
    remarks : sequence of str
        What else should be known.
    """

    title: str
    records: Iterable[UnitRecord]
    unit: BiasUnit
    line: LineReport
    T: Array
    curves: Any
    drawn: Sequence[str]
    mean: Array | None = None
    odd: Mapping[str, Sequence[Outlier]] = field(default_factory=dict)
    effects: Sequence[SharedEffectRow] = ()
    links: Mapping[str, str] = field(default_factory=dict)
    numbers: Sequence[tuple[str, str]] = ()
    remarks: Sequence[str] = ()


def write_fleet_report(path: Path, overview: FleetOverview) -> None:
    """Write `report.html` of a fleet."""
    line = overview.line
    reasons = {unit: describe(unit, tuple(found)).partition(": ")[2] for unit, found in overview.odd.items() if found}
    rows = gathered(overview.records, overview.unit, reasons, overview.links)
    write_page(
        path,
        "fleet",
        title=overview.title,
        lead=_lead(rows.count, rows.failed_count, len(reasons), len(overview.effects)),
        verdict=_odd(len(reasons), rows.count) + line.sentences[0],
        remarks=[*line.sentences[1:], *overview.remarks],
        numbers=[*overview.numbers, *rows.numbers],
        maps=_maps(overview, rows.ranges),
        lots=distributions(line),
        charts=control_charts(line),
        order=line.order,
        changes=changes_rows(line),
        capability=capability_rows(line),
        effects=overview.effects,
        odd=[(unit, overview.links.get(unit, ""), said) for unit, said in list(reasons.items())[:LISTED]],
        odd_count=len(reasons),
        first=FIRST,
        failed=[(unit, "", error) for unit, error in rows.failed[:LISTED]],
        failed_count=rows.failed_count,
        left_out=rows.left_out,
        rows_most=ROWS,
        names=embedded(list(line.units)),
        table=embedded(rows.table),
    )


def _maps(overview: FleetOverview, ranges: Array) -> list[Chart]:
    if not len(overview.drawn):
        return []
    of = (overview.T, overview.curves, overview.drawn, overview.line.axes, overview)
    return [fan(*of, ranges), *([spread(*of)] if len(overview.drawn) > 1 else [])]


def _odd(odd: int, count: int) -> str:
    return f"{odd:,} of {count:,} unit{'s' * (count != 1)} stand{'s' * (odd == 1)} out. " if odd else ""


def _lead(count: int, failed: int, odd: int, effects: int) -> str:
    parts = [f"{count:,} unit{'s' * (count != 1)}: {count - failed:,} done, {failed:,} failed", f"{odd:,} odd"]
    if effects:
        parts.append(f"{effects} effect{'s' if effects != 1 else ''} that they share")
    return "; ".join(parts)


ROWS = 5000
COLUMNS = ("unit", "date", "state", "odd", "verdict", "hours", "low", "high")
VERDICTS = ("pass", "undecided", "fail", "not measured", "not judged")


@dataclass(frozen=True, eq=False)
class FleetRows:
    """What the page says of all units.

    Attributes
    ----------
    count, failed_count, left_out : int
        Units, those that failed, and those that the table leaves out.
    failed : list of (unit, error)
    ranges : (n, 2) array
        Temperatures of each unit that is done, from and to, degC.
    numbers : list of (str, str)
        Hours of recordings, processor time, versions.
    table : dict
        Columns, for `fleet.js`.
    """

    count: int
    failed_count: int
    left_out: int
    failed: list[tuple[str, str]]
    ranges: Array
    numbers: list[tuple[str, str]]
    table: dict[str, Any]


def gathered(
    records: Iterable[UnitRecord], unit: BiasUnit, odd: Mapping[str, str], links: Mapping[str, str]
) -> FleetRows:
    """Return the rows of records (gone through once); of more than ROWS the odd, the failed and an even sample."""
    sample, count = _Sample(), 0
    failed: list[tuple[str, str]] = []
    ranges, hours, seconds = [], 0.0, 0.0
    versions: dict[str, int] = {}
    axes: tuple[str, ...] = ()
    for record in records:
        count += 1
        sample.add(_row(record, unit, odd.get(record.unit, ""), links.get(record.unit, "")))
        if record.state == "failed":
            failed.append((record.unit, record.error))
        axes = axes or record.axes
        hours, seconds = hours + record.hours, seconds + record.seconds
        versions[record.driftlab] = versions.get(record.driftlab, 0) + 1
        if record.domain is not None and record.state == "done":
            ranges.append(record.domain)
    shown = sample.rows()
    numbers = [("recordings at rest", f"{hours:,.1f} h")]
    if seconds and count:
        numbers.append(("time of one processor", f"{seconds:,.1f} s, {seconds / count:.2g} s a unit"))
    for version, many in versions.items():
        if version:
            said = version if len(versions) == 1 else f"{version}, {many:,} units"
            numbers.append(("computed by driftlab", said))
    return FleetRows(
        count=count,
        failed_count=len(failed),
        left_out=count - len(shown),
        failed=failed,
        ranges=np.array(ranges, dtype=np.float64).reshape(-1, 2),
        numbers=numbers,
        table=_table(shown, axes, unit),
    )


def _row(record: UnitRecord, unit: BiasUnit, why: str, link: str) -> dict[str, Any]:
    low, high = record.domain or (None, None)
    figures = []
    for name in FIGURES:
        figure = record.figures.get(name)
        figures.append([_short(v, unit.factor) for v in figure.value] if figure else [])
    return {
        "unit": record.unit, "lot": record.lot, "date": record.date, "more": record.more,
        "state": int(record.state == "failed"), "odd": int(bool(why)), "verdict": _verdict(record),
        "why": record.error if record.state == "failed" else why, "link": link,
        "hours": _short(record.hours), "low": _short(low), "high": _short(high), "figures": figures,
    }  # fmt: skip


def _short(value: float | None, factor: float = 1.0) -> float | None:
    return None if value is None or not np.isfinite(value) else float(f"{value * factor:.4g}")


def _verdict(record: UnitRecord) -> int:
    return VERDICTS.index(worst(record.limits) or "not judged")


class _Sample:
    """The rows of a table: the odd, the failed, and every one, second, fourth, ... of the others, as many as fit."""

    def __init__(self) -> None:
        self.must: list[tuple[int, dict[str, Any]]] = []
        self.rest: list[tuple[int, dict[str, Any]]] = []
        self.seen, self.others, self.step = 0, 0, 1

    def add(self, row: dict[str, Any]) -> None:
        """Take one more row."""
        self.seen += 1
        if row["state"] or row["odd"]:
            self.must.append((self.seen, row))
            return
        if self.others % self.step == 0:
            self.rest.append((self.seen, row))
        self.others += 1
        if len(self.rest) > ROWS:
            self.rest, self.step = self.rest[::2], 2 * self.step

    def rows(self) -> list[dict[str, Any]]:
        """Return what is shown, in the order in which it came."""
        return [row for _, row in sorted([*self.must, *self.rest], key=lambda one: one[0])]


def _table(rows: list[dict[str, Any]], axes: Sequence[str], unit: BiasUnit) -> dict[str, Any]:
    lots = sorted({row["lot"] for row in rows})
    place = {lot: k for k, lot in enumerate(lots)}
    figures = []
    for f, name in enumerate(FIGURES):
        columns = [
            [row["figures"][f][k] if k < len(row["figures"][f]) else None for row in rows] for k in range(len(axes))
        ]
        if any(value is not None for column in columns for value in column):
            figures.append({"name": name, "unit": unit.shown + PER.get(name, ""), "columns": columns})
    more = list(dict.fromkeys(name for row in rows for name in row["more"]))
    return {
        "axes": list(axes), "lots": lots, "verdicts": list(VERDICTS), "figures": figures,
        "lot": [place[row["lot"]] for row in rows],
        **{name: [row[name] for row in rows] for name in COLUMNS},
        "why": {k: row["why"] for k, row in enumerate(rows) if row["why"]},
        "links": {k: row["link"] for k, row in enumerate(rows) if row["link"]},
        "more": {name: [row["more"].get(name, "") for row in rows] for name in more},
    }  # fmt: skip


def changes_rows(line: LineReport) -> list[tuple[str, ...]]:
    """Return quantity, change, from which unit, its interval, before and after, and p, of each change in order."""
    found = [(change, chart) for chart in line.controls for change in chart.changes]
    rows: list[tuple[str, ...]] = []
    for change, chart in sorted(found, key=lambda one: (one[0].at, one[0].p)):
        unit = line.shown(chart.quantity)
        rows.append((
            f"{chart.quantity} {chart.axis}",
            by_how_much(line, chart, change),
            place(line, change.at),
            f"{line.units[change.low]} to {line.units[change.high]}",
            f"{change.before * unit.factor:.4g}",
            f"{change.after * unit.factor:.4g} {unit.shown}",
            "< 1e-9" if change.p < 1e-9 else f"{change.p:.1e}",
        ))  # fmt: skip
    for chart in line.controls:
        if (trend := chart.trend) is not None:
            unit, ends = line.shown(chart.quantity), [line.units[int(chart.at[k])] for k in (0, -1)]
            rows.append((
                f"{chart.quantity} {chart.axis}", f"{by_how_much(line, chart, trend)}, a trend", ends[0],
                f"{ends[0]} to {ends[1]}", f"{trend.before * unit.factor:.4g}",
                f"{trend.after * unit.factor:.4g} {unit.shown}", "–",
            ))  # fmt: skip
    return rows


def capability_rows(line: LineReport) -> list[tuple[str, ...]]:
    """Return quantity and axis, limit, units, Cpk, Ppk, its interval, those above, their share, and a note."""
    rows: list[tuple[str, ...]] = []
    for row in line.capability:
        unit = line.shown(row.quantity)
        notes = [f"in the scale: {row.scale}"]
        if not row.trusted:
            notes.append(f"not normal there (p = {row.normal:.1e}): the share above says more than the index")
        rows.append((
            f"{row.quantity} {row.axis}",
            f"{row.limit * unit.factor:.6g} {unit.shown}",
            f"{row.n:,} units" + (f" from {line.units[row.since]} on" if row.since else ""),
            f"{row.cpk:.2f}",
            f"{row.ppk:.2f}",
            f"{row.ppk_low:.2f} to {row.ppk_high:.2f}",
            f"{row.beyond:,}",
            f"{100 * row.share_low:.2g} to {100 * row.share_high:.2g} %",
            "; ".join(notes),
        ))  # fmt: skip
    return rows
