"""Normal equations of least squares, as inner products of columns over some rows.

::

    A x = b,    A = Z'Z + ridge,    b = Z'y,    what is left = y'y - b'x

Those of several sets of rows add up; a choice of columns is a choice of rows and columns of A; columns that stay are
taken out by the Schur complement. k columns; where a matrix G (k + 1, k + 1) is given, its last column is y's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from fusion_core.chunk import Array
from fusion_core.fast import compiled

Indices = NDArray[np.intp]

TINY = 1e-9  # ridge, of the mean square of a column: what the rows do not determine stays small


@dataclass(frozen=True)
class NormalEquations:
    """Symmetric, non-negative normal equations.

    Attributes
    ----------
    A : (k, k) array
        Inner products of the columns, ridges added.
    b : (k,) array
        Theirs with the signal.
    yy : float
        The signal's sum of squares.
    """

    A: Array
    b: Array
    yy: float

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

    def restricted(self, keep: Indices | NDArray[np.bool_]) -> NormalEquations:
        """Return those of some columns, the coefficients of the others being 0."""
        return NormalEquations(self.A[np.ix_(keep, keep)], self.b[keep], self.yy)

    def given(self, theta: Array) -> NormalEquations:
        """Return those of the first columns where the coefficients of the last (p,) are given."""
        j = len(self.b) - len(theta)
        yy = self.yy - 2 * float(self.b[j:] @ theta) + float(theta @ self.A[j:, j:] @ theta)
        return NormalEquations(self.A[:j, :j], self.b[:j] - self.A[:j, j:] @ theta, yy)

    def solve(self, b: Array) -> Array:
        """Return x (k,) or (k, p) of A x = b; what A does not determine is nearly zero."""
        diagonal = np.diag_indices(len(self.A))
        tiny = TINY * max(float(np.mean(self.A[diagonal])), 1e-300) if len(self.A) else 0.0
        while True:
            A = self.A.copy()
            A[diagonal] += tiny
            try:
                return np.asarray(cho_solve(cho_factor(A, check_finite=False), b, check_finite=False))
            except LinAlgError:  # rounding made it indefinite
                tiny *= 100

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

    def take_out(self, G: Array, cols: Indices) -> Array:
        """Return the Schur complement of inner products G (K, K): the columns `cols`, which are these, taken out."""
        return np.asarray(G - G[:, cols] @ self.solve(G[cols]))


def free_starts(
    equations: NormalEquations, first: int, starts: Sequence[Indices], rows: int, colour: float
) -> tuple[Array, float]:
    """Return the deviation of the starts of each term beyond what noise makes of them, and the noise's density S.

    Columns are those of the starts from `first` on.
    """
    A = equations.A.copy()
    A[np.diag_indices(len(A))] += TINY * max(float(np.mean(np.diag(A))), 1e-300)
    inverse = np.linalg.inv(A)
    beta = inverse @ equations.b
    yy = equations.yy
    slow = colour * max(yy - float(equations.b @ beta), 1e-12 * yy, 1e-300) / rows
    sd, at = np.zeros(len(starts)), first
    for k, own in enumerate(starts):
        part = np.arange(at, at + len(own))
        at += len(own)
        if len(own):
            sd[k] = np.sqrt(max(float(np.mean(beta[part] ** 2 - slow * inverse[part, part])), 0.0))
    return sd, slow


@compiled
def left_with_starts(R: Array, y: int, cols: Indices, sizes: Indices, rows: int, colour: float) -> float:
    """Return the sum of squares that columns leave, the last of them starts of terms (`sizes` each), ridge added.

    R (K, K) holds inner products of all columns, y the signal's place. As `free_starts` and `NormalEquations.left`,
    compiled: it is asked for tens of thousands of times.
    """
    k, yy = len(cols), R[y, y]
    A, b = np.empty((k, k)), np.empty(k)
    for i in range(k):
        b[i] = R[cols[i], y]
        for j in range(k):
            A[i, j] = R[cols[i], cols[j]]
    level = np.trace(A) / max(k, 1)
    if k == 0 or level <= 0:
        return float(yy)
    for i in range(k):
        A[i, i] += TINY * level
    if np.sum(sizes) > 0:
        inverse = np.linalg.inv(A)
        beta = inverse @ b
        slow = colour * max(yy - b @ beta, 1e-12 * yy, 1e-300) / rows
        at = k - np.sum(sizes)
        for size in sizes:
            sd2 = 0.0
            for i in range(at, at + size):
                sd2 += (beta[i] ** 2 - slow * inverse[i, i]) / size
            for i in range(at, at + size):
                if sd2 > 0:
                    A[i, i] += slow / sd2
                else:  # it starts at equilibrium: out of the model
                    A[i, :] = 0.0
                    A[:, i] = 0.0
                    A[i, i], b[i] = level, 0.0
            at += size
    return float(yy - b @ np.linalg.solve(A, b))
