"""What is left of a soak beside its curve: white noise, and the walk of a bias over hours.

The samples of a fit are in the order of time. In K blocks, of samples that follow one another at about one
temperature, the bias is::

    y = X beta + walk + white,    walk: the means of a random walk over the blocks,    white_k ~ N(0, s^2 / n_k)

X are straight pieces between knots in T, free to follow any curve, up and down alike; both variances are found by
restricted maximum likelihood, so that what a bias wanders over hours counts, and not the noise of one sample.

Source: H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika
58 (1971) 545.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array

Index = NDArray[np.int64]

SPANS = 240  # of time, at most
BLOCKS = 360  # about, at most
CELLS = 40  # of temperature: a block stays in one
FEWEST = 24  # blocks with which a walk can be told from white noise
KNOTS = 40  # at most, and at least GROUP blocks to each
GROUP = 8
FINE = 1000
STRETCHES = 1920  # of time, in which it is told when a block was measured
RANK = 1e-9  # of the largest singular value: columns that are combinations of others
RATIOS = np.logspace(-6, 6, 49)  # of the walk's variance over a soak to the white noise of a block


@dataclass(frozen=True)
class Blocks:
    """Means of samples: T (K,), what the curve leaves of them y (K, d), how many n (K,).

    `of_sample` (N,) is the block of each sample, `fine` (FINE,) are temperatures, and `nearest` (N,) which each has.
    """

    T: Array
    y: Array
    n: Array
    of_sample: Index
    fine: Array
    nearest: Index

    @cached_property
    def over(self) -> Array:
        """How the samples of each are spread over the temperatures `fine` (K, FINE)."""
        return self._spread(self.nearest, FINE)

    @cached_property
    def during(self) -> Array:
        """How the samples of each are spread over even stretches of time (K, S)."""
        N = len(self.of_sample)
        stretches = min(STRETCHES, N)
        return self._spread(np.arange(N) * stretches // N, stretches)

    def _spread(self, which: Index, count: int) -> Array:
        K = len(self.T)
        table = np.bincount(self.of_sample * count + which, minlength=K * count).reshape(K, count)
        return np.asarray(table / self.n[:, None])

    def shares(self, group: Index, count: int) -> Array:
        """Return by what share each block is in each of `count` groups (count, K); group (N,) of each sample."""
        K = len(self.T)
        table = np.bincount(group * K + self.of_sample, minlength=count * K).reshape(count, K)
        return np.asarray(table / np.maximum(table.sum(axis=1, keepdims=True), 1), dtype=np.float64)


def blocks_of(T: Array, left: Array, group: Index | None = None) -> Blocks:
    """Return the blocks of samples T (N,) and what a curve leaves of them (N, d): spans of time, cut by temperature.

    A block is of one `group` (N,), where these are given, from 0 on.
    """
    N = len(T)
    cell = np.minimum(((T - T.min()) * (CELLS / np.ptp(T))).astype(np.int64), CELLS - 1)
    state = cell if group is None else group * CELLS + cell
    count, spans = int(state.max()) + 1, min(SPANS, N)
    while True:
        found, of_sample = np.unique(np.arange(N) * spans // N * count + state, return_inverse=True)
        if len(found) <= BLOCKS or spans <= 2:
            break
        spans //= 2
    return _summed(T, left, of_sample)


def cells_of(T: Array, left: Array) -> Blocks:
    """Return samples T (N,) and (N, d) by narrow cells of temperature, whenever they were: of what follows from T."""
    near = np.rint((T - T.min()) * ((FINE - 1) / np.ptp(T))).astype(np.int64)
    return _summed(T, left, np.unique(near, return_inverse=True)[1])


def _summed(T: Array, left: Array, of_sample: Index) -> Blocks:
    n = np.bincount(of_sample).astype(np.float64)
    y = np.stack([np.bincount(of_sample, column) / n for column in left.T], axis=1)
    low, step = float(T.min()), float(np.ptp(T)) / (FINE - 1)
    fine = low + step * np.arange(FINE, dtype=np.float64)
    return Blocks(np.bincount(of_sample, T) / n, y, n, of_sample, fine, np.rint((T - low) / step).astype(np.int64))


@dataclass(frozen=True)
class Noise:
    """Noise of the K blocks of one axis.

    `root` (K, r) is one of its covariance, `curve` (p,) the free curve at the knots, `operator` (p, K) what took the
    blocks there. `walk` is the variance of the walk over all samples, `white` that of the white noise of a mean block.
    """

    root: Array
    curve: Array
    operator: Array
    walk: float
    white: float


class Contrasts:
    """What no free curve of T can make of K blocks.

    Attributes
    ----------
    knots : (p,) array
        Of the free curve, X (K, p) its straight pieces.
    Z : (K, m) array
        Contrasts: Z' X = 0, and of other columns (K, q) of the blocks that are to be free too.
    walk : (K, K) array
        Root of the covariance of a walk.
    white : (K,) array
        Variance of white noise, 1 in the mean block.
    """

    def __init__(self, blocks: Blocks, more: Array | None = None) -> None:
        self.knots, pieces = _pieces(blocks)
        self.X = blocks.over @ pieces
        self.walk, self.white = walk_root(blocks), np.mean(blocks.n) / blocks.n
        free = self.X if more is None else np.hstack([self.X, more])
        U, s, _ = np.linalg.svd(free)
        self.Z = U[:, int(np.sum(s > RANK * s[0])) :]

    def noise(self, y: Array, left: Array) -> Noise:
        """Tell walk from white noise in what a map leaves of the blocks, y (K,) = left (K, K) times their noise."""
        scale, K = float(np.sqrt(np.mean(y**2))) or 1.0, len(y)
        A = self.Z.T @ left  # the map has taken its part of the noise already
        k2, s2 = 0.0, float(np.mean((y / scale) ** 2 / self.white))
        if len(A) >= FEWEST:
            # turned so that the white noise is alike in all contrasts, and the walk independent
            R, V = np.linalg.eigh((A * self.white) @ A.T)
            seen = 1e-6 * R[-1] < R
            L = (V[:, seen] / np.sqrt(R[seen])).T
            own, V = np.linalg.eigh(L @ (A @ self.walk) @ (A @ self.walk).T @ L.T)
            k2, s2 = _likeliest(np.clip(own, 0.0, None), V.T @ (L @ (self.Z.T @ (y / scale))))
        root = np.hstack([np.sqrt(k2) * self.walk, np.diag(np.sqrt(s2 * self.white))])
        S = root @ root.T + np.eye(K) * max(1e-9 * (k2 + s2), 1e-12)
        weighted = np.linalg.solve(S, self.X)
        operator = np.asarray(np.linalg.pinv(self.X.T @ weighted, hermitian=True) @ weighted.T, dtype=np.float64)
        return Noise(scale * root, operator @ y, operator, k2 * scale**2, s2 * scale**2)


def walk_root(blocks: Blocks) -> Array:
    """Return a root (K, K) of the covariance of a walk's means over the blocks; its variance in all is 1.

    A step of the walk moves all samples after it: the mean of a block by the share a of its samples that are still to
    come. The covariance of two blocks is the integral of a a' over time, also of such as were measured in turn.
    """
    later = np.cumsum(blocks.during[:, ::-1], axis=1)[:, ::-1] - blocks.during / 2  # half way through each stretch
    covariance = (later @ later.T + blocks.during @ blocks.during.T / 12) / blocks.during.shape[1]
    own, V = np.linalg.eigh(covariance)
    return np.asarray(V * np.sqrt(np.clip(own, 0.0, None)))


def _likeliest(own: Array, u: Array) -> tuple[float, float]:
    """Return the variances of walk and white noise for which u (m,) ~ N(0, k^2 own + s^2) is likeliest."""
    from scipy.optimize import minimize_scalar

    if not np.any(u):
        return 0.0, 0.0

    def at(ratio: float) -> tuple[float, float]:
        shape = ratio * own + 1.0
        scale = float(np.mean(u**2 / shape))
        return len(u) * np.log(scale) + float(np.sum(np.log(shape))), scale

    k = int(np.argmin([at(ratio)[0] for ratio in RATIOS]))
    bounds = np.log(RATIOS[max(k - 1, 0)]), np.log(RATIOS[min(k + 1, len(RATIOS) - 1)])
    best = float(np.exp(minimize_scalar(lambda log: at(float(np.exp(log)))[0], bounds=bounds, method="bounded").x))
    best = best if at(best)[0] < at(0.0)[0] else 0.0
    scale = at(best)[1]
    return best * scale, scale


def _pieces(blocks: Blocks) -> tuple[Array, Array]:
    """Return knots (p,) and the straight pieces between them (FINE, p), each with blocks of its own."""
    p = int(np.clip(len(blocks.T) // GROUP, 2, KNOTS))
    knots = np.unique(np.quantile(blocks.T, np.linspace(0, 1, p)))
    if len(knots) < 2:
        return knots, np.ones((FINE, 1))
    return knots, np.stack([np.interp(blocks.fine, knots, row) for row in np.eye(len(knots))], axis=1)
