"""Regressors of a search: everything that may be in a model as columns over the rows, and their inner products.

A column is what a curve of the map, one coefficient of an effect, or the unknown start of a memory adds to the
bias. Each is centred in each recording (its mean is the recording's level) and scaled to a mean square of 1, so any
model is a choice of columns, and its least squares a choice of rows and columns of Gram matrices that are made once.
n rows, R recordings, S segments, d axes, K columns.

Normal equations of least squares are inner products of columns over some rows::

    A x = b,    A = Z'Z + ridge,    b = Z'y,    what is left = y'y - b'x

Those of several sets of rows add up; a choice of columns is a choice of rows and columns of A; columns that stay are
taken out by the Schur complement. k columns; where a matrix G (k + 1, k + 1) is given, its last column is y's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotrs

from driftlab.identification.records import Evidence, map_inputs
from fusion_core.chunk import Array, Flags, Integers
from fusion_core.contracts import Basis, Effect
from fusion_core.fast import compiled, inlined

TINY = 1e-9  # ridge, of the mean square of a column: what the rows do not determine stays small
ROUNDING = 1e-14  # of the square of a column: what is left of it is nothing


@dataclass(frozen=True)
class NormalEquations:
    """Symmetric, non-negative normal equations."""

    A: Array  # (k, k) inner products of the columns, ridges added
    b: Array  # (k,) theirs with the signal
    yy: float  # the signal's sum of squares

    @classmethod
    def of(cls, G: Array) -> NormalEquations:
        """Return those of inner products G (k + 1, k + 1), the last column the signal."""
        return cls(G[:-1, :-1].copy(), G[:-1, -1].copy(), float(G[-1, -1]))

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Return those over the rows of both."""
        return NormalEquations(self.A + other.A, self.b + other.b, self.yy + other.yy)

    def raised(self, ridge: Array) -> NormalEquations:
        """Return those with a ridge on the first columns: its diagonal (j,), or (j, j)."""
        A, j = self.A.copy(), len(ridge)
        A[:j, :j] += np.diag(ridge) if ridge.ndim == 1 else ridge
        return NormalEquations(A, self.b, self.yy)

    def restricted(self, keep: Integers | Flags) -> NormalEquations:
        """Return those of some columns, the coefficients of the others being 0."""
        return NormalEquations(self.A[np.ix_(keep, keep)], self.b[keep], self.yy)

    def given(self, theta: Array) -> NormalEquations:
        """Return those of the first columns where the coefficients of the last (p,) are given."""
        j = len(self.b) - len(theta)
        yy = self.yy - 2 * float(self.b[j:] @ theta) + float(theta @ self.A[j:, j:] @ theta)
        return NormalEquations(self.A[:j, :j], self.b[:j] - self.A[:j, j:] @ theta, yy)

    def solve(self, b: Array) -> Array:
        """Return x (k,) or (k, p) of A x = b; what A does not determine is nearly zero."""
        return np.asarray(dpotrs(self._root(), b)[0])

    def _root(self) -> Array:
        """Return U (k, k) with U' U = A and a tiny ridge; below its diagonal stands anything."""
        diagonal = np.diag_indices(len(self.A))
        tiny = TINY * max(float(np.mean(self.A[diagonal])), 1e-300) if len(self.A) else 0.0
        while True:
            A = self.A.copy()
            A[diagonal] += tiny
            root, indefinite = dpotrf(A.T, clean=False, overwrite_a=True)
            if not indefinite:
                return np.asarray(root)
            tiny *= 100  # rounding made it so

    @cached_property
    def solution(self) -> Array:
        """The coefficients (k,)."""
        return self.solve(self.b)

    @property
    def left(self) -> float:
        """Sum of squares that is left, with what the ridge adds."""
        return max(self.yy - float(self.b @ self.solution), 0.0)

    @property
    def variances(self) -> Array:
        """Variances (k,) of the coefficients for noise of density 1."""
        return np.diag(self.solve(np.eye(len(self.A))))

    def explained(self, products: Array) -> Array:
        """Return V (K, k): V V' is what these columns explain of the inner products of others.

        `products` (k, K) are those of these columns with the others.
        """
        return np.ascontiguousarray(solve_triangular(self._root(), products, trans=1, check_finite=False).T)


