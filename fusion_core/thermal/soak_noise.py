"""White noise of a soak and the walk of a bias over hours, beside its curve.

The samples of a fit are in the order of time. In K blocks, of samples that follow one another at about one
temperature, the bias is::

    y = X beta + walk + white,    walk: the means of a random walk over the blocks,    white_k ~ N(0, s^2 / n_k)

X are straight pieces between knots in T, free to follow any curve, up and down alike; both variances are means over
their restricted likelihood, so that what a bias wanders over hours counts, and not the noise of one sample.

Source: H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika
58 (1971) 545.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fusion_core.chunk import Array, Integers

if TYPE_CHECKING:
    from scipy.sparse import csr_array


SPANS = 240  # of time, at most
BLOCKS = 360  # about, at most
CELLS = 40  # of temperature: a block stays in one
MIN_BLOCKS = 24  # blocks that separate a walk from white noise, at least
KNOTS = 40  # at most, and at least GROUP blocks to each
GROUP = 8
FINE = 1000
STRETCHES = 1920  # of time, at most: resolution of the times of a block
RANK = 1e-9  # of the largest singular value: columns that are combinations of others
TAKEN = 1e-6  # of the largest eigenvalue: a contrast of which the map leaves less says nothing
ESTIMATED = 100.0  # times as much is left of every one by an estimate, where none is looked at by itself
RATIOS = np.logspace(-6, 6, 241)  # of the walk's variance over a soak to the white noise of a block


@dataclass(frozen=True)
class Blocks:
    """Means of samples: T (K,), what the curve leaves of them y (K, d), how many n (K,).

    `of_sample` (N,) is the block of each sample, `fine` (FINE,) are temperatures, and `nearest` (N,) which each has.
    """

    T: Array
    y: Array
    n: Array
    of_sample: Integers
    fine: Array
    nearest: Integers
    _known: dict[int, tuple[Integers, csr_array]] = field(default_factory=dict, init=False)  # shares by their groups

    @cached_property
    def over(self) -> csr_array:
        """The spread of each block's samples over the temperatures `fine` (K, FINE), sparse."""
        return self._spread(self.nearest, FINE)

    @cached_property
    def during(self) -> csr_array:
        """The spread of each block's samples over even stretches of time (K, S), sparse."""
        stretches = min(STRETCHES, N := len(self.of_sample))
        return self._spread(np.arange(N) * stretches // N, stretches)

    def _spread(self, which: Integers, count: int) -> csr_array:
        return _shares(self.of_sample, which, (len(self.T), count))

    def shares(self, group: Integers, count: int) -> csr_array:
        """Return the share of each of `count` groups in each block (count, K), sparse; `group` (N,) of samples.

        The axes of a fit have the same.
        """
        if id(group) not in self._known:
            self._known[id(group)] = group, _shares(group, self.of_sample, (count, len(self.T)))
        return self._known[id(group)][1]


def _shares(group: Integers, part: Integers, shape: tuple[int, int]) -> csr_array:
    """Return the share of each part in the samples (N,) of each group, sparse."""
    from scipy.sparse import csr_array

    shares = csr_array((np.ones(len(group)), (group, part)), shape=shape)
    shares.data /= np.repeat(np.bincount(group), np.diff(shares.indptr))
    return shares


Smoother = Callable[[Blocks, Array, int], Array]
"""Response of a kind of map to the blocks' bias, on a grid (G,), for an axis: H (G, K)."""


def blocks_of(T: Array, left: Array, group: Integers | None = None) -> Blocks:
    """Return the blocks of samples T (N,) and what a curve leaves of them (N, d): spans of time, cut by temperature.

    A block is of one `group` (N,), where these are given, from 0 on.
    """
    N = len(T)
    cell = np.minimum(((T - T.min()) * (CELLS / np.ptp(T))).astype(np.int64), CELLS - 1)
    state = cell if group is None else group * CELLS + cell
    count, spans = int(state.max()) + 1, min(SPANS, N)
    while True:
        blocks, of_sample = np.unique(np.arange(N) * spans // N * count + state, return_inverse=True)
        if len(blocks) <= BLOCKS or spans <= 2:
            break
        spans //= 2
    return summed(T, left, of_sample)


def cells_of(T: Array, left: Array) -> Blocks:
    """Return samples T (N,) and (N, d) by narrow cells of temperature, whenever they were: of what follows from T."""
    near = np.rint((T - T.min()) * ((FINE - 1) / np.ptp(T))).astype(np.int64)
    return summed(T, left, (np.cumsum(np.bincount(near) > 0) - 1)[near])


def summed(T: Array, left: Array, of_sample: Integers) -> Blocks:
    """Return samples T (N,) and (N, d) as blocks, of which `of_sample` (N,) are the numbers, from 0 on."""
    n = np.bincount(of_sample).astype(np.float64)
    y = np.stack([np.bincount(of_sample, column) / n for column in left.T], axis=1)
    low, step = float(T.min()), float(np.ptp(T)) / (FINE - 1)
    fine = low + step * np.arange(FINE, dtype=np.float64)
    return Blocks(np.bincount(of_sample, T) / n, y, n, of_sample, fine, np.rint((T - low) / step).astype(np.int64))


@dataclass(frozen=True)
class BlockNoise:
    """Noise of the K blocks of one axis.

    `root` (K, K) is one of its covariance, `curve` (p,) the free curve at the knots, `operator` (p, K) what took the
    blocks there. `walk` is the variance of the walk over all samples, `white` that of the white noise of a mean block.
    """

    root: Array
    curve: Array
    operator: Array
    walk: float
    white: float


class Complement:
    """Contrasts of which independent columns (K, p) have no part, by p reflections: Z' columns = 0, Z (K, m)."""

    def __init__(self, columns: Array) -> None:
        from scipy.linalg.lapack import dgeqrf

        self.p = columns.shape[1]
        self._reflections = dgeqrf(columns)[:2]

    def _reflected(self, x: Array, side: str, way: str) -> Array:
        from scipy.linalg.lapack import dormqr

        return np.asarray(dormqr(side, way, *self._reflections, x, 64 * len(x))[0])

    @cached_property
    def Z(self) -> Array:
        """The contrasts (K, m), orthonormal."""
        return self._reflected(np.eye(len(self._reflections[0])), "L", "N")[:, self.p :]

    def of(self, x: Array) -> Array:
        """Return Z' x (m, n) of x (K, n)."""
        return self._reflected(x, "L", "T")[self.p :]

    def both(self, C: Array) -> Array:
        """Return Z' C Z (m, m) of C (K, K)."""
        return self._reflected(self._reflected(C, "L", "T"), "R", "N")[self.p :, self.p :]


def basis_of(columns: Array, rank: float = RANK) -> Array:
    """Return orthonormal columns (K, p) that span others (K, q), combinations of which are left out."""
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(U[:, s > rank * s[0]])


class Contrasts:
    """Contrasts of K blocks that no free curve of T can make: straight pieces X (K, p) between `knots` (p,).

    `covariance` (K, K) is that of a walk, `white` (K,) the variance of white noise, 1 in the mean block.
    """

    def __init__(self, blocks: Blocks, more: Array | None = None) -> None:
        self.knots, pieces = _pieces(blocks)
        self.X = np.asarray(blocks.over @ pieces)
        self.covariance, self.white = walk_covariance(blocks), np.mean(blocks.n) / blocks.n
        self._free = basis_of(self.X if more is None else np.hstack([self.X, more]))

    @cached_property
    def Z(self) -> Array:
        """Contrasts (K, m): Z' X = 0, and of other columns (K, q) of the blocks that are to be free too."""
        return Complement(self._free).Z

    @cached_property
    def walk(self) -> Array:
        """A root (K, K) of the walk's covariance."""
        return _root(self.covariance)

    def noise(self, y: Array, left: Array) -> BlockNoise:
        """Tell walk from white noise in what a map leaves of the blocks, y (K,) = left (K, K) times their noise."""
        scale, K = float(np.sqrt(np.mean(y**2))) or 1.0, len(y)
        k2, s2 = 0.0, float(np.mean((y / scale) ** 2 / self.white))
        if K - self._free.shape[1] >= MIN_BLOCKS:
            k2, s2 = _expected(*self._turned(y / scale, left))
        S = k2 * self.covariance
        S[np.diag_indices(K)] += s2 * self.white + max(1e-9 * (k2 + s2), 1e-12)
        found = self.known(S, y, k2 * scale**2, s2 * scale**2)
        return replace(found, root=scale * found.root)

    def known(self, S: Array, y: Array, walk: float, white: float) -> BlockNoise:
        """Return the noise of a covariance S (K, K), in blocks of which a map leaves y (K,)."""
        from scipy.linalg import cho_solve

        root = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
        weighted = np.asarray(cho_solve((root, True), self.X, check_finite=False))
        operator = np.asarray(np.linalg.pinv(self.X.T @ weighted, hermitian=True) @ weighted.T, dtype=np.float64)
        return BlockNoise(root, operator @ y, operator, walk, white)

    def _turned(self, y: Array, left: Array) -> tuple[Array, Array]:
        """Return the walk's covariance (r, r) and u (r,) in contrasts turned so that white noise has one of 1.

        The contrasts are A = Z' left of the noise: the map has taken its part of it already. As Z' U = 0 of the basis U
        of the free columns, A = Z' M with M = left + U U'. Where M has an inverse, A says nothing of M^-1 U alone, and
        M^-1 y is as much to A as the noise itself. Where it hardly has one, what the map leaves nothing of is left out.
        """
        from scipy.linalg.lapack import dgecon, dgetrf, dgetrs

        M, root = left + self._free @ self._free.T, np.sqrt(self.white)[:, None]
        factors, order, singular = dgetrf(M)
        inverse_condition = dgecon(factors, np.max(np.sum(np.abs(M), axis=0)))[0] * np.min(root) / np.max(root)
        if not singular and inverse_condition**2 > ESTIMATED * TAKEN:
            solved = dgetrs(factors, order, np.column_stack([self._free, y]))[0] / root
            seen = Complement(solved[:, :-1])
            return seen.both(self.covariance / (root * root.T)), seen.of(solved[:, -1:])[:, 0]
        A = self.Z.T @ left
        values, V = np.linalg.eigh((A * self.white) @ A.T)
        some = values > TAKEN * values[-1]
        R = (V[:, some] / np.sqrt(values[some])).T
        return R @ (A @ self.covariance @ A.T) @ R.T, R @ (self.Z.T @ y)


def walk_covariance(blocks: Blocks) -> Array:
    """Return the covariance (K, K) of a walk's means over the blocks; its variance in all is 1.

    A walk over S even stretches, each of a variance of 1 / S, has means over the stretches s and r of the covariance
    (min(s, r) + 1/2 - d / 6) / S, s and r counted from 0 and d one where they are the same. A block's mean is that of
    its samples, also of such as were measured in turn with another's.
    """
    during = blocks.during
    K, S = during.shape
    first, row = during.indices[during.indptr[:-1]], np.repeat(np.arange(K), np.diff(during.indptr))
    own = np.zeros((K, int(np.max(during.indices - first[row])) + 1))
    own[row, during.indices - first[row]] = during.data
    # sum of during(s) min(s, r) over s: r before a block, its mean stretch after it, and within it as much more from r
    # to r + 1 as is still to come
    within = first[:, None] + np.cumsum(own[:, ::-1], axis=1)[:, ::-1].cumsum(axis=1) - 1.0
    least = np.minimum(np.arange(S, dtype=np.float64)[:, None], within[:, -1])
    r = first[:, None] + np.arange(own.shape[1])
    inside = r < S
    least[r[inside], np.nonzero(inside)[0]] = within[inside]
    covariance = (during @ least + 0.5 - (during @ during.T).toarray() / 6) / S
    return np.asarray((covariance + covariance.T) / 2)


def walk_root(blocks: Blocks) -> Array:
    """Return a root (K, K) of the covariance of a walk's means over the blocks; its variance in all is 1."""
    return _root(walk_covariance(blocks))


def _root(covariance: Array) -> Array:
    values, V = np.linalg.eigh(covariance)
    return np.asarray(V * np.sqrt(np.clip(values, 0.0, None)))


def _expected(walk: Array, u: Array) -> tuple[float, float]:
    """Return the means of the variances of walk and white noise, given u (m,) ~ N(0, k^2 walk + s^2), walk (m, m).

    The likeliest walk is none in many soaks that have one. What follows from the noise is linear in both variances,
    and is right on average with their means: k / s and log s are as probable everywhere before (A. Gelman, Prior
    distributions for variance parameters in hierarchical models, Bayesian Analysis 1 (2006) 515).
    """
    m = len(u)
    if m < 3 or not np.any(u):
        return 0.0, float(u @ u) / max(m, 1)
    # the first contrast along u, and each walks with its neighbours alone: the pivots of elimination, from the last on,
    # are the determinant, and the first of them the squares. Eigenvectors take five times as long
    variances, covariances, length = _tridiagonal(walk, u)
    pivots, beside = np.outer(variances, RATIOS) + 1.0, np.outer(covariances**2, RATIOS**2)
    for k in range(m - 1, 0, -1):
        pivots[k - 1] -= beside[k - 1] / pivots[k]
    squares = length**2 / pivots[0]
    log_density = np.log(RATIOS) / 2 - m / 2 * np.log(squares) - np.sum(np.log(pivots), axis=0) / 2
    weight = np.exp(log_density - np.max(log_density))
    white = weight / np.sum(weight) * squares / (m - 2)
    return float(white @ RATIOS), float(np.sum(white))


def _tridiagonal(M: Array, u: Array) -> tuple[Array, Array, float]:
    """Return the diagonals (r,) and (r - 1,) of Q' M Q, Q orthogonal, its first column along u (r,), and u's length.

    By Householder's reflections of M (r, r) bordered by u, which leave the border's own place where it is.
    """
    from scipy.linalg.lapack import dsytrd, dsytrd_lwork

    r = len(u)
    bordered = np.zeros((r + 1, r + 1), order="F")
    bordered[1:, 1:], bordered[1:, 0] = M, u
    room = int(dsytrd_lwork(r + 1, lower=1)[0])
    _, diagonal, beside, _, _ = dsytrd(bordered, lower=1, lwork=room, overwrite_a=1)
    return diagonal[1:], beside[1:], float(beside[0])


def _pieces(blocks: Blocks) -> tuple[Array, Array]:
    """Return knots (p,) and the straight pieces between them (FINE, p), each with blocks of its own."""
    p = int(np.clip(len(blocks.T) // GROUP, 2, KNOTS))
    knots = np.unique(np.quantile(blocks.T, np.linspace(0, 1, p)))
    if len(knots) < 2:
        return knots, np.ones((FINE, 1))
    return knots, straight_pieces(knots, blocks.fine)


def straight_pieces(knots: Array, T: Array) -> Array:
    """Return the straight pieces between knots (p,) at T (N,), level beyond them (N, p)."""
    place = np.clip(np.searchsorted(knots, T, side="right") - 1, 0, len(knots) - 2)
    share = np.clip((T - knots[place]) / (knots[place + 1] - knots[place]), 0.0, 1.0)
    pieces, rows = np.zeros((len(T), len(knots))), np.arange(len(T))
    pieces[rows, place], pieces[rows, place + 1] = 1.0 - share, share
    return pieces
