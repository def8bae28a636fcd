"""The history of a live run for its page, thinned, in memory that does not grow.

A row stands for an equal width of time, and has its smallest and largest values. Where there is no more room, rows
become twice as wide (of the whole run), or the older half goes (of the last minutes).

Any number of threads read it, and the run waits for none: it hands over each stretch, and a few times a second makes of
them its status as bytes of JSON and its history as arrays. Those are replaced and never changed, so no lock is needed.
"""

from __future__ import annotations

import json
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from driftlab.filtering.segment import RunSegment
from driftlab.live.status import UPDATES, Status
from driftlab.storage.json import plain
from fusion_core.chunk import Array, Flags

CAPACITY = 3600  # rows
WIDTH = 0.5  # s of a row, to begin with


@dataclass(frozen=True)
class View:
    """The rows of a history at one moment; nothing in it changes any more."""

    # how often rows that were there before have been changed. Of one generation, all rows but the last stay
    generation: int
    width: float  # of a row, s
    rows: Array  # (N, C)

    def since(self, generation: int, start: int) -> tuple[int, Array]:
        """Return place and rows from the last on of the first `start` rows of a generation, which the reader has."""
        at = min(max(start - 1, 0), len(self.rows)) if generation == self.generation else 0
        return at, self.rows[at:]


class History:
    """Rows of a live run, thinned, each at first of `width` s; `full` is the way to make room.

    A row has the time of its last sample, `t`, first. Columns whose name ends in `_low` have the smallest of its
    values, in `_high` the largest, all others the last.
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
        # readers have no lock: they are given a copy
        self.view = View(self.generation, self.width, self.rows[: self.count].copy())

    def _add(self, rows: Array) -> None:
        open = self.rows[max(self.count - 1, 0) : self.count]
        new = self._thinned(np.concatenate([open, rows]))
        self.count -= len(open)
        if self.count + len(new) > self.capacity:
            new = self._emptied(np.concatenate([self.rows[: self.count], new]))
        self.rows[self.count : self.count + len(new)] = new
        self.count += len(new)

    def _emptied(self, rows: Array) -> Array:
        """Empty the history, and return those of its rows (N, C) that are to be in it."""
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
        thinned: Array = rows[np.append(starts[1:], len(rows)) - 1]
        thinned[:, self.low] = np.fmin.reduceat(rows[:, self.low], starts, axis=0)
        thinned[:, self.high] = np.fmax.reduceat(rows[:, self.high], starts, axis=0)
        return thinned


PERIOD = 0.25  # s between updates


def column_names(axes: Sequence[str]) -> list[str]:
    """Return the columns of a history: biases and sigmas in SI, degC, K/s."""
    biases = [f"bias_{k}{end}" for k in range(len(axes)) for end in ("", "_low", "_high")]
    sigmas = [f"sigma_{k}" for k in range(len(axes))]
    rest = ["temperature", "temperature_rate", "nis", "moving_high", "refused_high", "samples_per_s", "lost"]
    return ["t", *biases, *sigmas, *rest]


class LiveHistory:
    """Status and history of a live run whose recording is at the path `recorded`, if there is one.

    `status` is JSON, the line of `--json` and: `run` (another for every run), `lines`, `recording` and, when the run
    has ended, `ended`. `histories` are of the `whole` run and of the `last` minutes.
    """

    def __init__(self, axes: Sequence[str], recorded: str = "") -> None:
        names, self.axes = column_names(axes), axes
        self.histories = {"whole": History(names, WIDTH, "widen"), "last": History(names, WIDTH, "forget")}
        self.fixed: dict[str, Any] = {"run": uuid.uuid4().hex, "recording": recorded, "ended": None}
        self.status = b"{}"
        self._live: dict[str, Any] = {}  # the part of the status that changes
        self._waiting: deque[RunSegment] = deque()  # the run appends while another thread takes
        self._nis, self._made = np.empty(0), -PERIOD

    def seen(self, stretch: RunSegment) -> None:
        """Take the next stretch."""
        self._waiting.append(stretch)

    def report(self, status: Status) -> None:
        """Take the status; called by one thread at a time."""
        if time.monotonic() - self._made < PERIOD:
            return
        self._made = time.monotonic()
        stretches = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if stretches:
            rows = self._rows(stretches, status)
            for history in self.histories.values():
                history.add(rows)
        map_lines = status.map.lines() if status.map else []
        self._live = {**status.as_json(), "lines": status.lines(), "map_lines": map_lines}
        self._publish()

    def end(self, lines: Sequence[str], out: str, *, failed: bool = False) -> None:
        """Publish the end of the run: its summary in sentences, and the place of its results."""
        self.fixed["ended"] = {"failed": failed, "lines": list(lines), "out": out}
        self._publish()

    def _publish(self) -> None:
        self.status = json.dumps(plain(self._live | self.fixed)).encode()

    def _rows(self, stretches: Sequence[RunSegment], status: Status) -> Array:
        """Return stretches of N updates together as rows (N, C) of a history."""

        def joined(of: Callable[[RunSegment], NDArray[Any]]) -> NDArray[Any]:
            return np.concatenate([of(stretch) for stretch in stretches])

        def channel(name: str) -> Array:
            return joined(lambda s: s.epochs.channels.get(name, np.full(len(s.still), np.nan)))

        used, still, bias = joined(lambda s: s.estimates.used), joined(lambda s: s.still), joined(lambda s: s.bias)
        rest = (
            channel("temperature"),
            channel("temperature_rate"),
            self._mean_nis(joined(lambda s: s.estimates.nis), used) / status.m,
            ~still,
            still & ~used,
            np.full(len(used), status.rate()),
            np.full(len(used), status.lost),
        )
        biases = np.repeat(bias, 3, axis=1)  # itself, the least, the most
        return np.column_stack([joined(lambda s: s.epochs.t), biases, joined(lambda s: s.sigma), *rest])

    def _mean_nis(self, nis: Array, used: Flags) -> Array:
        """Return the mean (N,) of nis (N,) over the last updates that were used, up to each."""
        last = np.concatenate([self._nis, nis[used]])
        sums = np.concatenate([[0.0], np.cumsum(last)])
        stop = len(self._nis) + np.cumsum(used)
        start = np.maximum(stop - UPDATES, 0)
        self._nis = last[-UPDATES:]
        with np.errstate(invalid="ignore"):
            return np.asarray((sums[stop] - sums[start]) / (stop - start), dtype=np.float64)