def free_starts(
    equations: NormalEquations, first: int, starts: Sequence[Integers], rows: int, colour: float
) -> tuple[Array, float]:
    """Return the deviation of the starts of each term beyond what noise makes of them, and the noise's density S.

    Columns are those of the starts from `first` on.
    """
    beta, variances = equations.solution, equations.variances
    slow = colour * max(equations.left, 1e-12 * equations.yy, 1e-300) / rows
    sd, at = np.zeros(len(starts)), first
    for k, own in enumerate(starts):
        part = np.arange(at, at + len(own))
        at += len(own)
        if len(own):
            sd[k] = np.sqrt(max(float(np.mean(beta[part] ** 2 - slow * variances[part])), 0.0))
    return sd, slow


@inlined
def _reduced(G: Array, V: Array, i: int, j: int) -> float:
    """Return an entry of G - V V'."""
    total = G[i, j]
    for k in range(V.shape[1]):
        total -= V[i, k] * V[j, k]
    return float(total)


@inlined
def _squares_explained(A: Array, b: Array) -> float:
    """Return b' A^-1 b of a symmetric A (k, k), which is overwritten by its Cholesky factor L, and b (k,) by L^-1 b.

    A column that is a combination of those before it, to rounding, explains nothing more: L is infinite there.
    """
    squares = 0.0
    for j in range(len(b)):
        whole = A[j, j]
        for q in range(j):
            A[j, j] -= A[j, q] * A[j, q]
            b[j] -= A[j, q] * b[q]
        root = np.sqrt(A[j, j]) if A[j, j] > ROUNDING * whole else np.inf
        A[j, j], b[j] = root, b[j] / root
        squares += b[j] * b[j]
        for i in range(j + 1, len(b)):
            for q in range(j):
                A[i, j] -= A[i, q] * A[j, q]
            A[i, j] /= root
    return squares


@inlined
def _coefficients(L: Array, w: Array, first: int) -> tuple[Array, Array]:
    """Return coefficients and variances (k,) under noise of a variance of 1, from the `first` on; w is L^-1 b (k,)."""
    k = len(w)
    beta, variances, column = np.zeros(k), np.zeros(k), np.zeros(k)
    for i in range(k - 1, first - 1, -1):
        beta[i] = w[i]
        for r in range(i + 1, k):
            beta[i] -= L[r, i] * beta[r]
        beta[i] /= L[i, i]
        for r in range(i, k):
            column[r] = 1.0 if r == i else 0.0
            for q in range(i, r):
                column[r] -= L[r, q] * column[q]
            column[r] /= L[r, r]
            variances[i] += column[r] ** 2
    return beta, variances


@compiled
def left_with_starts(G: Array, V: Array, y: int, cols: Integers, sizes: Integers, rows: int, colour: float) -> float:
    """Return the sum of squares that columns leave, the last of them starts of terms (`sizes` each), ridge added.

    G (K, K) holds inner products of all columns, V V' the part of them that the base explains (V (K, k)), y the
    signal's place. As `free_starts` and `NormalEquations.left`, compiled: it is asked for tens of thousands of times.
    """
    k, yy = len(cols), _reduced(G, V, y, y)
    A, b = np.empty((k, k)), np.empty(k)
    for i in range(k):
        b[i] = _reduced(G, V, cols[i], y)
        for j in range(i + 1):
            A[i, j] = A[j, i] = _reduced(G, V, cols[i], cols[j])
    level = np.trace(A) / max(k, 1)
    if k == 0 or level <= 0:
        return float(yy)
    for i in range(k):
        A[i, i] += TINY * level
    if np.sum(sizes) > 0:
        L, w, at = A.copy(), b.copy(), k - np.sum(sizes)
        slow = colour * max(yy - _squares_explained(L, w), 1e-12 * yy, 1e-300) / rows
        beta, variances = _coefficients(L, w, at)
        for size in sizes:
            sd2 = 0.0
            for i in range(at, at + size):
                sd2 += (beta[i] ** 2 - slow * variances[i]) / size
            for i in range(at, at + size):
                if sd2 > 0:
                    A[i, i] += slow / sd2
                else:  # it starts at equilibrium: out of the model
                    A[i, :] = 0.0
                    A[:, i] = 0.0
                    A[i, i], b[i] = level, 0.0
            at += size
    return float(yy - _squares_explained(A, b))


