"""Compiled loops of the long road: time-varying model, full covariance, one sample after the other.

Each has a readable twin in `fusion_core.reference`, to which the tests hold it. Arrays that are the same for every
sample have a leading axis of length 1.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fusion_core.chunk import Array
from fusion_core.model import Flags


@njit(cache=True)  # type: ignore[untyped-decorator]
def _predict(x: Array, P: Array, F: Array, Q: Array, u: Array, work: Array) -> None:
    """Do x = F x + u and P = F P F' + Q in place, on one triangle of P, mirrored."""
    n = len(x)
    for i in range(n):
        total = u[i]
        for j in range(n):
            total += F[i, j] * x[j]
        work[0, i] = total
    for i in range(n):
        x[i] = work[0, i]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += F[i, k] * P[k, j]
            work[i, j] = total
    for i in range(n):
        for j in range(i, n):
            total = Q[i, j]
            for k in range(n):
                total += work[i, k] * F[j, k]
            P[i, j] = total
            P[j, i] = total


@njit(cache=True)  # type: ignore[untyped-decorator]
def _measure_scalar(x: Array, P: Array, h: Array, r: float, y: float, p: Array) -> float:
    """Update x and P in place with one scalar innovation y; return its variance s.

    Joseph's form for a scalar, one rank at a time, on one triangle of P, mirrored::

        p = P h',  s = h p + r,  K = p / s
        B = P - K p',  P = B - (B h') K' + K r K'
    """
    n = len(x)
    s = r
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += P[i, j] * h[j]
        p[i] = total
        s += h[i] * total
    for i in range(n):
        K_i = p[i] / s
        x[i] += K_i * y
        q = 0.0
        for j in range(n):
            P[i, j] -= K_i * p[j]
            q += P[i, j] * h[j]
        surplus = (r * K_i - q) / s  # of row i: zero but for rounding
        for j in range(i, n):
            P[i, j] += surplus * p[j]
    for i in range(n):
        for j in range(i):
            P[i, j] = P[j, i]
    return s


@njit(cache=True)  # type: ignore[untyped-decorator]
def long_road(
    x: Array,
    P: Array,
    F: Array,
    Q: Array,
    u: Array,
    z: Array,
    H: Array,
    r: Array,
    used: Flags,
    gate: float,
    volatile: Flags,
    out_x: Array,
    out_sigma: Array,
    out_y: Array,
    out_white: Array,
    out_nis: Array,
    out_log_det: Array,
    out_P: Array,
) -> None:
    """Run the filter over N samples with scalar updates; x, P and used are changed in place."""
    N, m = z.shape
    n = len(x)
    work = np.empty((n, n))
    p = np.empty(n)
    x_new = np.empty(n)
    P_new = np.empty((n, n))
    for k in range(N):
        H_k, r_k = H[min(k, len(H) - 1)], r[min(k, len(r) - 1)]
        _predict(x, P, F[min(k, len(F) - 1)], Q[min(k, len(Q) - 1)], u[min(k, len(u) - 1)], work)
        x_new[:] = x
        P_new[:, :] = P
        nis = 0.0
        log_det = 0.0
        for i in range(m):
            y_prior = z[k, i]
            y = z[k, i]
            for j in range(n):
                y_prior -= H_k[i, j] * x[j]
                y -= H_k[i, j] * x_new[j]
            s = _measure_scalar(x_new, P_new, H_k[i], r_k[i], y, p)
            out_y[k, i] = y_prior
            out_white[k, i] = y / np.sqrt(s)
            nis += y * y / s
            log_det += np.log(s)
        used[k] = used[k] and nis <= gate
        if used[k]:
            x[:] = x_new
            P[:, :] = P_new
        else:
            for i in range(n):
                if volatile[i]:
                    x[i] = 0.0
                    P[i, :] = 0.0
                    P[:, i] = 0.0
        out_nis[k] = nis
        out_log_det[k] = log_det
        out_x[k] = x
        for i in range(n):
            out_sigma[k, i] = np.sqrt(P[i, i])
        if len(out_P):
            out_P[k] = P
