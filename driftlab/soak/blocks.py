"""A soak as means: rows in the order of time, however long the recording, coarser ones of these, and a summary.

A row is the mean of samples that follow one another, with how long they lasted; rows of rows are means again, so what
needs fewer of them joins runs (`SoakRows.coarsened`). A soak that goes on is kept as at most `most` rows: when there
are so many, neighbours are joined two by two and the number of samples doubles, so all rows weigh the same and their
order is that of time. N samples, d axes, R rows, K runs.

The summary of a soak: rows with the turns of the temperature, cells of temperature, and the white noise.

- *rows*, at most about SLOTS of equally many samples, with the way of the temperature (`fusion_core.thermal.sweeps`);
- *cells*, CELLS equal ranges of temperature, with the samples of each way in them, read a slab at a time;
- white noise, from the differences between neighbouring samples: var = mean((b_k+1 - b_k)^2) / 2, to which neither a
  curve nor a walk adds much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from driftlab.noise.local_level import whitened
from fusion_core.chunk import Array, Flags, Integers
from fusion_core.contracts import SLAB
from fusion_core.thermal.sweeps import directions

MAX_BLOCKS = 8192  # half as many, at least, once there are as many samples


def runs(starts: Sequence[int] | Integers, count: int, n: int) -> Integers:
    """Return the begins (K,) of runs of n of `count` values; no run is of two recordings, which begin at `starts`.

    All are of equal length, as the laws of a soak's noise have them; what is over at a recording's end belongs to its
    last run.
    """
    ends = [(start, stop) for start, stop in pairwise([*starts, count]) if stop > start]
    parts = [np.arange(start, max(stop - n, start) + 1, n) for start, stop in ends] or [np.zeros(0)]
    return np.concatenate(parts).astype(np.int64)


def means(values: Array, starts: Integers, weight: Array | None = None) -> Array:
    """Return the means (K, ...) of runs of values (N, ...), which begin at `starts` (K,); each has a `weight` (N,)."""
    wide = (-1, *[1] * (values.ndim - 1))
    if weight is None:
        total, size = np.add.reduceat(values, starts, axis=0), np.diff(starts, append=len(values))
    else:
        total, size = np.add.reduceat(values * weight.reshape(wide), starts, axis=0), np.add.reduceat(weight, starts)
    return np.asarray(total / size.reshape(wide), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class SoakRows:
    """Means of a soak, in the order of time."""

    t: Array  # (R,): their middles, s
    T: Array  # (R,): temperature as measured, degC
    bias: Array  # (R, d): of the tracked sensor, SI
    span: Array  # (R,): how long each was measured, s
    channels: Mapping[str, Array] = field(default_factory=dict)  # (R,) or (R, k): what else was recorded

    def part(self, where: Flags) -> SoakRows:
        """Return the rows of which `where` (R,) is true."""
        channels = {name: values[where] for name, values in self.channels.items()}
        return SoakRows(self.t[where], self.T[where], self.bias[where], self.span[where], channels)

    def coarsened(self, starts: Integers) -> SoakRows:
        """Return the means of runs of rows, which begin at `starts` (K,)."""
        t, T, bias = (means(values, starts, self.span) for values in (self.t, self.T, self.bias))
        channels = {name: means(values, starts, self.span) for name, values in self.channels.items()}
        return SoakRows(t, T, bias, np.add.reduceat(self.span, starts), channels)

    def within(self, low: float, high: float) -> Flags:
        """Return True for each row (R,) at a temperature from low to high, degC."""
        return np.asarray((low <= self.T) & (high >= self.T))

    def steps(self, *, free: bool, start: float | None = None) -> Array:
        """Return the time (R,) that the walk to each row takes, s.

        The level at `start`, by default the first row, is that of the curve; or it is `free`: nothing is known of it,
        as of a further recording of the same unit, and the first time is infinite.
        """
        first = np.inf if free else 0.0 if start is None else self.t[0] - start
        return np.concatenate([[first], np.diff(self.t)])

    def whitened(self, columns: Array, white: float, walk: float, *, free: bool, start: float | None = None) -> Array:
        """Return columns (R, m) over the rows as normalised innovations.

        `white` and `walk` are the densities of their noise, SI/sqrt(Hz) and SI/sqrt(s); the level is that of `steps`.
        """
        noise = np.maximum(white**2 / self.span, np.finfo(float).tiny)
        steps = self.steps(free=free, start=start)
        steps[1 if free else 0 :] *= walk**2
        innovations: Array = whitened(np.ascontiguousarray(columns), noise, steps)[0]
        return innovations


class GrowingSoak:
    """Rows of the samples so far: fewer than `most`, an even number, of one sample each at first."""

    def __init__(self, most: int = MAX_BLOCKS) -> None:
        self.most, self.n, self.samples = most, 1, 0
        self.ends = np.inf, -np.inf  # lowest and highest temperature, degC
        self._sums = self._rest = np.empty((0, 0))  # (k, 3 d + 3) of rows, and of samples that make no row yet: of T,
        # bias, their squares and products, and t, less `_shift` (d + 2,): squares would lose digits to a large constant
        self._shift = np.empty(0)

    def add(self, t: Array, T: Array, bias: Array) -> None:
        """Add samples at t (N,) of T (N,) and bias (N, d), later than those before."""
        if len(T) == 0:
            return
        if not self.samples:
            self._shift = np.array([t[0], T.mean(), *bias.mean(axis=0)])
            self._sums = self._rest = np.empty((0, 3 * bias.shape[1] + 3))
        self.samples += len(T)
        self.ends = min(self.ends[0], float(T.min())), max(self.ends[1], float(T.max()))
        x, left = T[:, None] - self._shift[1], bias - self._shift[2:]
        new = np.hstack([x, left, left**2, left * x, x**2, t[:, None] - self._shift[0]])
        self._rest = np.vstack([self._rest, new])
        while whole := min(len(self._rest) // self.n, self.most - len(self._sums)):
            rows, self._rest = np.split(self._rest, [whole * self.n])
            self._sums = np.vstack([self._sums, rows.reshape(whole, self.n, -1).sum(axis=1)])
            if len(self._sums) == self.most:
                self._sums, self.n = self._sums.reshape(self.most // 2, 2, -1).sum(axis=1), 2 * self.n

    def rows(self, interval: float = 1.0) -> SoakRows:
        """Return the rows, of samples `interval` s apart; the last has half of its samples at least.

        The coldest and the warmest one stand at the lowest and the highest temperature of all: a map's domain is that
        of its samples.
        """
        sums = self._means()
        T, d = sums[:, 0] + self._shift[1], len(self._shift) - 2
        if len(T) > 1:
            T[np.argmin(T)], T[np.argmax(T)] = self.ends
        span = np.full(len(T), self.n * interval)
        return SoakRows(sums[:, -1] + self._shift[0], T, sums[:, 1 : 1 + d] + self._shift[2:], span)

    def within(self, slope: Array) -> Array:
        """Return the mean square (d,) of the samples about a curve through their means, of slope (R, d)."""
        sums, d = self._means(), slope.shape[1]
        x, left = sums[:, :1], sums[:, 1 : 1 + d]
        of_bias, mixed, of_T = np.split(sums[:, 1 + d : -1] - np.hstack([left**2, left * x, x**2]), [d, 2 * d], axis=1)
        return np.asarray(np.mean(np.maximum(of_bias - 2 * slope * mixed + slope**2 * of_T, 0.0), axis=0))

    def _means(self) -> Array:
        """Return the means (R, 3 d + 3) of the rows' samples."""
        whole = self._sums / self.n
        last = 2 * len(self._rest) >= self.n or not len(whole)
        return np.vstack([whole, self._rest.mean(axis=0)]) if last and len(self._rest) else whole


