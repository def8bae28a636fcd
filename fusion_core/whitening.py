"""The innovations of one filter for many signals at once.

The filter is linear, and its gain does not depend on the data: what a signal in the data does to the innovations is the
same filter run on the signal alone (A. S. Willsky and H. L. Jones, IEEE Trans. Automatic Control 21 (1976) 108). So one
recursion of P serves a recording and any number of signals, and divided by the square root of S the innovations of a
right model are white with unit variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion_core.chunk import Array


@dataclass(frozen=True)
class ScalarFilter:
    """A filter with n states and one measured component, over N steps.

    Attributes
    ----------
    F : (N, n, n) array
        Transition.
    Q, walk : (N, n, n) arrays
        Noise covariance, in a part that stays and a part that is scaled.
    b : (N, n) array
        How a signal enters the state.
    h, r : (n,) array and float
        Measurement row and variance.
    P : (n, n) array
        Covariance before the first step, and again before each step of `fresh`.
    fresh : (N,) array of bool
        Where the filter starts anew.
    """

    F: Array
    Q: Array
    walk: Array
    b: Array
    h: Array
    r: float
    P: Array
    fresh: NDArray[np.bool_]

    def whiten(self, signals: Array, scale: float) -> tuple[Array, Array]:
        """Return the signals' innovations (N, M) over sqrt(S), and log S (N,), with `scale` on the walk's part of Q."""
        Q = self.Q + scale * self.walk
        white = np.empty_like(signals)
        S = np.empty(len(signals))
        _whiten(self.F, Q, self.b, self.h, self.r, self.P, self.fresh, np.ascontiguousarray(signals), white, S)
        return white, np.log(S)


_SLAB = 32  # signals that share one recursion of P


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _whiten(
    F: Array, Q: Array, b: Array, h: Array, r: float, P_0: Array, fresh: Array, signals: Array, white: Array, S: Array
) -> None:
    N, M = signals.shape
    n = len(h)
    slabs = (M + _SLAB - 1) // _SLAB
    for slab in range(slabs):
        first, last = slab * _SLAB, min(M, (slab + 1) * _SLAB)
        width = last - first
        x, moved, y = np.zeros((n, width)), np.zeros((n, width)), np.zeros(width)
        P, FP, Ph = P_0.copy(), np.zeros((n, n)), np.zeros(n)
        for k in range(N):
            if fresh[k]:
                x[:] = 0.0
                P[:] = P_0
            for i in range(n):
                for j in range(n):
                    FP[i, j] = 0.0
                    for m in range(n):
                        FP[i, j] += F[k, i, m] * P[m, j]
            for i in range(n):
                for j in range(i + 1):
                    value = Q[k, i, j]
                    for m in range(n):
                        value += FP[i, m] * F[k, j, m]
                    P[i, j] = value
                    P[j, i] = value
            s = r
            for i in range(n):
                Ph[i] = 0.0
                for j in range(n):
                    Ph[i] += P[i, j] * h[j]
                s += h[i] * Ph[i]
            scale = 1.0 / np.sqrt(s)
            y[:] = 0.0
            for i in range(n):
                for c in range(width):
                    moved[i, c] = b[k, i] * signals[k, first + c]
                for j in range(n):
                    f = F[k, i, j]
                    if f != 0.0:
                        for c in range(width):
                            moved[i, c] += f * x[j, c]
                if h[i] != 0.0:
                    for c in range(width):
                        y[c] += h[i] * moved[i, c]
            for c in range(width):
                white[k, first + c] = y[c] * scale
            for i in range(n):
                gain = Ph[i] / s
                for c in range(width):
                    x[i, c] = moved[i, c] - gain * y[c]
                for j in range(n):
                    P[i, j] -= Ph[i] * Ph[j] / s
            if slab == 0:
                S[k] = s
