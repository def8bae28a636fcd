"""Knots of straight lines that follow a curve: as few as a given loss allows, in as few bytes.

There are as many knots as the smallest largest error (minimax) asks for to be within the loss; for a smooth curve it is
half the error of lines between points of the curve itself. Of all such lines they are those with the smallest mean
error. Both are linear programs. Where 16-bit integers and a scale for each axis are fine enough, the knots are those.
n knots, d axes, M places.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.contracts.realisation import Signal

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Single = NDArray[np.float32]
Curve = Callable[[Array], Array]

MOST = 1000  # knots
_BETWEEN = 12  # places an interval at which the error is looked at
_KEPT = 0.99  # of the loss: the rest is for the curve between those places, and for single precision
_RESOLVED = 0.1  # of the loss: the largest error of rounding to integers


@dataclass(frozen=True, eq=False)
class Table:
    """Straight lines between knots a fixed step apart; beyond the first and the last, their values.

    Attributes
    ----------
    of : Signal
        What is looked up.
    lowest, highest : float32
        Where the first and the last knot are.
    per_unit : float32
        Intervals to a unit of what is looked up.
    knots : (n, d) array of float32
    whole : bool
        Whether knots are whole numbers, and the bias offset + scale times the lines between them.
    offset, scale : (d,) array of float32
    """

    of: Signal
    lowest: np.float32
    highest: np.float32
    per_unit: np.float32
    knots: Single
    whole: bool
    offset: Single
    scale: Single

    @property
    def size(self) -> int:
        """Bytes of the constants."""
        return self.knots.size * 2 + 8 * self.knots.shape[1] if self.whole else self.knots.size * 4


def fewest(of: Signal, curve: Curve, domain: tuple[float, float], loss: Array, *, floats: bool) -> Table | None:
    """Return the table with the fewest knots that is off from the curve by at most `loss` (d,); None beyond MOST.

    `floats` asks for knots in single precision whatever their size.
    """
    lowest, highest = (np.float32(end) for end in domain)
    ends = curve(np.linspace(*domain, MOST))
    offset = ((ends.max(axis=0) + ends.min(axis=0)) / 2).astype(np.float32)
    # a knot is a place too, so it is off from the curve by no more than the loss: that much beyond the curve's ends
    scale = ((1.01 * np.ptp(ends, axis=0) / 2 + loss) / 32767).astype(np.float32)
    whole = not floats and bool(np.all(scale / 2 <= _RESOLVED * loss))
    most = _KEPT * loss - (scale / 2 if whole else 0.0)
    n = _count(curve, domain, most)
    if n is None:
        return None
    knots = np.stack([_knots(v, n, e) for v, e in zip(_values(curve, domain, n).T, most, strict=True)], axis=1)
    if whole:
        knots = np.round((knots - offset) / scale)
    per_unit = np.float32((n - 1) / (float(highest) - float(lowest)))
    return Table(of, lowest, highest, per_unit, knots.astype(np.float32), whole, offset, scale)


def _count(curve: Curve, domain: tuple[float, float], most: Array) -> int | None:
    """Return the smallest number of knots whose lines keep the error below `most` (d,)."""

    def keeps(n: int) -> bool:
        values = _values(curve, domain, n)
        return all(_minimax(own, n)[1] <= error for own, error in zip(values.T, most, strict=True))

    few, enough = 1, 2
    while not keeps(enough):
        if enough == MOST:
            return None
        few, enough = enough, min(2 * enough, MOST)
    while enough - few > 1:
        middle = (few + enough) // 2
        few, enough = (few, middle) if keeps(middle) else (middle, enough)
    return enough


def _values(curve: Curve, domain: tuple[float, float], n: int) -> Array:
    """Return the curve at each of the places (M, d) between n knots, ends included."""
    return curve(np.linspace(*domain, (n - 1) * _BETWEEN + 1))


def _lines(M: int, n: int) -> csr_matrix:
    """Return the matrix (M, n) that draws lines between n knots."""
    from scipy import sparse

    x, row = np.arange(M) / _BETWEEN, np.arange(M)
    k = np.minimum(x.astype(np.int64), n - 2)
    share = np.concatenate([1 - (x - k), x - k])
    return sparse.csr_matrix((share, (np.tile(row, 2), np.concatenate([k, k + 1]))), (M, n))


def _knots(values: Array, n: int, most: float) -> Array:
    """Return the knots (n,) with the smallest mean error from values (M,) of those with errors within `most`.

    Minimise t_1 + ... + t_M such that -t <= B c - values <= t and t <= most.
    """
    from scipy import sparse

    return _solved(values, n, sparse.identity(len(values)), most)[0]


def _minimax(values: Array, n: int) -> tuple[Array, float]:
    """Return the knots (n,) whose lines have the smallest largest error from values (M,), and that error.

    Minimise t such that -t <= B c - values <= t.
    """
    return _solved(values, n, np.ones((len(values), 1)), np.inf)


def _solved(values: Array, n: int, t: Any, most: float) -> tuple[Array, float]:
    """Return c (n,) and the sum of t of a linear program; t (M, k) says which of the k bounds each place has."""
    from scipy import sparse
    from scipy.optimize import linprog

    middle, scale = float(values[0]), float(np.ptp(values)) or 1.0
    B, t = _lines(len(values), n), sparse.csr_matrix(t)
    A = sparse.vstack([sparse.hstack([B, -t]), sparse.hstack([-B, -t])], format="csc")
    aim = (values - middle) / scale
    k = t.shape[1]
    found = linprog(
        np.concatenate([np.zeros(n), np.ones(k)]),
        A_ub=A,
        b_ub=np.concatenate([aim, -aim]),
        bounds=[(None, None)] * n + [(0.0, most / scale)] * k,
        method="highs",
    )
    if found.x is None or found.fun is None:  # `most` is what lines can keep: only by rounding of the solver
        return _minimax(values, n)
    return found.x[:n] * scale + middle, float(found.fun) * scale