SLOTS = 4096  # at most
CELLS = 120
TURN = 0.05  # of the range of temperature: less is no turn
WAYS = {"warming": 1, "cooling": -1}
CLEAR = 10  # times the scatter of the slots' temperatures: what is in no order, turns nowhere
OFF = "temperature_off"  # channel of how far T may be off between the steps of a thermometer, K^2 s
_ROW = {0: 0, 1: 1, -1: 2}  # of a way among the cells


@dataclass(frozen=True, eq=False, kw_only=True)
class SoakSummary(SoakRows):
    """Rows of the samples that a map was fitted on, and their cells, for its assessment."""

    domain: tuple[float, float]  # lowest and highest temperature, degC
    way: Integers  # (R,): +1 warming, -1 cooling or 0
    recording: Integers  # (R,): number of the recording that a row is from
    count: Array  # (3, CELLS): samples in each cell on no way, warming, and cooling
    cell_T: Array  # (3, CELLS): their mean temperature; NaN where there are none
    cell_bias: Array  # (3, CELLS, d): their mean bias
    white: Array  # (d,): standard deviation of the white noise of a sample

    @property
    def edges(self) -> Array:
        """Edges of the cells (CELLS + 1,), degC."""
        return np.linspace(*self.domain, CELLS + 1)

    def hours(self, way: int) -> float:
        """Return the hours that the soak went one way."""
        return float(np.sum(self.span[self.way == way])) / 3600

    def cells(self, way: int) -> tuple[Array, Array, Array]:
        """Return samples (CELLS,), mean temperature (CELLS,) and mean bias (CELLS, d) of one way."""
        row = _ROW[way]
        return self.count[row], self.cell_T[row], self.cell_bias[row]

    def between_ways(self) -> tuple[Array, Array, Array, Array]:
        """Return T (C,), warming less cooling (C, d), and the samples (C,) on either way, of cells with some on both.

        The two means of a cell are of temperatures that differ: what the curve between them rises is taken off.
        """
        (n, T, bias), (below_n, below_T, below) = self.cells(WAYS["warming"]), self.cells(WAYS["cooling"])
        both = (n > 0) & (below_n > 0)
        middle, apart, mean = (T[both] + below_T[both]) / 2, (T - below_T)[both], (bias + below)[both] / 2
        slope = np.gradient(mean, middle, axis=0) if len(middle) > 1 else np.zeros_like(mean)
        return middle, (bias - below)[both] - slope * apart[:, None], n[both], below_n[both]


