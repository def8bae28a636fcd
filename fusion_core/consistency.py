"""Tests of the filter on its innovations: size (NIS) and whiteness.

Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), sec. 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array, Integers
from fusion_core.fast import compiled

PIECE = 4096  # rows multiplied at once: they stay in the cache
BLOCKS = 4096  # sums of equal blocks that are kept, at most
FEWEST = 16  # blocks whose sums are a test


@dataclass(frozen=True)
class NisTest:
    """Mean NIS per measured component (1 where the model is right) and the bounds that it should keep."""

    mean: float
    low: float
    high: float

    @property
    def consistent(self) -> bool:
        """True if the mean is within its bounds."""
        return self.low <= self.mean <= self.high


def gate_of(m: int, false_alarm: float) -> float:
    """Return the nis that a right model with m components exceeds with probability `false_alarm`."""
    from scipy import special

    return float(special.chdtri(m, false_alarm))


def gates_of(gate: float, m: int) -> Array:
    """Return the gate (m + 1,) of samples with 0 to m measured components, given that of m.

    A right model exceeds each with the same probability. Beyond what a double tells from zero all are `gate`.
    """
    from scipy import special

    gates = np.full(m + 1, gate, dtype=np.float64)
    probability = float(special.chdtrc(m, gate)) if m else 0.0
    if probability > 0:
        gates[1:m] = special.chdtri(np.arange(1, m), probability)
    return gates


def nis_test(nis: Array, m: int | Integers, level: float = 0.99) -> NisTest:
    """Compare the mean of nis (N,) of m components each, or of `Estimates.dof` (N,), with its bounds at `level`."""
    N, of_each = (len(nis), m) if isinstance(m, int) else (int(np.sum(m)), 1)
    return nis_test_of(float(np.sum(nis)), N, of_each, level)


def nis_test_of(total: float, N: int, m: int, level: float = 0.99) -> NisTest:
    """Compare the mean of N values of nis, given by their sum, with its two-sided bounds at `level`."""
    if N * m == 0:
        return NisTest(np.nan, np.nan, np.nan)
    from scipy import special

    tail = (1 - level) / 2
    low, high = (float(special.chdtri(N * m, p)) / (N * m) for p in (1 - tail, tail))
    return NisTest(total / N / m, low, high)


class VarianceRatio(NamedTuple):
    """Sums of innovations over blocks beside those of independent ones, of m components.

    Source: A. W. Lo and A. C. MacKinlay, Review of Financial Studies 1 (1988) 41.

    Attributes
    ----------
    ratio : (m,) array
        Mean square of a block's sum over that of as many independent innovations of the same size.
    rows : (m,) array
        Rows of that block.
    p : (m,) array
        Probability of so much, or more, in white innovations, for all sizes that were tried; NaN where N is too small.
    square : (m,) array
        Mean square of single innovations.
    """

    ratio: Array
    rows: Array
    p: Array
    square: Array


class Whiteness:
    """The sums behind tests of whiteness, taken stretch by stretch: m components at lags up to `lags`, and in blocks.

    ::

        r_l = sum_k (w_k - mean)(w_{k+l} - mean) = sum_k w_k w_{k+l} - mean (head_l + tail_l) + (N - l) mean^2

    with head_l and tail_l the sums of all w but the last and the first l. Sums of equal blocks are joined two by two
    where they are more than BLOCKS.
    """

    def __init__(self, m: int, lags: int = 20) -> None:
        self.lags, self.N = lags, 0
        self._total, self._products = np.zeros(m), np.zeros((lags + 1, m))
        self._first = self._last = np.empty((0, m))  # up to `lags` rows at either end
        self._size, self._filled = 1, 0  # rows of a block, and of the one that is not full yet
        self._sums, self._part = np.empty((0, m)), np.zeros(m)

    def add(self, white: Array) -> None:
        """Count the next innovations (N, m)."""
        self.N += len(white)
        self._first = np.concatenate([self._first, white[: self.lags - len(self._first)]])
        rows = np.concatenate([self._last, white])
        count = max(0, len(rows) - self.lags)
        _lagged(rows, count, self._products, self._total)
        self._last = rows[count:]
        self._add_to_blocks(white)

    def _add_to_blocks(self, white: Array) -> None:
        if not len(white):
            return
        cuts = np.arange(self._size - self._filled, len(white), self._size)
        sums = np.add.reduceat(white, np.concatenate([[0], cuts]), axis=0, dtype=np.float64)
        sums[0] += self._part  # of the block that was not full
        self._filled = (self._filled + len(white)) % self._size
        whole = len(sums) - (self._filled > 0)
        self._part = np.sum(sums[whole:], axis=0)
        if whole:  # one sample at a time, sums are not copied for each
            self._sums = np.concatenate([self._sums, sums[:whole]])
        while len(self._sums) > BLOCKS:
            even = len(self._sums) // 2 * 2
            self._filled += self._size * (len(self._sums) - even)
            self._part = self._part + np.sum(self._sums[even:], axis=0)
            self._sums, self._size = self._sums[0:even:2] + self._sums[1:even:2], 2 * self._size

    def slow(self) -> VarianceRatio:
        """Return the ratio of sums over blocks to those of white innovations, at the size of block where it is surest.

        A slow error, which is far below the innovations of single updates, adds up.
        """
        from scipy import special

        m = len(self._total)
        best = np.ones(m), np.ones(m), np.full(m, np.nan)
        square = self.covariances()[0] / self.N if self.N else np.ones(m)
        sums, size, tried = self._sums, self._size, 0
        while len(sums) >= FEWEST:
            ratio = np.mean(sums**2, axis=0) / (size * np.where(square > 0, square, 1.0))
            p, tried = special.chdtrc(len(sums), len(sums) * ratio), tried + 1
            better = ~(p >= best[2])
            for own, values in zip(best, (ratio, np.full(m, float(size)), p), strict=True):
                own[better] = values[better]
            sums, size = sums[0 : len(sums) // 2 * 2 : 2] + sums[1 : len(sums) // 2 * 2 : 2], 2 * size
        return VarianceRatio(best[0], best[1], np.minimum(best[2] * max(tried, 1), 1.0), square)

    def covariances(self) -> Array:
        """Return N times the covariance (lags + 1, m) at each lag from 0 on."""
        products, total, lag = self._products.copy(), self._total.copy(), np.arange(self.lags + 1)[:, None]
        _lagged(np.concatenate([self._last, np.zeros((self.lags, len(total)))]), len(self._last), products, total)
        mean, none = total / self.N, np.zeros((1, len(total)))
        edges = (np.cumsum(np.concatenate([none, part]), axis=0) for part in (self._first, self._last[::-1]))
        ends = sum(edge[np.minimum(lag[:, 0], len(edge) - 1)] for edge in edges)
        return np.asarray(products - mean * (2 * total - ends) + np.maximum(self.N - lag, 0) * mean**2)

    def autocorrelation(self) -> Array:
        """Return the autocorrelation (lags, m) at lags 1 to `lags`."""
        covariances = self.covariances()
        return covariances[1:] / np.where(covariances[0] > 0, covariances[0], 1.0)

    def p(self) -> Array:
        """Return the p-value (m,) of the hypothesis that the innovations are white.

        Ljung and Box, Biometrika 65 (1978) 297: small values speak against whiteness. NaN where N is too small.
        """
        N, lags = self.N, min(self.lags, self.N // 4)
        if lags < 1:
            return np.full(len(self._total), np.nan)
        from scipy import special

        weights = N * (N + 2) / (N - np.arange(1, lags + 1))
        return np.asarray(special.chdtrc(lags, weights @ self.autocorrelation()[:lags] ** 2))


@partial(compiled, fastmath={"reassoc", "contract"})
def _lagged(rows: Array, stop: int, products: Array, sums: Array) -> None:
    """Add sum_k rows[k] rows[k + lag] and rows[k], k < stop, to products (lags + 1, m) and sums (m,), in the cache."""
    lags, m = len(products) - 1, rows.shape[1]
    some = np.empty(PIECE + lags)
    for start in range(0, stop, PIECE):
        N = min(PIECE, stop - start)
        for j in range(m):
            for k in range(N + lags):
                some[k] = rows[start + k, j]
            for k in range(N):
                sums[j] += some[k]
            for lag in range(lags + 1):
                total = 0.0
                for k in range(N):
                    total += some[k] * some[k + lag]
                products[lag, j] += total


def whiteness_p(white: Array, lags: int = 20) -> Array:
    """Return the p-value (m,) of the hypothesis that innovations (N, m) are white (`Whiteness`)."""
    sums = Whiteness(white.shape[1], lags)
    sums.add(white)
    return sums.p()
