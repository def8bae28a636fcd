"""`units.parquet`: a row a unit and axis, written row by row; memory does not grow with the units."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.family.record import UnitRecord
from driftlab.fleets.columns import all_columns, named, schema
from driftlab.fleets.manifest import Entry
from driftlab.fleets.posteriors import OfTheFamily
from driftlab.judging.limits import VERDICTS, worst

if TYPE_CHECKING:
    from fusion_core.chunk import Array

FIGURES = ("residual", "noise", "walk", "swing", "coast", "coast_1min", "coast_5min", "coast_end")
Row = dict[str, Any]


def rows_of(
    entry: Entry,
    record: UnitRecord,
    family: OfTheFamily | None,
    odd: Sequence[str] | None,
    columns: Mapping[str, str],
) -> Iterator[Row]:
    """Yield the rows of a unit: `odd` says why it stands out, None where that is not known.

    `columns` says what the manifest's own are called.
    """
    row: Row = {"unit": entry.unit, "lot": entry.lot or None, "date": entry.date or None}
    row |= {columns[name]: value for name, value in entry.more.items()}
    row |= {name: getattr(record, name) or None for name in ("error", "channel", "bias_unit", "driftlab", "key")}
    row |= {"state": record.state, "seconds": record.seconds, "plugins": [_plugin(item) for item in record.plugins]}
    if record.state == "failed":
        yield row
        return
    low, high = record.domain or (None, None)
    row |= {"T_low": low, "T_high": high, "hours": record.hours, "samples": record.samples}
    row |= {"coast_of": record.coast_of or None, "coast_in_sample": record.coast_in_sample}
    row |= {"verdict": record.verdict, **_limits(record), **_loop(record)}
    if odd is not None:
        row |= {"odd": bool(odd), "odd_why": "; ".join(odd) or None}
    for k, axis in enumerate(record.axes):
        own: Row = {"axis": axis, "map_sigma": None if record.map_sigma is None else record.map_sigma[k]}
        for name in FIGURES:
            if (figure := record.figures.get(name)) is not None:
                own |= {name: figure.value[k], f"{name}_sigma": figure.sigma[k]}
        yield row | own | ({} if family is None else _of_the_family(family, k))


def _plugin(item: Mapping[str, Any]) -> str:
    return " ".join(str(item.get(name, "")) for name in ("family", "kind", "distribution", "version")).strip()


def _limits(record: UnitRecord) -> Row:
    by = {word: [str(row.get("name")) for row in record.limits if row.get("verdict") == word] for word in VERDICTS}
    return {"limits": worst(record.limits), "limits_failed": by["fail"], "limits_undecided": by["undecided"]}


def _loop(record: UnitRecord) -> Row:
    if record.loop is None:
        return {}
    effects = record.loop.get("effects") or []
    added = [str(item.get("kind", item)) if isinstance(item, Mapping) else str(item) for item in effects]
    return {"loop": record.loop.get("verdict") or record.loop.get("why_not"), "effects": added}


def _of_the_family(family: OfTheFamily, k: int) -> Row:
    def at(values: Array | None) -> float | None:
        return None if values is None else float(values[k])

    return {
        "knots": family.knots.tolist(),
        "coefficients": family.c[k].tolist(),
        "coefficients_sigma": family.sigma[k].tolist(),
        "family_sigma": at(family.map_sigma),
        "shape_distance": at(family.distance),
        "common_effect": at(family.common),
        "common_effect_sigma": at(family.common_sigma),
    }


class Table:
    """Rows on their way to a Parquet file: a line of JSON each, then all at once, piece by piece.

    Parameters
    ----------
    lines : Path
        Where the lines are kept meanwhile; `write` removes it.
    more : sequence of str
        The manifest's own columns.
    """

    def __init__(self, lines: Path, more: Sequence[str]) -> None:
        self.lines, self.names = lines, named(more)
        self.columns = all_columns(more)
        self._file = lines.open("w", encoding="utf-8")

    def add(self, entry: Entry, record: UnitRecord, family: OfTheFamily | None, odd: Sequence[str] | None) -> None:
        """Add the rows of a unit, as `rows_of` has them."""
        for row in rows_of(entry, record, family, odd, self.names):
            full = {name: _plain(row.get(name)) for name in self.columns}
            self._file.write(json.dumps(full, allow_nan=False) + "\n")

    def write(self, path: Path, metadata: Mapping[str, str]) -> None:
        """Write the file, with what its columns are in its metadata beside `metadata`."""
        import polars as pl

        self._file.close()
        described = {name: {"unit": c.unit, "meaning": c.meaning} for name, c in self.columns.items()}
        rows = pl.scan_ndjson(self.lines, schema=schema(self.columns), low_memory=True)
        rows.sink_parquet(path, metadata={**metadata, "columns": json.dumps(described)})
        self.lines.unlink()

    def close(self) -> None:
        """Give up what was not written."""
        self._file.close()
        self.lines.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
