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
    """Means of `n` samples each: T (K,) in degC, bias (K, d) in SI, and what they lose.

    Attributes
    ----------
    n : int
        Samples of a block; the last one may have fewer.
    within : (d,) array
        Mean square of the samples about their block's mean, along the bias.
    """

    T: Array
    bias: Array
    n: int
    within: Array


class GrowingBlocks:
    """Blocks of what was added so far, in memory that does not grow."""

    def __init__(self, most: int = MOST) -> None:
        self.most, self.n, self.samples = most, 1, 0
        self._sums: list[Array] = []  # rows (k, 1 + 2 d) of whole blocks: T, bias, squares of the bias
        self._rows = 0
        self._rest: Array | None = None  # sums (1, 1 + 2 d) of the block that is not whole
        self._in_rest = 0
        self._shift: Array | None = None  # the squares would lose digits to a large constant

    def add(self, T: Array, bias: Array) -> None:
        """Add samples T (N,) and bias (N, d), later than those before."""
        if len(T) == 0:
            return
        if self._shift is None:
            self._shift = bias.mean(axis=0)
        self.samples += len(T)
        left = bias - self._shift
        self._append(np.column_stack([T, left, left**2]))
        while self._rows >= self.most:
            self._halve()

    def blocks(self) -> Blocks:
        """Return the blocks, that which is not whole among them where it has half of its samples."""
        assert self._shift is not None, "samples are added first"
        means = np.vstack([np.empty((0, 1 + 2 * len(self._shift))), *self._sums]) / self.n
        if self._rest is not None and (2 * self._in_rest >= self.n or not len(means)):
            means = np.vstack([means, self._rest / self._in_rest])
        d = len(self._shift)
        bias, squares = means[:, 1 : 1 + d], means[:, 1 + d :]
        within = np.mean(np.maximum(squares - bias**2, 0.0), axis=0)
        return Blocks(means[:, 0], bias + self._shift, self.n, within)

    def _append(self, rows: Array) -> None:
        """Take rows (N, 1 + 2 d) of samples into blocks."""
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
