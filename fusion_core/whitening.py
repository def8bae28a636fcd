"""The innovations of one filter for many signals at once.

The filter is linear, and its gain does not depend on the data: what a signal in the data does to the innovations is the
same filter run on the signal alone (A. S. Willsky and H. L. Jones, IEEE Trans. Automatic Control 21 (1976) 108). So one
recursion of P serves a recording and any number of signals, and divided by the square root of S the innovations of a
right model are white with unit variance.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import njit
from numba.cpython.unsafe.tuple import tuple_setitem

from fusion_core.chunk import Array
from fusion_core.kernels import Size, measure, predict
from fusion_core.model import Flags


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
    fresh: Flags

    def same_as(self, other: ScalarFilter) -> bool:
        """Return whether the other filter has the same model."""
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    def at(self, scale: float) -> Whitening:
        """Return the filter with its gains, with `scale` on the walk's part of Q."""
        n, Q = (0.0,) * len(self.h), self.Q + scale * self.walk
        return Whitening(self, *_gains(n, self.F, Q, self.h, self.r, self.P, self.fresh))


@dataclass(frozen=True)
class Whitening:
    """What a filter makes of any signal, once its gains are known.

    Attributes
    ----------
    model : ScalarFilter
    K : (N, n) array
        Gain of each step.
    root : (N,) array
        One over the deviation of each innovation.
    """

    model: ScalarFilter
    K: Array
    root: Array

    @property
    def log_S(self) -> Array:
        """Logarithm of the variance of each innovation (N,)."""
        return np.asarray(-2 * np.log(self.root))

    def __call__(self, signals: Array) -> Array:
        """Return the innovations of signals (N, M) over their deviation, (N, M)."""
        model, white, n = self.model, np.empty(signals.shape), (0.0,) * len(self.model.h)
        signals = np.ascontiguousarray(signals)
        _innovations(n, model.F, model.b, model.h, self.K, self.root, model.fresh, signals, white)
        return white


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _gains(n: Size, F: Array, Q: Array, h: Array, r: float, P_0: Array, fresh: Flags) -> tuple[Array, Array]:
    """Return the gain (N, n) of each step, and one over the deviation (N,) of its innovation."""
    N, s = len(F), len(n)
    K, root = np.empty((N, s)), np.empty(N)
    P, P_new, x, u = P_0.reshape(1, s, s).copy(), np.empty((1, s, s)), np.zeros((1, s)), np.zeros(s)
    f, w, p = np.empty(s), np.empty(s), np.empty(s)
    for k in range(N):
        if fresh[k]:
            P[0] = P_0
        predict(n, (0.0,), 0, x, P, F[k], Q[k], u, x, P_new, f, w)
        _, inverse = measure(n, 0, x, P_new, h, r, 0.0, p)
        for i in range(len(n)):
            K[k, i] = p[i] * inverse
        root[k] = np.sqrt(inverse)
        P, P_new = P_new, P
    return K, root


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _innovations(
    n: Size, F: Array, b: Array, h: Array, K: Array, root: Array, fresh: Flags, signals: Array, white: Array
) -> None:
    N, M = signals.shape
    x = np.zeros((len(n), M))
    for k in range(N):
        if fresh[k]:
            x[:] = 0.0
        given, found = signals[k], white[k]  # outside of the lanes' loop, or they would not go through it together
        for v in range(M):
            moved, y = n, 0.0
            for i in range(len(n)):
                total = b[k, i] * given[v]
                for j in range(len(n)):
                    total += F[k, i, j] * x[j, v]
                y += h[i] * total
                moved = tuple_setitem(moved, i, total)
            found[v] = y * root[k]
            for i in range(len(n)):
                x[i, v] = moved[i] - K[k, i] * y