PARTS = 5  # that a single recording is cut into
HALVES = 2  # of each of several recordings
SAME = 1e-5  # of columns, by which combinations of others may differ from them


@dataclass(frozen=True)
class RowSegment:
    """A stretch of rows of one recording that is never divided."""

    record: int
    rows: slice


@dataclass(frozen=True)
class EffectColumns:
    """Columns of an effect: on each axis, with the coefficients that they belong to, and of its start."""

    p: int  # number of coefficients
    columns: tuple[Integers, ...]  # (k,) of each axis
    places: tuple[Integers, ...]  # (k,) of each axis: the coefficients that the columns belong to
    # (R,) response to a start of 1 in each recording; None where the effect has no unknown start
    starts: Integers | None


class EffectRegressors:
    """Columns over the n rows of one evidence."""

    def __init__(self, evidence: Evidence, basis: Basis | None) -> None:
        self.evidence, self.basis = evidence, basis
        n, R = len(evidence), len(evidence.records)
        self._W, self._means, self._scale = np.zeros((64, n)), np.zeros((64, R)), np.ones(64)  # a row is a column
        self._size, self._known = 0, 0
        self.segments = _segments(evidence)
        self._gram = np.zeros((len(self.segments), 0, 0))
        self._sums: dict[tuple[int, ...], Array] = {}
        self._effects: dict[Effect, EffectColumns] = {}
        self._maps: dict[tuple[Effect, ...], Integers] = {}
        levels = np.zeros((n, R))
        for r, rows in enumerate(evidence.slices):
            levels[rows, r] = 1.0
        self.levels = self._add(levels, centred=False)  # (R,) columns of the recordings' levels
        self.y = self._add(evidence.rate)  # (d,) columns of the measured bias
        noise = np.full(len(self.y), np.nan) if evidence.noise is None else evidence.noise
        # variance (d,) of the declared white noise of a row, in the scaled unit; NaN where none is declared
        self.declared_white = (noise / self._scale[self.y]) ** 2 / evidence.interval
        self.penalty = np.zeros((0, 0)) if basis is None else basis.penalty

    @property
    def W(self) -> Array:
        """The columns (n, K)."""
        return self._W[: self._size].T

    @property
    def means(self) -> Array:
        """Mean of each column in each recording (R, K), which was subtracted, in the scaled unit."""
        return self._means[: self._size].T

    @property
    def scale(self) -> Array:
        """Divisor of each column (K,)."""
        return self._scale[: self._size]

    @property
    def everything(self) -> tuple[int, ...]:
        """All segments."""
        return tuple(range(len(self.segments)))

    def gram(self, segments: Sequence[int], rows: Integers | None = None) -> Array:
        """Return the inner products of all columns over some segments, or of `rows` alone."""
        self._complete()
        key, size = tuple(segments), self._known
        if rows is None and key not in self._sums:
            total = np.zeros((size, size))
            for segment in key:
                total += self._gram[segment, :size, :size]
            self._sums[key] = total
        if rows is None:
            return self._sums[key]
        if key in self._sums:
            return np.asarray(self._sums[key][np.ix_(rows, rows)])
        return np.asarray(self._gram[np.ix_(np.array(key, dtype=np.intp), rows, rows)].sum(axis=0))

    def equations(self, segments: Sequence[int], cols: Integers, y: Integers) -> NormalEquations:
        """Return the normal equations of columns (k,) over some segments, y (1,) the signal's column."""
        return NormalEquations.of(self.gram(segments, np.concatenate([cols, y])))

    def all_but(self, k: int) -> tuple[int, ...]:
        """Return all segments but one."""
        return tuple(j for j in self.everything if j != k)

    def raw(self, cols: Integers) -> Array:
        """Return columns (n, k) as they were before they were centred and scaled."""
        values = self.W[:, cols].copy()
        for r, rows in enumerate(self.evidence.slices):
            values[rows] += self.means[r, cols]
        return np.asarray(values * self.scale[cols])

    def within(self, inner: Integers, outer: Integers) -> bool:
        """Return True if columns are combinations of others."""
        if not len(inner):
            return True
        A, b = self.W[:, outer], self.W[:, inner]
        return bool(np.linalg.norm(b - A @ np.linalg.lstsq(A, b, rcond=1e-10)[0]) <= SAME * np.linalg.norm(b))

    def of_map(self, effects: Sequence[Effect]) -> Integers:
        """Return the columns (q,) of the map's curves at the temperatures that it sees."""
        if self.basis is None:
            return np.zeros(0, dtype=np.intp)
        acting = tuple(effect for effect in effects if effect.acts_on_input)
        if acting not in self._maps:
            curves = [self.basis.values(T) for T in map_inputs(self.evidence.chunks, acting)]
            self._maps[acting] = self._add(self.evidence.rows(curves))
        return self._maps[acting]

    def of(self, effect: Effect) -> EffectColumns:
        """Return the columns of an effect."""
        if effect not in self._effects:
            whole = self.evidence.rows([effect.signature(chunk, None)[0] for chunk in self.evidence.chunks])
            columns: list[Integers] = []
            places: list[Integers] = []
            for own in whole.swapaxes(0, 1):
                place = np.flatnonzero(np.any(own != 0, axis=0))
                if places and len(place) == len(places[0]) and np.array_equal(own[:, place], whole[:, 0][:, places[0]]):
                    columns.append(columns[0])
                else:
                    columns.append(self._add(own[:, place]))
                places.append(place)
            self._effects[effect] = EffectColumns(whole.shape[2], tuple(columns), tuple(places), self._starts(effect))
        return self._effects[effect]

    def _starts(self, effect: Effect) -> Integers | None:
        """Return a column for each recording: the response to a start of 1, row by row."""
        left = np.zeros((len(self.evidence), len(self.levels)))
        for r, (record, rows) in enumerate(zip(self.evidence.records, self.evidence.slices, strict=True)):
            factor, _ = effect.fading(record.chunk, None)
            if factor is None:
                return None
            left[rows, r] = record.rows(np.asarray(np.cumprod(factor), dtype=np.float64))
        return self._add(left, unit=False)

    def _add(self, values: Array, *, centred: bool = True, unit: bool = True) -> Integers:
        k = values.shape[1]
        while self._size + k > len(self._W):
            self._W = np.vstack([self._W, np.zeros_like(self._W)])
            self._means = np.vstack([self._means, np.zeros_like(self._means)])
            self._scale = np.concatenate([self._scale, np.ones_like(self._scale)])
        own = np.arange(self._size, self._size + k)
        centre = np.zeros((len(self.evidence.records), k))
        values = np.asarray(values, dtype=np.float64).copy()
        if centred:
            for r, rows in enumerate(self.evidence.slices):
                centre[r] = values[rows].mean(axis=0)
                values[rows] -= centre[r]
            size = np.sqrt(np.mean(values**2, axis=0))
            # what is left of a constant by rounding is nothing
            some = size > 1e-12 * np.max(np.abs(centre), axis=0, initial=0.0)
            values[:, ~some] = 0.0
            if unit:
                self._scale[own] = np.where(some, size, 1.0)
        self._W[own] = (values / self._scale[own]).T
        self._means[own] = (centre / self._scale[own]).T
        self._size += k
        return own

    def _complete(self) -> None:
        """Work out the inner products of columns that are new."""
        known, size = self._known, self._size
        if known == size:
            return
        gram = self._gram
        if size > gram.shape[1]:
            gram = np.zeros((len(self.segments), 2 * size, 2 * size))  # of what stays zero the system makes no pages
            gram[:, :known, :known] = self._gram[:, :known, :known]
        for s, segment in enumerate(self.segments):
            part, new = self._W[:known, segment.rows], self._W[known:size, segment.rows]
            gram[s, known:size, known:size] = new @ new.T  # half the work of any product: it is symmetric
            gram[s, :known, known:size] = both = part @ new.T
            gram[s, known:size, :known] = both.T
        self._gram, self._known = gram, size
        self._sums.clear()


def _segments(evidence: Evidence) -> tuple[RowSegment, ...]:
    count = PARTS if len(evidence.records) == 1 else HALVES
    segments = []
    for r, rows in enumerate(evidence.slices):
        cuts = np.linspace(rows.start, rows.stop, count + 1).round().astype(int)
        segments += [RowSegment(r, slice(int(a), int(b))) for a, b in pairwise(cuts) if b > a]
    return tuple(segments)
