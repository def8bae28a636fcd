"""The overview of a run for its summary and its report, from its estimates block by block.

Memory does not grow with the recording: sums for the scores and tests, and a few thousand rows for the figures. How
many rows there are in all is known before the first block, so that curves and stretches are spread evenly over them.

The errors are drawn with every spike of them, in a few points. Rows that are picked evenly from a long run miss what
lasts shorter than their distance. So each stretch of a run gives its smallest and its largest error, at the time of its
middle: a line through them reaches as far as the errors do. N rows, d axes, K stretches.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.evaluation.scores import WINDOW, ScoreAccumulator, Scores, moving_average
from driftlab.recordings.prefetch import prefetch
from fusion_core.consistency import NisTest, Whiteness, nis_test_of

if TYPE_CHECKING:
    from driftlab.evaluation.bias_instability import Averages
    from fusion_core.chunk import Array
    from fusion_core.contracts import Alignment, MeasurementModel
    from fusion_core.model import Flags


ROWS = 65_536  # of a block
POINTS = 1500  # rows kept for the figures
BINS = 400  # stretches over which the nis is averaged for its figure
SMOOTHED = "smoothed/bias"  # where `run --smooth` writes it
NAMES = (
    "t", "tau", "used", "still", "rate", "bias", "bias_sigma", "coast", "coast_sigma", "nis", "white", "temperature",
    "temperature_raw", SMOOTHED,
)  # fmt: skip
DRAWN = (
    "t", "still", "bias", "bias_sigma", "coast", "coast_sigma", "temperature", "temperature_raw", "reference", SMOOTHED,
)  # fmt: skip
Columns = dict[str, "Array"]


@dataclass(frozen=True)
class Overview:
    """A run at a glance.

    Attributes
    ----------
    count, used : int
        Updates, and those whose measurement was used.
    start, end : float
        Time of the first and the last update, s.
    first_row : float
        Time of the recording's first row, s; of the first update where it is not known.
    bias, sigma : (d,) arrays
        At the end, in SI.
    yardsticks : Scores
    nis : NisTest
    whiteness_p : (m,) array
        Of the used updates after the first alignment, as is `nis`.
    curves : dict of str to array
        At most POINTS rows of the estimates, evenly spread, with the `reference` of the scores.
    errors : dict of str to array
        `t`, and the error of `bias` and `coast`, with every spike of it.
    nis_curve : (K, 3) array
        Time in s, mean nis and number of updates of up to BINS stretches.
    nis_highest : float
        Largest nis of one update among them.
    swing : float
        Of the temperature in the rows of `curves`, K; 0 where there is none.
    """

    count: int
    used: int
    start: float
    end: float
    first_row: float
    bias: Array
    sigma: Array
    yardsticks: Scores
    nis: NisTest
    whiteness_p: Array
    curves: Columns
    errors: Columns
    nis_curve: Array
    nis_highest: float
    swing: float


def survey(
    path: Path,
    model: MeasurementModel,
    alignment: Alignment,
    rows: int = ROWS,
    *,
    first_row: float | None = None,
    averages: Averages | None = None,
) -> Overview:
    """Return the overview of an `estimates.h5`; parameters are those of `overview_of`."""
    import h5py

    with h5py.File(path) as file:
        return overview_of(file, model, alignment, rows, first_row=first_row, averages=averages)


def overview_of(
    columns: Mapping[str, Array],
    model: MeasurementModel,
    alignment: Alignment,
    rows: int = ROWS,
    *,
    first_row: float | None = None,
    averages: Averages | None = None,
) -> Overview:
    """Return the overview of the estimates of a run whose first alignment is `alignment`, read `rows` at a time.

    `first_row` is the time of the recording's first row, s, where it is known; `averages` are given every block.
    """
    N, tracked, used = len(columns["t"]), model.tracked, 0
    scores, whiteness, nis = ScoreAccumulator(len(tracked.axes)), Whiteness(model.m), _NisSums(N)
    curves, envelope = _Thinned(N), Envelope(N, len(tracked.axes))
    more = () if averages is None else ("calibration",)
    for block in prefetch(_referenced(_blocks(columns, rows, (*NAMES, *more)))):
        scores.add(block, block["reference"])
        used += int(np.count_nonzero(block["used"]))
        after = block["used"].astype(bool) & (block["t"] > alignment.t)
        whiteness.add(block["white"][after])
        nis.add(block, after)
        for observer in (curves, envelope, averages):
            if observer is not None:
                observer.add(block)
    drawn = curves.curves()
    return Overview(
        count=N,
        used=used,
        start=float(columns["t"][0]),
        end=float(columns["t"][-1]),
        first_row=float(columns["t"][0]) if first_row is None else first_row,
        bias=columns["bias"][-1],
        sigma=columns["bias_sigma"][-1],
        yardsticks=scores.yardsticks(alignment.up if tracked.integral else None, tracked.axes, model.align),
        nis=nis_test_of(nis.total, nis.count, model.m),
        whiteness_p=whiteness.p(),
        curves=drawn,
        errors=envelope.curves(),
        nis_curve=nis.curve(),
        nis_highest=nis.highest,
        swing=float(np.ptp(drawn["temperature"])) if "temperature" in drawn else 0.0,
    )


class _Thinned:
    """At most POINTS rows of N, evenly spread, block after block."""

    def __init__(self, N: int) -> None:
        self.rows, self.at = thin(N), 0
        self.parts: list[Columns] = []

    def add(self, block: Columns) -> None:
        """Take those of the next block."""
        stop = self.at + len(block["t"])
        here = self.rows[(self.rows >= self.at) & (self.rows < stop)] - self.at
        self.parts.append({name: block[name][here] for name in DRAWN if name in block})
        self.at = stop

    def curves(self) -> Columns:
        """Return the rows by name."""
        return _joined(self.parts, self.parts[0])


class _Bins:
    """At most K stretches of N rows that come block after block: row r is of stretch r K // N."""

    def __init__(self, N: int, K: int) -> None:
        self.N, self.K, self.at = N, min(K, N), 0

    def next(self, rows: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the stretches that the next rows are of, and the first row of each among these."""
        N, K = self.N, self.K
        stretches = np.arange(self.at * K // N, (self.at + rows - 1) * K // N + 1)
        starts = np.maximum(-(-stretches * N // K) - self.at, 0)
        self.at += rows
        return stretches, starts


class _NisSums:
    """The nis of the updates that count, block after block of N rows in all: their sum, and means of stretches."""

    def __init__(self, N: int) -> None:
        self.bins = _Bins(N, BINS)
        self.sums = np.zeros((3, self.bins.K))  # number, sum of t, sum of nis
        self.count, self.total, self.highest = 0, 0.0, 0.0

    def add(self, block: Columns, counts: Flags) -> None:
        """Take the next block, of which the rows count that `counts` says."""
        nis = block["nis"][counts]
        self.total, self.count = self.total + float(np.sum(nis)), self.count + len(nis)
        self.highest = max(self.highest, float(np.max(nis, initial=0.0)))
        stretches, starts = self.bins.next(len(counts))
        for row, values in zip(self.sums, (np.ones(len(counts)), block["t"], block["nis"]), strict=True):
            row[stretches] += np.add.reduceat(np.where(counts, values, 0.0), starts)

    def curve(self) -> Array:
        """Return mean time, mean nis and number of updates (K, 3) of the stretches in which any update counts."""
        filled = self.sums[:, self.sums[0] > 0]
        return np.column_stack([*(filled[1:] / filled[0]), filled[0]])


def thin(N: int) -> Array:
    """Return the indices of at most POINTS samples, evenly spread."""
    return np.unique(np.linspace(0, N - 1, min(N, POINTS)).astype(int))


def _blocks(columns: Mapping[str, Array], rows: int, names: Sequence[str]) -> Iterator[Columns]:
    data = {name: columns[name] for name in names if name in columns}
    for start in range(0, len(data["t"]), rows):
        yield {name: np.asarray(values[start : start + rows], dtype=np.float64) for name, values in data.items()}


def _referenced(blocks: Iterator[Columns]) -> Iterator[Columns]:
    """Yield the same blocks with their `reference`, each as soon as the half window after it is there."""
    before: list[Columns] = []  # the half window before those that wait
    waiting: list[Columns] = []
    for block in chain(blocks, [None]):
        while waiting and (block is None or block["t"][-1] > waiting[0]["t"][-1] + WINDOW / 2):
            first, *after = [*waiting, block] if block is not None else waiting
            yield {**first, "reference": _reference(before, first, after)}
            before = _half_window([*before, waiting.pop(0)])
        if block is not None:
            waiting.append(block)


def _half_window(before: list[Columns]) -> list[Columns]:
    """Return the rows of the last half window, and at least one from before it."""
    begin = before[-1]["t"][-1] - WINDOW / 2
    while len(before) > 1 and before[1]["t"][0] <= begin:
        before = before[1:]
    return [_rows(before[0], int(np.searchsorted(before[0]["t"], begin)) - 2, None), *before[1:]]


def _reference(before: list[Columns], block: Columns, after: list[Columns]) -> Array:
    """Return the moving average (N, d) over a block between what comes before and after it."""
    end = block["t"][-1] + WINDOW / 2
    after = [_rows(part, 0, int(np.searchsorted(part["t"], end, side="right")) + 1) for part in after]
    window = _joined([*before, block, *after], ("t", "rate", "tau", "still"))
    start = sum(len(part["t"]) for part in before)
    averages = moving_average(window["t"], window["rate"], window["tau"], window["still"].astype(bool))
    return averages[start : start + len(block["t"])]


def _rows(block: Columns, start: int, stop: int | None) -> Columns:
    return {name: values[max(start, 0) : stop] for name, values in block.items()}


def _joined(parts: Sequence[Columns], names: Iterable[str]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


STRETCHES = 750  # two points each


class Envelope:
    """Smallest and largest error of the estimate and of the coast, block after block of N rows in all."""

    def __init__(self, N: int, d: int) -> None:
        self.bins = _Bins(N, STRETCHES)
        self.t = np.zeros((2, self.bins.K))  # first and last
        self.extremes = {name: np.full((2, self.bins.K, d), np.nan) for name in ("bias", "coast")}
        self.last = -1  # stretch of the block before

    def add(self, block: Mapping[str, Array]) -> None:
        """Take the next block, with its `reference`; an error is not known where the reference is not."""
        stretches, starts = self.bins.next(len(block["t"]))
        begun = int(stretches[0] == self.last)  # by the block before
        self.t[0, stretches[begun:]] = block["t"][starts[begun:]]
        self.t[1, stretches] = block["t"][np.append(starts[1:], len(block["t"])) - 1]
        self.last = int(stretches[-1])
        for name, (low, high) in self.extremes.items():
            error = block[name] - block["reference"]
            low[stretches] = np.fmin(low[stretches], np.fmin.reduceat(error, starts))
            high[stretches] = np.fmax(high[stretches], np.fmax.reduceat(error, starts))

    def curves(self) -> Columns:
        """Return `t` (2 K,) in s and the errors `bias` and `coast` (2 K, d) in SI, smallest and largest in turn."""
        (first, last), quarter = self.t, (self.t[1] - self.t[0]) / 4
        errors = {name: _in_turn(low, high) for name, (low, high) in self.extremes.items()}
        return {"t": _in_turn(first + quarter, last - quarter), **errors}


def _in_turn(first: Array, second: Array) -> Array:
    """Return rows of two arrays (K, ...) in turn, (2 K, ...)."""
    return np.stack([first, second], axis=1).reshape(2 * len(first), *first.shape[1:])
