"""Records of a fleet's units in memory: of each what the line, the tests and the page of all units need.

The whole record of a unit is in its `unit.json`; a hundred thousand of these would take gigabytes. Here a unit is its
key, its numbers in one array, and texts that it has in common with others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, overload

import numpy as np

from driftlab.family.record import FIGURES, TERM_FIGURES, Figure, RepeatedSoak, TermParabolas, UnitRecord

HELD = (*FIGURES, "hysteresis", "soaks", *TERM_FIGURES)  # figures that are compared over units
NUMBERS = 5  # before the figures: domain, hours, samples, seconds
OF_LIMITS = ("name", "verdict", "beside")  # of each row of a unit's limits


class _Brief(NamedTuple):
    key: str
    state: Literal["done", "failed"]
    error: str
    common: tuple[Any, ...]  # lot, date, other columns, channel, bias_unit, axes, driftlab, limits
    numbers: bytes
    repeats: tuple[RepeatedSoak, ...]  # of the few units that were soaked again
    parabolas: TermParabolas | None  # of the few fleets with a stimulus


class UnitRecords:
    """Records by the names of their units; each is made anew when it is asked for, without the rest of its file."""

    def __init__(self) -> None:
        self._briefs: dict[str, _Brief] = {}
        self._common: dict[Any, Any] = {}

    def __contains__(self, unit: str) -> bool:
        return unit in self._briefs

    def __setitem__(self, unit: str, record: UnitRecord) -> None:
        limits = tuple(tuple((name, row[name]) for name in OF_LIMITS if name in row) for row in record.limits)
        texts = (record.lot, record.date, tuple(record.more.items()), record.channel, record.bias_unit, record.axes,
                 record.driftlab, limits)  # fmt: skip
        common = tuple(self._common.setdefault(text, text) for text in texts)
        numbers = [*(record.domain or (np.nan, np.nan)), record.hours, record.samples, record.seconds]
        names = HELD if TERM_FIGURES[0] in record.figures else HELD[: -len(TERM_FIGURES)]  # of few fleets
        figures = record.table(names, len(record.axes))
        self._briefs[unit] = _Brief(
            record.key, record.state, record.error, self._common.setdefault(common, common),
            np.concatenate([np.array(numbers, dtype=np.float64), figures.ravel()]).tobytes(), tuple(record.repeats),
            record.parabolas,
        )  # fmt: skip

    def __getitem__(self, unit: str) -> UnitRecord:
        key, state, error, common, content, repeats, parabolas = self._briefs[unit]
        lot, date, more, channel, bias_unit, axes, driftlab, limits = common
        low, high, hours, samples, seconds, *rest = np.frombuffer(content).tolist()
        cells, d = [None if value != value else value for value in rest], len(axes)
        figures = {}
        names = HELD[: len(cells) // max(2 * d, 1)]
        for k, name in enumerate(names):
            value, sigma = (tuple(cells[(part * len(names) + k) * d :][:d]) for part in (0, 1))
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

    def state(self, unit: str) -> str:
        """Return the state of a unit: `done` or `failed`."""
        return self._briefs[unit].state


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

    def in_state(self, state: str) -> RecordsOfUnits:
        """Return those that are in a state."""
        return RecordsOfUnits(self.records, [unit for unit in self.units if self.records.state(unit) == state])
