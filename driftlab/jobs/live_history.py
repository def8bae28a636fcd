"""What a live run was so far, thinned, in memory that does not grow.

A row stands for an equal width of time, and has the least and the most of what it stands for. Where there is no more
room, rows become twice as wide (of the whole run), or the older half goes (of the last minutes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from fusion_core.chunk import Array

CAPACITY = 3600  # rows
WIDTH = 0.5  # s of a row, to begin with


@dataclass(frozen=True)
class View:
    """The rows of a history at one moment; nothing in it changes any more.

    Attributes
    ----------
    generation : int
        How often rows that were there before have been changed. Of one generation, all rows but the last stay.
    width : float
        Of a row, s.
    rows : (N, C) array
    """

    generation: int
    width: float
    rows: Array

    def since(self, generation: int, start: int) -> tuple[int, Array]:
        """Return what one who has `start` rows of a generation lacks, from the last that he has on: where, and rows."""
        at = min(max(start - 1, 0), len(self.rows)) if generation == self.generation else 0
        return at, self.rows[at:]


class History:
    """Rows of a live run, thinned.

    A row has the time of its last sample first. In columns whose name ends in `_low` the least of what it stands for is
    kept, in `_high` the most, in all others the last.

    Parameters
    ----------
    names : list of str
        Of the C columns, the first of which is `t`.
    width : float
        Of a row at first, s.
    full : {"widen", "forget"}
        What happens where there is no more room.
    """

    def __init__(self, names: list[str], width: float, full: Literal["widen", "forget"], capacity: int = CAPACITY):
        self.names, self.width, self.full, self.capacity = names, width, full, capacity
        self.low = [k for k, name in enumerate(names) if name.endswith("_low")]
        self.high = [k for k, name in enumerate(names) if name.endswith("_high")]
        self.generation, self.count = 0, 0
        self.rows = np.empty((capacity, len(names)))
        self.view = View(0, width, self.rows[:0])

    def add(self, rows: Array) -> None:
        """Add rows (N, C) in the order of their times."""
        for piece in np.array_split(rows, len(rows) * 2 // self.capacity + 1):
            if len(piece):
                self._add(piece)
        # who reads does so without a lock: what is shown is a copy
        self.view = View(self.generation, self.width, self.rows[: self.count].copy())

    def _add(self, rows: Array) -> None:
        open = self.rows[max(self.count - 1, 0) : self.count]
        found = self._thinned(np.concatenate([open, rows]))
        self.count -= len(open)
        if self.count + len(found) > self.capacity:
            found = self._made_room(np.concatenate([self.rows[: self.count], found]))
        self.rows[self.count : self.count + len(found)] = found
        self.count += len(found)

    def _made_room(self, rows: Array) -> Array:
        """Empty the history, and return those of its rows (N, C) that are to be there."""
        self.generation, self.count = self.generation + 1, 0
        if self.full == "forget":
            return rows[-(self.capacity // 2) :]
        while len(rows) > self.capacity // 2:
            self.width *= 2
            rows = self._thinned(rows)
        return rows

    def _thinned(self, rows: Array) -> Array:
        number = np.floor(rows[:, 0] / self.width)
        starts = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        found: Array = rows[np.append(starts[1:], len(rows)) - 1]
        found[:, self.low] = np.fmin.reduceat(rows[:, self.low], starts, axis=0)
        found[:, self.high] = np.fmax.reduceat(rows[:, self.high], starts, axis=0)
        return found
