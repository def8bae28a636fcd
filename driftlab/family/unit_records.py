"""Records of a fleet's units in memory: of each what the line, the tests and the page of all units need.

The whole record of a unit is in its `unit.json`; a hundred thousand of these would take gigabytes. Here a unit is its
row of columns, with texts that it has in common with others.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from driftlab.family.record import FIGURES, TERM_FIGURES, Figure, RepeatedSoak, TermParabolas, UnitRecord
from fusion_core.chunk import Array

HELD = (*FIGURES, "hysteresis", "soaks", *TERM_FIGURES)  # figures that are compared over units
NUMBERS = 5  # before the figures: domain, hours, samples, seconds
HEX = frozenset("0123456789abcdef")
OF_LIMITS = ("name", "verdict", "beside")  # of each row of a unit's limits

# key, error, repeated soaks and parabolas of the terms, where a stimulus measured them
_Alone = tuple[str, str, tuple[RepeatedSoak, ...], TermParabolas | None]


class UnitRecords:
    """Records by the names of their units; each is made anew when it is asked for, without the rest of its file.

    They are rows of columns: of each row its numbers, the values of its figures and their deviations in single
    precision, and what few rows have alone, as an error.
    """

    def __init__(self) -> None:
        self._rows: dict[str, int] = {}
        self._keys = bytearray()  # 32 bytes a row
        self._codes = array("I")  # of what rows have in common with others
        self._common, self._texts, self._known = list[tuple[Any, ...]](), dict[Any, Any](), dict[tuple[Any, ...], int]()
        self._numbers, self._sigmas = array("d"), array("f")
        self._starts = array("Q"), array("Q")  # of numbers and sigmas
        self._alone: dict[int, _Alone] = {}

    def __contains__(self, unit: str) -> bool:
        return unit in self._rows

    def __setitem__(self, unit: str, record: UnitRecord) -> None:
        row, d = len(self._codes), len(record.axes)
        limits = tuple(tuple((name, row[name]) for name in OF_LIMITS if name in row) for row in record.limits)
        names = tuple(name for name in HELD if name in record.figures)
        common = (record.state, record.lot, record.date, tuple(record.more.items()), record.channel, record.bias_unit,
                  record.axes, record.driftlab, limits, names)  # fmt: skip
        values, sigmas = record.table(names, d)
        hashed = len(record.key) == 64 and set(record.key) <= HEX
        if record.error or record.repeats or record.parabolas or not hashed:
            self._alone[row] = record.key, record.error, tuple(record.repeats), record.parabolas
        self._rows[unit] = row
        self._keys += bytes.fromhex(record.key) if hashed else bytes(32)
        self._codes.append(self._code(tuple(self._texts.setdefault(text, text) for text in common)))
        for starts, column in zip(self._starts, (self._numbers, self._sigmas), strict=True):
            starts.append(len(column))
        self._numbers.extend([*(record.domain or (np.nan, np.nan)), record.hours, record.samples, record.seconds])
        self._numbers.extend(values.ravel().tolist())
        self._sigmas.extend(sigmas.ravel().tolist())

    def __getitem__(self, unit: str) -> UnitRecord:
        row = self._rows[unit]
        state, lot, date, more, channel, bias_unit, axes, driftlab, limits, names = self._common[self._codes[row]]
        key, error, repeats, parabolas = self._alone.get(row) or (
            self._keys[32 * row : 32 * row + 32].hex(),
            "",
            (),
            None,
        )
        start, own, d = self._starts[0][row], self._starts[1][row], len(axes)
        low, high, hours, samples, seconds = self._numbers[start : start + NUMBERS]
        figures = {}
        for k, name in enumerate(names):
            columns = ((self._numbers, start + NUMBERS + k * d), (self._sigmas, own + k * d))
            value, sigma = (tuple(None if v != v else v for v in part[at : at + d]) for part, at in columns)
            figures[name] = Figure.model_construct(value=value, sigma=sigma)
        return UnitRecord.model_construct(
            key=key, unit=unit, lot=lot, date=date, more=dict(more), state=state, error=error, channel=channel,
            bias_unit=bias_unit, axes=axes, domain=None if low != low else (low, high), hours=hours,
            samples=int(samples), figures=figures, limits=[dict(row) for row in limits], seconds=seconds,
            driftlab=driftlab, repeats=list(repeats), parabolas=parabolas,
        )  # fmt: skip

    def of(self, units: Sequence[str]) -> RecordsOfUnits:
        """Return the records of some units, in that order."""
        return RecordsOfUnits(self, units)

    def column(self, units: Sequence[str], name: str, d: int) -> Array:
        """Return values and deviations (2, n, d) of a figure of some units, NaN where they are not known."""
        rows = self._places(units)
        table, codes = np.full((2, len(units), d), np.nan), np.asarray(self._codes)[rows]
        for code in np.unique(codes):
            *_, axes, _, _, names = self._common[code]
            if name not in names or len(axes) != d:
                continue
            of_code, at = np.flatnonzero(codes == code), d * names.index(name) + np.arange(d)
            for held, starts, before, out in zip(
                (self._numbers, self._sigmas), self._starts, (NUMBERS, 0), table, strict=True
            ):
                first = np.asarray(starts)[rows[of_code]].astype(np.intp) + before
                out[of_code] = np.asarray(held)[first[:, None] + at]
        return table

    def keys(self, units: Sequence[str]) -> NDArray[np.uint64]:
        """Return the keys (n, 4) of the work on some units: hashes of recordings and config, 0 where none is known."""
        return np.frombuffer(self._keys, dtype=np.uint64).reshape(-1, 4)[self._places(units)]

    def _places(self, units: Sequence[str]) -> NDArray[np.intp]:
        """Return the rows (n,) of some units."""
        return np.fromiter((self._rows[unit] for unit in units), dtype=np.intp, count=len(units))

    def names(self, units: Sequence[str]) -> set[str]:
        """Return the names of the figures that any of some units has."""
        codes = {self._codes[self._rows[unit]] for unit in units}
        return {name for code in codes for name in self._common[code][-1]}

    def state(self, unit: str) -> str:
        """Return the state of a unit: `done` or `failed`."""
        return str(self._common[self._codes[self._rows[unit]]][0])

    def _code(self, common: tuple[Any, ...]) -> int:
        """Return the number of what a row has in common with others."""
        if common not in self._known:
            self._known[common] = len(self._common)
            self._common.append(common)
        return self._known[common]


class RecordsOfUnits(Sequence[UnitRecord]):
    """Records of some units in order."""

    def __init__(self, records: UnitRecords, units: Sequence[str]) -> None:
        self.records, self.units = records, units

    def __len__(self) -> int:
        return len(self.units)

    @overload
    def __getitem__(self, k: int) -> UnitRecord: ...
    @overload
    def __getitem__(self, k: slice) -> RecordsOfUnits: ...
    def __getitem__(self, k: int | slice) -> UnitRecord | RecordsOfUnits:
        if isinstance(k, slice):
            return RecordsOfUnits(self.records, self.units[k])
        return self.records[self.units[k]]

    def __iter__(self) -> Iterator[UnitRecord]:
        return map(self.records.__getitem__, self.units)

    def same_recordings(self) -> list[list[str]]:
        """Return the names of units whose recordings are the same, byte by byte, in groups."""
        keys = self.records.keys(self.units)
        _, group, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        twice = np.flatnonzero((count[group] > 1) & keys.any(axis=1))
        found: dict[int, list[str]] = {}
        for k in twice.tolist():
            found.setdefault(int(group[k]), []).append(self.units[k])
        return list(found.values())

    def in_state(self, state: str) -> RecordsOfUnits:
        """Return those that are in a state."""
        return RecordsOfUnits(self.records, [unit for unit in self.units if self.records.state(unit) == state])


def figure_of(records: Sequence[UnitRecord], name: str, d: int) -> Array:
    """Return values and deviations (2, n, d) of a figure of records, NaN where they are not known."""
    if isinstance(records, RecordsOfUnits):
        return records.records.column(records.units, name, d)
    return np.array([record.table((name,), d)[:, 0] for record in records]).reshape(len(records), 2, d).swapaxes(0, 1)


def figures_in(records: Sequence[UnitRecord]) -> set[str]:
    """Return the names of the figures that any of some records has."""
    if isinstance(records, RecordsOfUnits):
        return records.records.names(records.units)
    return {name for record in records for name in record.figures}
