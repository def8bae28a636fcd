"""Soaks as a few thousand means, however long the recording: blocks for a fit, and a summary for an assessment.

A block is the mean of n samples that follow one another. When there are `MAX_BLOCKS` blocks, neighbours are joined two
by two and n doubles, so all blocks weigh the same and their order is that of time. N samples, d axes, K blocks.

The summary of a soak: means with the turns of the temperature, and the white noise.

The samples of a fit, N of d axes in the order of time, are read once, a slab at a time:

- *slots*, S means of equally many samples that follow one another, with the way of the temperature
  (`driftlab.soak.sweeps`);
- *cells*, CELLS equal ranges of temperature, with the samples of each way in them;
- white noise, from the differences between neighbouring samples: var = mean((b_k+1 - b_k)^2) / 2, to which neither a
  curve nor a walk adds much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.soak.sweeps import Index, directions
from fusion_core.chunk import Array
from fusion_core.contracts import SLAB

MAX_BLOCKS = 8192  # half as many, at least, once there are as many samples


@dataclass(frozen=True, eq=False)
class SoakBlocks:
    """Means of `n` samples each, and how the samples are spread about them.

    Attributes
    ----------
    T : (K,) array
        Mean temperature, degC.
    bias : (K, d) array
        Mean bias, SI.
    n : int
        Samples of a block; the last one may have fewer.
    spread : (K, 2 d + 1) array
        Variances and covariances of a block's samples: of the bias (d), of bias and T (d), and of T.
    t : (K,) array
        Mean time, s.
    """

    T: Array
    bias: Array
    n: int
    spread: Array
    t: Array

    def within(self, slope: Array) -> Array:
        """Return the mean square (d,) of the samples about a curve through their means, of slope (K, d)."""
        d = self.bias.shape[1]
        of_bias, mixed, of_T = self.spread[:, :d], self.spread[:, d : 2 * d], self.spread[:, 2 * d :]
        squares = np.maximum(of_bias - 2 * slope * mixed + slope**2 * of_T, 0.0)
        return np.asarray(np.mean(squares, axis=0), dtype=np.float64)


class GrowingBlocks:
    """Blocks of the samples so far, at most `most`, at first of `n` samples."""

    def __init__(self, most: int = MAX_BLOCKS, n: int = 1) -> None:
        self.most, self.n, self.samples = most, n, 0
        self.ends = np.inf, -np.inf  # lowest and highest temperature, degC
        self._sums: list[Array] = []  # rows (k, 3 d + 3) of whole blocks: T, bias, their squares and products, t
        self._rows = 0
        self._rest: Array | None = None  # sums (1, 3 d + 3) of the block that is not whole
        self._in_rest = 0
        self._shift: Array | None = None  # of T and bias: the squares would lose digits to a large constant

    def add(self, t: Array, T: Array, bias: Array) -> None:
        """Add samples at t (N,) of T (N,) and bias (N, d), later than those before."""
        if len(T) == 0:
            return
        if self._shift is None:
            self._shift = np.array([t[0], T.mean(), *bias.mean(axis=0)])
        self.samples += len(T)
        self.ends = min(self.ends[0], float(T.min())), max(self.ends[1], float(T.max()))
        x, left = T[:, None] - self._shift[1], bias - self._shift[2:]
        self._append(np.hstack([x, left, left**2, left * x, x**2, t[:, None] - self._shift[0]]))
        while self._rows >= self.most:
            self._halve()

    def blocks(self) -> SoakBlocks:
        """Return the blocks, that which is not whole among them where it has half of its samples.

        The coldest and the warmest one stand at the lowest and the highest temperature of all: a map's domain is that
        of its samples.
        """
        assert self._shift is not None, "samples are added first"
        d = len(self._shift) - 2
        means = np.vstack([np.empty((0, 3 * d + 3)), *self._sums]) / self.n
        if self._rest is not None and (2 * self._in_rest >= self.n or not len(means)):
            means = np.vstack([means, self._rest / self._in_rest])
        x, left = means[:, :1], means[:, 1 : 1 + d]
        spread = means[:, 1 + d : -1] - np.hstack([left**2, left * x, x**2])
        T = x[:, 0] + self._shift[1]
        if len(T) > 1:
            T[np.argmin(T)], T[np.argmax(T)] = self.ends
        return SoakBlocks(T, left + self._shift[2:], self.n, spread, means[:, -1] + self._shift[0])

    def _append(self, rows: Array) -> None:
        """Take rows (N, 3 d + 3) of samples into blocks."""
        take = min(self.n - self._in_rest, len(rows)) if self._in_rest else 0
        if take:
            assert self._rest is not None
            self._rest = self._rest + rows[:take].sum(axis=0, keepdims=True)
            self._in_rest += take
            if self._in_rest == self.n:
                self._whole(self._rest)
                self._rest, self._in_rest = None, 0
        whole = (len(rows) - take) // self.n
        stop = take + whole * self.n
        if whole:
            self._whole(rows[take:stop].reshape(whole, self.n, -1).sum(axis=1))
        if stop < len(rows):
            self._rest, self._in_rest = rows[stop:].sum(axis=0, keepdims=True), len(rows) - stop

    def _whole(self, sums: Array) -> None:
        self._sums.append(sums)
        self._rows += len(sums)

    def _halve(self) -> None:
        """Join neighbours; an odd one out begins the block that is not whole."""
        sums = np.vstack(self._sums)
        even = len(sums) // 2 * 2
        if even < len(sums):
            odd = sums[even:]
            self._rest = odd if self._rest is None else odd + self._rest
            self._in_rest += self.n
        self._sums = [sums[:even].reshape(even // 2, 2, -1).sum(axis=1)]
        self._rows, self.n = even // 2, 2 * self.n


SLOTS = 4096  # at most
CELLS = 120
TURN = 0.05  # of the range of temperature: less is no turn
WAYS = {"warming": 1, "cooling": -1}
CLEAR = 10  # times the scatter of the slots' temperatures: what is in no order, turns nowhere
_ROW = {0: 0, 1: 1, -1: 2}  # of a way among the cells


@dataclass(frozen=True, eq=False)
class SoakSummary:
    """Summary of the samples that a map was fitted on, for its assessment.

    Attributes
    ----------
    domain : tuple of float
        Lowest and highest temperature, degC.
    interval : float
        Between samples, s.
    n, T, t, way, recording : (S,) arrays
        Of each slot: samples, mean temperature, its middle in samples from the first, +1 warming, -1 cooling or 0, and
        from which recording it is.
    bias : (S, d) array
        Mean bias of each slot.
    count : (3, CELLS) array
        Samples in each cell on no way, warming, and cooling.
    cell_T, cell_bias : (3, CELLS) and (3, CELLS, d) arrays
        Their means; NaN where there are none.
    white : (d,) array
        Standard deviation of the white noise of a sample.
    """

    domain: tuple[float, float]
    interval: float
    n: Array
    T: Array
    t: Array
    way: Index
    recording: Index
    bias: Array
    count: Array
    cell_T: Array
    cell_bias: Array
    white: Array

    @property
    def edges(self) -> Array:
        """Edges of the cells (CELLS + 1,), degC."""
        return np.linspace(*self.domain, CELLS + 1)

    def hours(self, way: int) -> float:
        """Return the hours that the soak went one way."""
        return float(np.sum(self.n[self.way == way])) * self.interval / 3600

    def cells(self, way: int) -> tuple[Array, Array, Array]:
        """Return samples (CELLS,), mean temperature (CELLS,) and mean bias (CELLS, d) of one way."""
        row = _ROW[way]
        return self.count[row], self.cell_T[row], self.cell_bias[row]


def brief(T: Array, bias: Array, starts: Sequence[int], interval: float) -> SoakSummary:
    """Return the soak of samples T (N,) and bias (N, d); each recording begins at one of `starts`, the first at 0."""
    N, domain = len(T), (float(T.min()), float(T.max()))
    size, stops = -(-N // SLOTS), [*starts[1:], N]
    cuts = np.concatenate([np.arange(start, stop, size) for start, stop in zip(starts, stops, strict=True)])
    n = np.diff(np.append(cuts, N)).astype(np.float64)
    slot_T, slot_bias = np.add.reduceat(T, cuts) / n, np.add.reduceat(bias, cuts, axis=0) / n[:, None]
    recording = np.searchsorted(np.asarray(starts), cuts, side="right") - 1
    threshold = max(TURN * (domain[1] - domain[0]), CLEAR * _scatter(slot_T))
    way = np.concatenate([directions(slot_T[recording == k], threshold) for k in range(len(starts))])
    rows = np.array([_ROW[int(w)] for w in way])
    cells = _cells(T, bias, np.repeat(rows.astype(np.int8), n.astype(np.int64)), domain)
    middle = cuts + (n - 1) / 2
    return SoakSummary(domain, interval, n, slot_T, middle, way, recording, slot_bias, *cells, _white(bias))


def _scatter(T: Array) -> float:
    """Return the deviation of temperatures (S,) about straight lines between their neighbours."""
    if len(T) < 3:
        return 0.0
    return float(np.median(np.abs(np.diff(T, n=2))) / (0.6745 * np.sqrt(6)))


def _cells(T: Array, bias: Array, row: NDArray[np.int8], domain: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Return samples (3, CELLS), mean temperature and mean bias (3, CELLS, d) of the cells, `row` (N,) in 0, 1, 2."""
    size, d = 3 * CELLS, bias.shape[1]
    sums = np.zeros((2 + d, size))
    scale = CELLS / ((domain[1] - domain[0]) or 1.0)
    for start in range(0, len(T), SLAB):
        part = slice(start, start + SLAB)
        cell = np.minimum(((T[part] - domain[0]) * scale).astype(np.intp), CELLS - 1)
        cell += CELLS * row[part].astype(np.intp)
        sums[0] += np.bincount(cell, minlength=size)
        for k, column in enumerate((T[part], *bias[part].T), start=1):
            sums[k] += np.bincount(cell, column, minlength=size)
    with np.errstate(invalid="ignore"):
        means = sums[1:] / sums[0]
    return sums[0].reshape(3, CELLS), means[0].reshape(3, CELLS), means[1:].T.reshape(3, CELLS, d)


def _white(bias: Array) -> Array:
    total = np.zeros(bias.shape[1])
    for start in range(0, len(bias) - 1, SLAB):
        step = np.diff(bias[start : start + SLAB + 1], axis=0)
        total += np.einsum("Nd,Nd->d", step, step)
    return np.asarray(np.sqrt(total / (2 * max(len(bias) - 1, 1))))