def brief(
    T: Array, bias: Array, starts: Sequence[int], interval: float, times: Array | None = None, off: Array | None = None
) -> SoakSummary:
    """Return the summary of samples T (N,), bias (N, d); each recording begins at one of `starts`, the first at 0.

    They are an `interval` apart, s, unless it is known at which `times` (N,) they were: what was not recorded, or was
    not at rest, is a gap over which a bias wanders on. T may be `off` (N,) as `between_steps` says.
    """
    N, domain = len(T), (float(T.min()), float(T.max()))
    cuts = runs(starts, N, -(-N // SLOTS))
    n, recording = np.diff(cuts, append=N), np.searchsorted(np.asarray(starts), cuts, side="right") - 1
    t, row_T = (cuts + (n - 1) / 2) * interval if times is None else means(times, cuts), means(T, cuts)
    threshold = max(TURN * (domain[1] - domain[0]), CLEAR * scatter(row_T))
    way = np.concatenate([directions(row_T[recording == k], threshold) for k in range(len(starts))])
    rows = np.array([_ROW[int(w)] for w in way])
    count, cell_T, cell_bias = _cells(T, bias, np.repeat(rows.astype(np.int8), n), domain)
    return SoakSummary(
        t, row_T, means(bias, cuts), n * interval, domain=domain, way=way, recording=recording,
        count=count, cell_T=cell_T, cell_bias=cell_bias, white=_white(bias),
        channels={} if off is None else {OFF: means(off, cuts)},
    )  # fmt: skip


def scatter(T: Array) -> float:
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
