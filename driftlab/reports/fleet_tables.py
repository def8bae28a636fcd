"""The tables of a line: its changes, and how well it keeps its limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

from driftlab.family.line_sentences import by_how_much, place

if TYPE_CHECKING:
    from driftlab.family.charted import Line


def changes_rows(line: Line) -> list[tuple[str, ...]]:
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


def capability_rows(line: Line) -> list[tuple[str, ...]]:
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
