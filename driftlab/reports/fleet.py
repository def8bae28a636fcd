"""The report of a fleet: what its units are like, which are odd, what the line did, and a row a unit.

One page for any number of units. Percentiles, charts and limits stand on all of them; of more than ROWS units the table
holds the odd, the failed and an even sample, and says so. Numbers of that table, which a page sorts and filters by
itself, are in the units that are shown, with four digits: of 5,000 units with eighteen figures that is a megabyte.
U units with a map, d axes, G temperatures; values in SI.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from driftlab.evaluation.limits import verdict_of_units, worst
from driftlab.family.outliers import describe
from driftlab.family.record import FIGURES, UnitRecord
from driftlab.reports.fleet_charts import FleetOverview, control_charts, distributions, map_charts
from driftlab.reports.pages import embedded, write_page
from driftlab.spc.charts import PER, LineReport
from driftlab.spc.sentences import by_how_much, place
from driftlab.units import BiasUnit, rounded

FIRST = 20  # of them that are to be seen without opening the list
LISTED = 200  # odd or failed units in the lists of the page; all are in its table


def write_fleet_report(path: Path, overview: FleetOverview) -> None:
    """Write `report.html` of a fleet."""
    line, effects = overview.line, overview.effects
    reasons = {unit: describe(unit, tuple(odd)).partition(": ")[2] for unit, odd in overview.odd.items() if odd}
    rows = FleetRows(overview.unit)
    for record in overview.records:
        rows.add(record, reasons.get(record.unit, ""), overview.links.get(record.unit, ""))
    odd, failed, table = len(reasons), len(rows.failed), rows.table()
    units = f"{rows.count:,} unit{'s' * (rows.count != 1)}"
    lead = [f"{units}: {rows.count - failed:,} done, {failed:,} failed", f"{odd:,} odd"]
    lead += [f"{len(effects)} effect{'s' * (len(effects) != 1)} that they share"] if effects else []
    write_page(
        path,
        "fleet",
        title=overview.title,
        lead="; ".join(lead),
        limits=verdict_of_units(rows.limits).capitalize(),
        outcome=worst([row for of_unit in rows.limits for row in of_unit]),
        verdict=line.sentences[0],
        remarks=[*line.sentences[1:], *overview.remarks],
        numbers=rows.numbers(),
        maps=map_charts(overview, np.array(rows.ranges, dtype=np.float64).reshape(-1, 2)),
        lots=distributions(line),
        charts=control_charts(line),
        line=line,
        changes=changes(line),
        effects=effects,
        odd=[(unit, overview.links.get(unit, ""), why) for unit, why in list(reasons.items())[:LISTED]],
        odd_count=odd,
        first=FIRST,
        failed=[(unit, "", error) for unit, error in rows.failed[:LISTED]],
        failed_count=failed,
        left_out=rows.count - len(table["unit"]),
        names=embedded(list(line.units)),
        table=embedded(table),
    )


ROWS = 5000
COLUMNS = ("unit", "date", "state", "odd", "verdict", "hours", "low", "high")
VERDICTS = ("pass", "undecided", "fail", "not measured", "not judged")


class FleetRows:
    """The records of all units, one after the other, for the page.

    The table has at most ROWS: the odd, the failed, and every one, second, fourth, ... of the others, as many as fit.

    Attributes
    ----------
    count : int
        Units.
    failed : list of (unit, error)
    limits : list of lists of dict
        Of each unit that is done, held against it.
    ranges : list of (from, to)
        Temperatures of each unit that is done, degC.
    """

    def __init__(self, unit: BiasUnit) -> None:
        self.unit, self.count, self.hours, self.seconds = unit, 0, 0.0, 0.0
        self.failed: list[tuple[str, str]] = []
        self.limits: list[list[dict[str, Any]]] = []
        self.ranges: list[tuple[float, float]] = []
        self.versions: dict[str, int] = {}
        self.axes: tuple[str, ...] = ()
        self._special: list[tuple[int, dict[str, Any]]] = []
        self._sample: list[tuple[int, dict[str, Any]]] = []
        self._others, self._step = 0, 1

    def add(self, record: UnitRecord, why: str, link: str) -> None:
        """Take the next record; `why` it is odd, and the `link` to its page."""
        self.count += 1
        if record.state == "failed":
            self.failed.append((record.unit, record.error))
        elif record.state == "done":
            self.limits.append(record.limits)
            self.ranges += [] if record.domain is None else [record.domain]
        self.axes = self.axes or record.axes
        self.hours, self.seconds = self.hours + record.hours, self.seconds + record.seconds
        self.versions[record.driftlab] = self.versions.get(record.driftlab, 0) + 1
        row = self.count, _row(record, self.unit, why, link)
        if record.state == "failed" or why:
            self._special.append(row)
            return
        if self._others % self._step == 0:
            self._sample.append(row)
        self._others += 1
        if len(self._sample) > ROWS:
            self._sample, self._step = self._sample[::2], 2 * self._step

    def numbers(self) -> list[tuple[str, str]]:
        """Return hours of recordings, processor time, and versions."""
        numbers = [("recordings at rest", f"{self.hours:,.1f} h")]
        if self.seconds and self.count:
            each = f"{self.seconds / self.count:.2g} s a unit"
            numbers.append(("time of one processor", f"{self.seconds:,.1f} s, {each}"))
        for version, count in self.versions.items():
            if version:
                text = version if len(self.versions) == 1 else f"{version}, {count:,} units"
                numbers.append(("computed by driftlab", text))
        return numbers

    def table(self) -> dict[str, Any]:
        """Return the columns of the table, in the order in which the units came, for `fleet.js`."""
        rows = [row for _, row in sorted([*self._special, *self._sample], key=lambda numbered: numbered[0])]
        lots = sorted({row["lot"] for row in rows})
        places = {lot: k for k, lot in enumerate(lots)}
        more = dict.fromkeys(name for row in rows for name in row["more"])
        figures = []
        for f, name in enumerate(FIGURES):
            values = [row["figures"][f] for row in rows]
            columns = [[v[k] if k < len(v) else None for v in values] for k in range(len(self.axes))]
            if any(value is not None for column in columns for value in column):
                figures.append({"name": name, "unit": self.unit.shown + PER.get(name, ""), "columns": columns})
        return {
            "axes": list(self.axes), "lots": lots, "verdicts": list(VERDICTS), "figures": figures,
            "lot": [places[row["lot"]] for row in rows],
            **{name: [row[name] for row in rows] for name in COLUMNS},
            "why": {k: row["why"] for k, row in enumerate(rows) if row["why"]},
            "links": {k: row["link"] for k, row in enumerate(rows) if row["link"]},
            "more": {name: [row["more"].get(name, "") for row in rows] for name in more},
        }  # fmt: skip


def _row(record: UnitRecord, unit: BiasUnit, why: str, link: str) -> dict[str, Any]:
    low, high = record.domain or (None, None)
    figures = [figure.value if (figure := record.figures.get(name)) else () for name in FIGURES]
    return {
        "unit": record.unit, "lot": record.lot, "date": record.date, "more": record.more,
        "state": int(record.state == "failed"), "odd": int(bool(why)),
        "verdict": VERDICTS.index(worst(record.limits) or "not judged"),
        "why": record.error if record.state == "failed" else why, "link": link,
        "hours": rounded(record.hours, 4), "low": rounded(low, 4), "high": rounded(high, 4),
        "figures": [[None if v is None else rounded(v * unit.factor, 4) for v in values] for values in figures],
    }  # fmt: skip


def changes(line: LineReport) -> list[dict[str, Any]]:
    """Return the changes of a line in their order, then its trends: each from which unit on, and between which."""
    steps = [(chart, change) for chart in line.controls for change in chart.changes]
    result = []
    for chart, change in sorted(steps, key=lambda pair: (pair[1].at, pair[1].p)):
        result.append({
            "chart": chart, "change": change, "text": by_how_much(line, chart, change), "where": place(line, change.at),
            "ends": (line.units[change.low], line.units[change.high]),
            "p": "< 1e-9" if change.p < 1e-9 else f"{change.p:.1e}",
        })  # fmt: skip
    for chart in line.controls:
        if (trend := chart.trend) is not None:
            text, ends = by_how_much(line, chart, trend), (line.units[int(chart.at[0])], line.units[int(chart.at[-1])])
            row = {
                "chart": chart,
                "change": trend,
                "text": f"{text}, a trend",
                "where": ends[0],
                "ends": ends,
                "p": "–",
            }
            result.append(row)
    return result
