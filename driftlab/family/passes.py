"""What a bias does beside white noise and a walk, as passes through the same temperature tell it.

A real unit's slow noise is more than its fast walk lets expect: it lags, it wanders where the temperature does, and
after a warm night it is elsewhere. So the soak is cut into passes, each sweep of each recording, and a curve of its own
for each pass is held against one for all. By white noise and walk alone, what that gains is chi-square::

    G = Q(one curve) - Q(a curve each),    E G = n,    n the coefficients that this adds

Where G is more than chance, the walk to be reckoned with is the least at which G is n; white noise is told by
neighbouring rows, and stays. What no pass came back to, nobody has seen. d axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftlab.family.knots import Knots
from driftlab.family.soaked import Rows
from driftlab.family.whitening import whitened
from driftlab.samples.turning import directions, sweeps_of
from fusion_core.chunk import Array

TURN = 0.25  # of the range: a smaller way back is no turn
MOST = 8  # passes; where there are more, those that warm are one, and those that cool
CHANCE = 0.01  # probability with which white noise and walk alone are not believed
RANK = 1e-10  # of a column's own square: what is a combination of others
LARGEST = 1e3  # times the walk
CLOSE = 0.01  # of the walk: it is not looked for more closely


def walk_of_passes(recordings: Sequence[Rows], white: Array, walk: Array, step: float) -> Array:
    """Return the walk (d,) with which the passes of recordings agree: at least `walk` (d,), SI/sqrt(s)."""
    passes = _Passes(recordings, step)
    return np.array([passes.agreeing(axis, *noise) for axis, noise in enumerate(zip(white, walk, strict=True))])


class _Passes:
    """Recordings with a curve for each pass: columns (R, passes x q) of each."""

    def __init__(self, recordings: Sequence[Rows], step: float) -> None:
        self.recordings = recordings
        T = np.concatenate([rows.T for rows in recordings])
        knots = Knots.covering(float(T.min()), float(T.max()), step)
        turn = TURN * float(np.ptp(T))
        number = [sweeps_of(rows.T, turn) for rows in recordings]
        first = np.cumsum([0, *(int(own[-1]) + 1 for own in number)])
        which = [own + start for own, start in zip(number, first[:-1], strict=True)]
        if first[-1] > MOST:
            which = [(directions(rows.T, turn) < 0).astype(np.int64) for rows in recordings]
        self.count, self.q = int(max(own.max() for own in which)) + 1, knots.q
        self.columns = []
        for rows, own in zip(recordings, which, strict=True):
            B, places = knots.values(rows.T), np.eye(self.count)[own]
            self.columns.append(np.einsum("Rp,Rq->Rpq", places, B).reshape(len(B), -1))

    def agreeing(self, axis: int, white: float, walk: float) -> float:
        """Return the walk of an axis with which its passes agree."""
        from scipy.special import chdtri

        if self.count < 2 or not (white > 0 and walk > 0):
            return walk
        gain, n = self._gain(axis, white, walk)
        if n == 0 or gain <= float(chdtri(n, CHANCE)):
            return walk
        low, high = 0.0, np.log(LARGEST)
        while high - low > CLOSE:
            middle = (low + high) / 2
            gain, n = self._gain(axis, white, walk * float(np.exp(middle)))
            low, high = (middle, high) if gain > n else (low, middle)
        return walk * float(np.exp(high))

    def _gain(self, axis: int, white: float, walk: float) -> tuple[float, int]:
        """Return G, and the number of coefficients that a curve for each pass adds."""
        size = self.count * self.q
        N = np.zeros((size + 1, size + 1))
        for k, (rows, columns) in enumerate(zip(self.recordings, self.columns, strict=True)):
            noise, steps = rows.variances(white, walk, free=k > 0)
            X = whitened(np.column_stack([columns, rows.bias[:, axis]]), noise, steps)
            N += X.T @ X
        A, b = N[:size, :size], N[:size, size]
        each, rank = _taken(A, b)
        summed = A.reshape(self.count, self.q, self.count, self.q).sum(axis=(0, 2))
        common, least = _taken(summed, b.reshape(self.count, self.q).sum(axis=0))
        return each - common, rank - least


def _taken(A: Array, b: Array) -> tuple[float, int]:
    """Return b' A^-1 b and the rank of A."""
    scale = np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
    used = np.diag(A) > RANK * np.max(np.diag(A))
    own, V = np.linalg.eigh((A / np.outer(scale, scale))[np.ix_(used, used)])
    seen = own > RANK * own[-1]
    return float(np.sum((V[:, seen].T @ (b / scale)[used]) ** 2 / own[seen])), int(np.sum(seen))
