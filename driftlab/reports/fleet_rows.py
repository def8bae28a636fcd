"""The units of a fleet as the columns of a table that a page sorts and filters by itself.

Numbers are in the units that are shown, with four digits: of 5,000 units with eighteen figures that is a megabyte.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.family.charted import PER
from driftlab.family.record import FIGURES
from driftlab.judging.limits import worst

if TYPE_CHECKING:
    from driftlab.family.record import UnitRecord
    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array

ROWS = 5000
COLUMNS = ("unit", "date", "state", "odd", "verdict", "hours", "low", "high")
VERDICTS = ("pass", "undecided", "fail", "not measured", "not judged")


@dataclass(frozen=True, eq=False)
class Rows:
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


def gathered(records: Iterable[UnitRecord], unit: BiasUnit, odd: Mapping[str, str], links: Mapping[str, str]) -> Rows:
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
    return Rows(
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
