"""The compiled loops of the rate estimators: a straight line through the recent past, and a differentiator."""

from __future__ import annotations

import numpy as np
from numba import njit

from fusion_core.chunk import Array


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def regression(dt: Array, T: Array, memory: Array, tau: float) -> tuple[Array, Array, Array]:
    """Return values (N,), their rates (N,) and the memory of a straight line whose weights fade by tau s."""
    # weighted sums with time counted from the current sample and temperature from the first one
    T_0, w, wt, wtt, wT, wtT, pull = memory
    smooth, rate = np.empty(len(T)), np.empty(len(T))
    for k in range(len(T)):
        wtt += dt[k] * (dt[k] * w - 2 * wt)
        wt -= dt[k] * w
        wtT -= dt[k] * wT
        keep = np.exp(-dt[k] / tau)
        w, wt, wtt, wT, wtT, pull = keep * w + 1, keep * wt, keep * wtt, keep * wT + T[k] - T_0, keep * wtT, keep * pull
        spread = wtt - wt * wt / w + pull
        rate[k] = (wtT - wt * wT / w) / spread if spread > 1e-9 * tau * tau else 0.0
        smooth[k] = T_0 + (wT - rate[k] * wt) / w
    return smooth, rate, np.array([T_0, w, wt, wtt, wT, wtT, pull])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def kalman(dt: Array, T: Array, memory: Array, r: float, q: float) -> tuple[Array, Array, Array]:
    """Return values (N,), their rates (N,) and the memory of a two-state filter with variances r and q dt."""
    x, v, xx, xv, vv = memory
    smooth, rate = np.empty(len(T)), np.empty(len(T))
    for k in range(len(T)):
        h = dt[k]
        x += h * v
        xx += h * (2 * xv + h * vv) + q * h**3 / 3
        xv += h * vv + q * h**2 / 2
        vv += q * h
        s = xx + r
        y = T[k] - x
        x += xx / s * y
        v += xv / s * y
        vv -= xv * xv / s
        xv -= xv * xx / s
        xx -= xx * xx / s
        smooth[k], rate[k] = x, v
    return smooth, rate, np.array([x, v, xx, xv, vv])
