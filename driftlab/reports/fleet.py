"""The report of a fleet: what its units are like, which are odd, what the line did, and a row a unit.

One page for any number of units. Percentiles, charts and limits stand on all of them; of more than ROWS units the table
holds the odd, the failed and an even sample, and says so. U units with a map, d axes, G temperatures; values in SI.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.family.outliers import in_words
from driftlab.reports.fleet_charts import control_charts
from driftlab.reports.fleet_lots import distributions
from driftlab.reports.fleet_maps import fan, spread
from driftlab.reports.fleet_rows import ROWS, gathered
from driftlab.reports.fleet_tables import capability_rows, changes_rows
from driftlab.reports.pages import embedded, write_page

if TYPE_CHECKING:
    from driftlab.family.charted import Line
    from driftlab.family.outliers import Odd
    from driftlab.family.record import UnitRecord
    from driftlab.reports.charts import Chart
    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array

FIRST = 20  # of them that are to be seen without opening the list
LISTED = 200  # odd or failed units in the lists of the page; all are in its table


@dataclass(frozen=True)
class CommonEffect:
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
class Overview:
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
    line: Line
    T: Array
    curves: Any
    drawn: Sequence[str]
    mean: Array | None = None
    odd: Mapping[str, Sequence[Odd]] = field(default_factory=dict)
    effects: Sequence[CommonEffect] = ()
    links: Mapping[str, str] = field(default_factory=dict)
    numbers: Sequence[tuple[str, str]] = ()
    remarks: Sequence[str] = ()


def write_fleet_report(path: Path, overview: Overview) -> None:
    """Write `report.html` of a fleet."""
    line = overview.line
    reasons = {unit: in_words(unit, tuple(found)).partition(": ")[2] for unit, found in overview.odd.items() if found}
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


def _maps(overview: Overview, ranges: Array) -> list[Chart]:
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
