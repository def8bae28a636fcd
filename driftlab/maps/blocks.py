"""Samples at rest as a few thousand means, however long the recording: what a fit of a map needs of them.

A block is the mean of n samples that follow one another. When there are `MOST` blocks, neighbours are joined two by
two and n doubles, so all blocks weigh the same and their order is that of time. N samples, d axes, K blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array

MOST = 8192  # blocks, at most; half as many, at least, once there are as many samples


@dataclass(frozen=True, eq=False)
class Blocks:
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
        own, mixed, of_T = self.spread[:, :d], self.spread[:, d : 2 * d], self.spread[:, 2 * d :]
        squares = np.maximum(own - 2 * slope * mixed + slope**2 * of_T, 0.0)
        return np.asarray(np.mean(squares, axis=0), dtype=np.float64)


class GrowingBlocks:
    """Blocks of what was added so far, at most `most`, at first of `n` samples."""

    def __init__(self, most: int = MOST, n: int = 1) -> None:
        self.most, self.n, self.samples = most, n, 0
        self.seen = np.inf, -np.inf  # lowest and highest temperature, degC
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
        self.seen = min(self.seen[0], float(T.min())), max(self.seen[1], float(T.max()))
        x, left = T[:, None] - self._shift[1], bias - self._shift[2:]
        self._append(np.hstack([x, left, left**2, left * x, x**2, t[:, None] - self._shift[0]]))
        while self._rows >= self.most:
            self._halve()

    def blocks(self) -> Blocks:
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
            T[np.argmin(T)], T[np.argmax(T)] = self.seen
        return Blocks(T, left + self._shift[2:], self.n, spread, means[:, -1] + self._shift[0])

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
