"""The report of a fleet: what its units are like, which are odd, what the line did, and a row a unit.

One page for any number of units. Percentiles, charts and limits stand on all of them; of more than ROWS units the table
holds the odd, the failed and an even sample, and says so. Numbers of that table, which a page sorts and filters by
itself, are in the units that are shown, with four digits: of 5,000 units with eighteen figures that is a megabyte.
U units with a map, d axes, G temperatures; values in SI.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.evaluation.limits import verdict_of_units, worst
from driftlab.family.outliers import describe
from driftlab.family.record import FIGURES, PER, UnitRecord, figure_name
from driftlab.family.unit_records import at_places
from driftlab.reports.fleet_charts import FleetOverview, map_charts
from driftlab.reports.line_charts import MAX_LOTS, charts_of_units, distributions, limit_charts
from driftlab.reports.pages import embedded, write_page
from driftlab.spc.charts import LineReport
from driftlab.spc.sentences import alarms, by_how_much, in_tables, place
from driftlab.units import rounded

FIRST = 20  # of them that are to be seen without opening the list
LISTED = 200  # odd or failed units in the lists of the page; all are in its table


def write_fleet_report(path: Path, overview: FleetOverview) -> None:
    """Write `report.html` of a fleet."""
    line, effects, records = overview.line, overview.effects, overview.records
    reasons = {unit: describe(unit, tuple(odd)).partition(": ")[2] for unit, odd in overview.odd.items() if odd}
    failed = [(record.unit, "", record.error) for record in records if record.state == "failed"]
    done, odd, table = len(records) - len(failed), len(reasons), _table(overview, reasons)
    doubted = sum(bool(record.doubts) for record in records)
    done_over = (record.domain for record in records if record.domain and record.state == "done")
    domains = np.fromiter(chain.from_iterable(done_over), dtype=np.float64).reshape(-1, 2)
    lists, shown_below = _lists(overview, reasons), in_tables(line)
    charts, names = charts_of_units(line)
    write_page(
        path,
        "fleet",
        title=overview.title,
        lead=_lead(len(records), len(failed), odd, doubted, len(effects), judged=overview.judged),
        limits=verdict_of_units(record.limits for record in records if record.state == "done").capitalize(),
        outcome=_outcome(record for record in records if record.state == "done"),
        verdict=_headline(line, odd, doubted, done, odd - len(lists["odd"])),
        use=_use(line, len(lists["odd"]), len(lists["alarms"])),
        yields=overview.yields,
        called=figure_name,
        remarks=[*(one for one in line.sentences[1:] if one not in shown_below), *overview.remarks],
        numbers=_numbers(records),
        maps=map_charts(overview, domains),
        lots=distributions(line),
        lot_names=embedded([*dict.fromkeys(lot for lot in line.lots if lot)][-MAX_LOTS:]),
        charts=charts, names=embedded(names),
        **{name: rows[:LISTED] for name, rows in lists.items()},
        **{f"{name}_count": len(rows) for name, rows in lists.items()},
        gauge=overview.gauge,
        line=line,
        against=limit_charts(line),
        changes=changes(line),
        effects=effects,
        first=FIRST, listed=LISTED,
        failed=failed[:LISTED],
        failed_count=len(failed),
        left_out=len(records) - len(table["unit"]),
        table=embedded(table),
    )  # fmt: skip


def _lists(overview: FleetOverview, reasons: Mapping[str, str]) -> dict[str, list[tuple[str, str, str]]]:
    """Return unit, page and reasons of odd units, of those out of control, and of acknowledged ones, in lists apart.

    A unit whose alarms are not those of its last note has that with them.
    """
    line, known = overview.line, overview.acknowledged
    out = {line.units[k]: "; ".join(one.text for one in why) for k, why in alarms(line).items()}
    noted = {note.unit: f" (noted before: {note.text()})" for note in overview.notes}

    def rows(reasons: Mapping[str, str]) -> list[tuple[str, str, str]]:
        still = {unit: why + noted.get(unit, "") for unit, why in reasons.items() if unit not in known}
        return [(unit, overview.links.get(unit, ""), why) for unit, why in still.items()]

    both = {unit: "; ".join(own[unit] for own in (reasons, out) if unit in own) for unit in known}
    listed = [(unit, overview.links.get(unit, ""), f"{note.text()}: {both[unit]}") for unit, note in known.items()]
    return {"odd": rows(reasons), "alarms": rows(out), "acknowledged": listed}


def _outcome(records: Iterable[UnitRecord]) -> str | None:
    """Return the worst verdict of units; None where there is none."""
    return worst([{"verdict": word} for word in {worst(record.limits) for record in records}])


def _lead(units: int, failed: int, odd: int, doubted: int, effects: int, *, judged: bool) -> str:
    """Return the numbers of units and of effects that they share."""
    out = f"{odd:,} odd" if judged or odd else "whether any is odd was not judged"
    parts = [f"{units:,} unit{'s' * (units != 1)}: {units - failed:,} done, {failed:,} failed", out]
    parts[-1] += f", {doubted:,} of them in doubt" if doubted else ""
    parts += [f"{effects} effect{'s' * (effects != 1)} that they share"] if effects else []
    return "; ".join(parts)


def _headline(line: LineReport, odd: int, doubted: int, done: int, known: int) -> str:
    """Return the first sentence on the units and on their line: odd units are no quiet line."""
    if not odd:
        return line.sentences[0]
    among = "".join(f", {n:,} of them {what}" for n, what in ((doubted, "in doubt"), (known, "acknowledged")) if n)
    return f"{odd:,} of {done:,} units {'is' if odd == 1 else 'are'} odd{among}. {line.sentences[0]}"


def _use(line: LineReport, odd: int, out: int) -> str:
    """Return the meaning of the headline for use, of units that are odd or out of control and not acknowledged."""
    parts = ["hold the odd units back until their reasons are known"] * bool(odd)
    if any(chart.changes or chart.trend for chart in line.controls):
        parts.append("judge units before and after a change apart, and find what was changed there")
    if out or any(np.any(chart.beyond) for chart in line.controls if not chart.of_family):
        parts.append("look at the units beyond the limits of the charts")
    seen = "no reason is seen to judge these units apart"
    quiet = seen if line.controls else "add units: nothing is known of the line yet"
    return f"{'; '.join(parts) or quiet}."


ROWS = 5000
VERDICTS = ("pass", "undecided", "fail", "not measured", "not judged")


def _numbers(records: Sequence[UnitRecord]) -> list[tuple[str, str]]:
    """Return hours of recordings, processor time, and versions."""
    seconds, versions = sum(record.seconds for record in records), Counter(record.driftlab for record in records)
    numbers = [("recordings at rest", f"{sum(record.hours for record in records):,.1f} h")]
    if seconds:
        each = f"{seconds / len(records):.2g} s a unit"
        numbers.append(("time of one processor", f"{seconds:,.1f} s, {each}"))
    for version, count in versions.items():
        if version:
            text = version if len(versions) == 1 else f"{version}, {count:,} units"
            numbers.append(("computed by driftlab", text))
    return numbers


def _table(overview: FleetOverview, reasons: Mapping[str, str]) -> dict[str, Any]:
    """Return the columns of the table, in the order of the units, for `fleet.js`; `reasons` are why units are odd.

    It has at most ROWS: the odd, the failed, and every one, second, fourth, ... of the others, as many as fit.
    """
    special = np.array([r.state == "failed" or bool(reasons.get(r.unit)) for r in overview.records], dtype=bool)
    others, step = np.flatnonzero(~special), 1
    while len(others[::step]) > ROWS:
        step *= 2
    records = at_places(overview.records, np.sort([*np.flatnonzero(special), *others[::step]]).astype(np.intp))
    places = {lot: k for k, lot in enumerate(sorted({record.lot for record in records}))}
    axes = next((record.axes for record in overview.records if record.axes), ())
    unit, figures = overview.unit, []
    for name in FIGURES:
        values = [figure.value if (figure := record.figures.get(name)) else () for record in records]
        short = [[None if v is None else rounded(v * unit.factor, 4) for v in of_axes] for of_axes in values]
        columns = [[row[k] if k < len(row) else None for row in short] for k in range(len(axes))]
        if any(value is not None for column in columns for value in column):
            figures.append({"name": figure_name(name), "unit": unit.shown + PER.get(name, ""), "columns": columns})
    domains = [record.domain or (None, None) for record in records]
    why = [record.error if record.state == "failed" else reasons.get(record.unit, "") for record in records]
    more = dict.fromkeys(name for record in records for name in record.more)
    return {
        "axes": list(axes), "lots": list(places), "verdicts": list(VERDICTS), "figures": figures,
        "lot": [places[record.lot] for record in records],
        "unit": [record.unit for record in records],
        "date": [record.date for record in records],
        "state": [int(record.state == "failed") for record in records],
        "odd": [int(bool(reasons.get(record.unit))) for record in records],
        "verdict": [VERDICTS.index(worst(record.limits) or "not judged") for record in records],
        "hours": [rounded(record.hours, 4) for record in records],
        "low": [rounded(low, 4) for low, _ in domains],
        "high": [rounded(high, 4) for _, high in domains],
        "why": {k: text for k, text in enumerate(why) if text},
        "links": {k: link for k, record in enumerate(records) if (link := overview.links.get(record.unit))},
        "more": {name: [record.more.get(name, "") for record in records] for name in more},
    }  # fmt: skip


def changes(line: LineReport) -> list[dict[str, Any]]:
    """Return the changes of a line in their order, then its trends: each from which unit on, and between which."""
    steps = [(chart, change) for chart in line.controls for change in chart.changes]
    result = []
    for chart, change in sorted(steps, key=lambda pair: (pair[1].at, pair[1].p)):
        alone = f", of lot {change.of_lot} alone" if change.of_lot else ""
        text, where = by_how_much(line, chart, change) + alone, place(line, change.at)
        ends, p = (line.units[change.low], line.units[change.high]), "< 1e-9" if change.p < 1e-9 else f"{change.p:.1e}"
        result.append({"chart": chart, "change": change, "text": text, "where": where, "ends": ends, "p": p})
    for chart in line.controls:
        if (trend := chart.trend) is not None:
            ends = line.units[int(chart.at[0])], line.units[int(chart.at[-1])]
            text = f"{by_how_much(line, chart, trend)}, a trend"
            result.append({"chart": chart, "change": trend, "text": text, "where": ends[0], "ends": ends, "p": "–"})
    return result
