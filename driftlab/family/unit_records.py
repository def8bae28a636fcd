"""Records of a fleet's units in memory: of each what the line, the tests and the page of all units need.

The whole record of a unit is in its `unit.json`; a hundred thousand of these would take gigabytes. Here a unit is its
row of columns, with texts that it has in common with others.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from driftlab.family.record import FIGURES, TERM_FIGURES, Figure, RepeatedSoak, TermParabolas, UnitRecord, table_of
from fusion_core.chunk import Array

HELD = (*FIGURES, "hysteresis", "soaks", *TERM_FIGURES)  # figures that are compared over units
NUMBERS = 5  # before the figures: domain, hours, samples, seconds
HEX = frozenset("0123456789abcdef")
OF_LIMITS = ("name", "verdict", "beside")  # of each row of a unit's limits

# key, error, repeated soaks and parabolas of the terms, where a stimulus measured them
_Alone = tuple[str, str, tuple[RepeatedSoak, ...], TermParabolas | None]
Rows = NDArray[np.integer[Any]]
BLANK = UnitRecord(key="", unit="", state="done")


class _FiguresOfRow(Mapping[str, Figure]):
    """Figures of a row by their names, each made when it is asked for: most who go through records ask for none."""

    def __init__(self, names: tuple[str, ...], d: int, values: Sequence[float], deviations: Sequence[float]) -> None:
        self.places = {name: slice(k * d, k * d + d) for k, name in enumerate(names)}
        self.columns = values, deviations

    def __getitem__(self, name: str) -> Figure:
        own = (column[self.places[name]] for column in self.columns)
        value, sigma = (tuple(None if v != v else v for v in part) for part in own)
        return Figure.model_construct(value=value, sigma=sigma)

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)


class UnitRecords:
    """Records by the names of their units; each is made anew when it is asked for, without the rest of its file.

    They are rows of columns: of each row its numbers, the values of its figures and their deviations in single
    precision, and what few rows have alone, as an error.
    """

    def __init__(self) -> None:
        self._rows, self.units = dict[str, int](), list[str]()  # of each row its unit
        self.codes, self.common = array("I"), list[tuple[Any, ...]]()  # of what rows have in common with others
        self._texts, self._known = dict[Any, Any](), dict[tuple[Any, ...], int]()
        # of each row 32 bytes of its key, the table of those with the same axes and figures, and its place there
        self._keys, self._kinds, self._places = bytearray(), array("I"), array("I")
        self._tables: dict[tuple[tuple[str, ...], ...], tuple[int, array[float], array[float]]] = {}
        self._alone: dict[int, _Alone] = {}

    def __contains__(self, unit: str) -> bool:
        return unit in self._rows

    def __setitem__(self, unit: str, record: UnitRecord) -> None:
        row, axes = len(self.units), record.axes
        limits = tuple(tuple((name, row[name]) for name in OF_LIMITS if name in row) for row in record.limits)
        names = tuple(name for name in HELD if name in record.figures)
        texts = (record.state, record.lot, record.date, tuple(record.more.items()), record.channel, record.bias_unit,
                 record.driftlab, limits, tuple(record.doubts))  # fmt: skip
        common = tuple([self._texts.setdefault(text, text) for text in texts])
        values, sigmas = record.table(names, len(axes))
        hashed = len(record.key) == 64 and set(record.key) <= HEX
        if record.error or record.repeats or record.parabolas or not hashed:
            self._alone[row] = record.key, record.error, tuple(record.repeats), record.parabolas
        self._rows[unit] = row
        self.units.append(unit)
        self._keys += bytes.fromhex(record.key) if hashed else bytes(32)
        code = self._known.setdefault(common, len(self.common))
        if code == len(self.common):
            self.common.append(common)
        table = (len(self._tables), array("d"), array("f"))
        kind, numbers, deviations = self._tables.setdefault((axes, names), table)
        self.codes.append(code)
        self._kinds.append(kind)
        self._places.append(len(numbers) // (NUMBERS + values.size))
        numbers.extend([*(record.domain or (np.nan, np.nan)), record.hours, record.samples, record.seconds])
        numbers.extend(values.ravel().tolist())
        deviations.extend(sigmas.ravel().tolist())

    def __getitem__(self, unit: str) -> UnitRecord:
        return self.at(self._rows[unit])

    def at(self, row: int) -> UnitRecord:
        """Return the record of a row."""
        state, lot, date, more, channel, bias_unit, driftlab, limits, doubts = self.common[self.codes[row]]
        unhashed = self._keys[32 * row : 32 * row + 32].hex(), "", (), None
        key, error, repeats, parabolas = self._alone.get(row, unhashed)
        (axes, names), (_, numbers, deviations) = [*self._tables.items()][self._kinds[row]]
        size = len(axes) * len(names)
        start, own = self._places[row] * (NUMBERS + size), self._places[row] * size
        low, high, hours, samples, seconds, *values = numbers[start : start + NUMBERS + size]
        figures = _FiguresOfRow(names, len(axes), values, deviations[own : own + size])
        return BLANK.model_copy(update={
            "key": key, "unit": self.units[row], "lot": lot, "date": date, "more": dict(more), "state": state,
            "error": error, "channel": channel, "bias_unit": bias_unit, "axes": axes,
            "domain": None if low != low else (low, high), "hours": hours, "samples": int(samples), "figures": figures,
            "limits": [dict(limit) for limit in limits], "seconds": seconds, "driftlab": driftlab,
            "repeats": list(repeats), "parabolas": parabolas, "doubts": list(doubts),
        })  # fmt: skip

    def of(self, units: Iterable[str]) -> RecordsOfUnits:
        """Return the records of some units, in that order."""
        return RecordsOfUnits(self, np.fromiter((self._rows[unit] for unit in units), dtype=np.uint32))

    def column(self, rows: Rows, name: str, d: int) -> Array:
        """Return values and deviations (2, n, d) of a figure of some rows, NaN where they are not known."""
        table, kinds = np.full((2, len(rows), d), np.nan), np.asarray(self._kinds)[rows]
        for (axes, names), (kind, *held) in self._tables.items():
            if name not in names or len(axes) != d:
                continue
            own = np.flatnonzero(kinds == kind)
            places, first = np.asarray(self._places)[rows[own]], d * names.index(name)
            for column, before, out in zip(held, (NUMBERS, 0), table, strict=True):
                of_kind = np.asarray(column).reshape(-1, before + d * len(names))
                out[own] = of_kind[places, before + first : before + first + d]
        return table

    def keys(self, rows: Rows) -> NDArray[np.uint64]:
        """Return the keys (n, 4) of the work on some rows: hashes of recordings and config, 0 where none is known."""
        return np.frombuffer(self._keys, dtype=np.uint64).reshape(-1, 4)[rows]

    def names(self, rows: Rows) -> set[str]:
        """Return the names of the figures that any of some rows has."""
        return {name for kind in np.unique(np.asarray(self._kinds)[rows]) for name in [*self._tables][kind][1]}


class RecordsOfUnits(Sequence[UnitRecord]):
    """Records of some units in order."""

    def __init__(self, records: UnitRecords, rows: Rows) -> None:
        self.records, self.rows = records, rows

    @property
    def units(self) -> list[str]:
        """The names of the units."""
        return [self.records.units[row] for row in self.rows]

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, k: int) -> UnitRecord: ...
    @overload
    def __getitem__(self, k: slice | Rows) -> RecordsOfUnits: ...
    def __getitem__(self, k: int | slice | Rows) -> UnitRecord | RecordsOfUnits:
        if isinstance(k, int):
            return self.records.at(int(self.rows[k]))
        return RecordsOfUnits(self.records, self.rows[k])

    def __iter__(self) -> Iterator[UnitRecord]:
        return map(self.records.at, map(int, self.rows))

    def same_recordings(self) -> list[list[str]]:
        """Return the names of units whose recordings are the same, byte by byte, in groups."""
        keys = self.records.keys(self.rows)
        _, group, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        twice = np.flatnonzero((count[group] > 1) & keys.any(axis=1))
        found: dict[int, list[str]] = {}
        for k, unit in zip(twice.tolist(), self[twice].units, strict=True):
            found.setdefault(int(group[k]), []).append(unit)
        return list(found.values())

    def in_state(self, state: str, *, in_doubt: bool | None = None) -> RecordsOfUnits:
        """Return those that are in a state; of those in doubt, or in none, where that is asked for."""
        of_codes = np.array(
            [one[0] == state and in_doubt in (None, bool(one[-1])) for one in self.records.common], dtype=bool
        )
        return self[np.flatnonzero(of_codes[np.asarray(self.records.codes)[self.rows]])]


def at_places(records: Sequence[UnitRecord], places: NDArray[np.intp]) -> Sequence[UnitRecord]:
    """Return the records at some places, in that order."""
    return records[places] if isinstance(records, RecordsOfUnits) else [records[k] for k in places]


def of_units(records: Sequence[UnitRecord], units: Iterable[str]) -> Sequence[UnitRecord]:
    """Return the records of some units, in that order; of one that is not done, or has none, one without figures."""
    if isinstance(records, RecordsOfUnits):
        return records.records.of(units)
    done = {record.unit: record for record in records if record.state == "done"}
    return [done.get(unit) or UnitRecord(key="", unit=unit, state="failed") for unit in units]


def figure_of(records: Sequence[UnitRecord], name: str, d: int) -> Array:
    """Return values and deviations (2, n, d) of a figure of records, NaN where they are not known."""
    if isinstance(records, RecordsOfUnits):
        return records.records.column(records.rows, name, d)
    return table_of((record.figures.get(name) for record in records), d)


def figures_in(records: Sequence[UnitRecord]) -> set[str]:
    """Return the names of the figures that any of some records has."""
    if isinstance(records, RecordsOfUnits):
        return records.records.names(records.rows)
    return {name for record in records for name in record.figures}
