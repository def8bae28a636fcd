"""A live run as those see it who look on: made by the run, read by any number of threads, none of which it waits for.

The run hands over each stretch, which is kept, and a few times a second makes of them what is shown: its status as
bytes of JSON and its history as arrays. Those are replaced and never changed, so no lock is needed.
"""

from __future__ import annotations

import json
import time
import uuid
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.jobs.estimates import plain
from driftlab.jobs.live_history import History
from driftlab.jobs.live_status import UPDATES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from driftlab.filtering.stretch import Stretch
    from driftlab.jobs.live_status import Status
    from fusion_core.chunk import Array
    from fusion_core.model import Flags

PERIOD = 0.25  # s between two of what is shown
WIDTH = 0.5  # s of a row of the last minutes; of the whole run, to begin with


def column_names(axes: Sequence[str]) -> list[str]:
    """Return the columns of a history: biases and sigmas in SI, degC, K/s."""
    biases = [f"bias_{k}{end}" for k in range(len(axes)) for end in ("", "_low", "_high")]
    sigmas = [f"sigma_{k}" for k in range(len(axes))]
    rest = ["temperature", "temperature_rate", "nis", "moving_high", "refused_high", "samples_per_s", "lost"]
    return ["t", *biases, *sigmas, *rest]


class Watch:
    """What is shown of a live run.

    Parameters
    ----------
    axes : sequence of str
        Of the tracked sensor.
    recorded : str
        Path of the recording; empty where there is none.

    Attributes
    ----------
    status : bytes
        JSON, the line of `--json` and: `run` (another for every run), `lines`, `recording` and, when the run has ended,
        `ended`.
    histories : dict of str to History
        The `whole` run and the `last` minutes.
    """

    def __init__(self, axes: Sequence[str], recorded: str = "") -> None:
        names, self.axes = column_names(axes), axes
        self.histories = {"whole": History(names, WIDTH, "widen"), "last": History(names, WIDTH, "forget")}
        self.fixed: dict[str, Any] = {"run": uuid.uuid4().hex, "recording": recorded, "ended": None}
        self.status = b"{}"
        self._said: dict[str, Any] = {}
        self._waiting: deque[Stretch] = deque()  # the run appends while another thread takes
        self._nis, self._made = np.empty(0), -PERIOD

    @property
    def ended(self) -> bool:
        """Whether the run has ended."""
        return self.fixed["ended"] is not None

    def seen(self, stretch: Stretch) -> None:
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
        self._said = {
            **status.as_json(),
            "lines": status.lines(),
            "map_lines": status.map.lines() if status.map else [],
        }
        self._say()

    def end(self, lines: Sequence[str], out: str, *, failed: bool = False) -> None:
        """Say that the run has ended: what one should know of it, and where its results are."""
        self.fixed["ended"] = {"failed": failed, "lines": list(lines), "out": out}
        self._say()

    def _say(self) -> None:
        self.status = json.dumps(plain(self._said | self.fixed)).encode()

    def _rows(self, stretches: Sequence[Stretch], status: Status) -> Array:
        """Return stretches of N updates together as rows (N, C) of a history."""

        def joined(of: Callable[[Stretch], NDArray[Any]]) -> NDArray[Any]:
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
