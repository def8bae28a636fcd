"""Compiled loops of the filter: one sample after the other, group by group (`fusion_core.groups`).

Each has a readable twin in `fusion_core.reference`, to which the tests hold it. Arrays that are the same for every
sample have a leading axis of length 1. A group's number of states and components comes as the length of a tuple:
the compiler then knows it and unrolls the loops over a group, which makes them two to three times as fast.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fusion_core.chunk import Array
from fusion_core.groups import Index
from fusion_core.model import Flags

Size = tuple[int, ...]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _predict(
    n: Size, g: int, x: Array, P: Array, F: Array, Q: Array, u: Array, at: tuple[int, int, int], states: Index,
    f: Array, work: Array,
) -> None:  # fmt: skip
    """Do x = F x + u and P = F P F' + Q for group g, in place, on one triangle of P, mirrored."""
    k_F, k_Q, k_u = at
    s = len(n)
    for i in range(s):
        total = u[k_u, states[g, i]]
        for j in range(s):
            f[i, j] = F[k_F, states[g, i], states[g, j]]
            total += f[i, j] * x[g, j]
        work[0, i] = total
    for i in range(s):
        x[g, i] = work[0, i]
    for i in range(s):
        for j in range(s):
            total = 0.0
            for k in range(s):
                total += f[i, k] * P[g, k, j]
            work[i, j] = total
    for i in range(s):
        for j in range(i, s):
            total = Q[k_Q, states[g, i], states[g, j]]
            for k in range(s):
                total += work[i, k] * f[j, k]
            P[g, i, j] = total
            P[g, j, i] = total


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _measure_scalar(n: Size, g: int, x: Array, P: Array, h: Array, r: float, z: float, p: Array) -> tuple[float, float]:
    """Update group g of x and P in place with one scalar z = h x + r; return its innovation and 1 / s.

    Joseph's form for a scalar, one rank at a time, on one triangle of P, mirrored::

        p = P h',  s = h p + r,  K = p / s
        B = P - K p',  P = B - (B h') K' + K r K'
    """
    m, y, s = len(n), z, r
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += P[g, i, j] * h[j]
        p[i] = total
        s += h[i] * total
        y -= h[i] * x[g, i]
    inverse = 1.0 / s
    for i in range(m):
        K_i = p[i] * inverse
        x[g, i] += K_i * y
        q = 0.0
        for j in range(m):
            q += (P[g, i, j] - K_i * p[j]) * h[j]
        surplus = (r * K_i - q) * inverse - K_i  # of row i: -K_i but for rounding
        for j in range(i, m):
            P[g, i, j] += surplus * p[j]
        for j in range(i):
            P[g, i, j] = P[g, j, i]
    return y, inverse


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def long_road(
    n: Size,
    c: Size,
    states: Index,
    rows: Index,
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
    """Run the filter over N samples with scalar updates; x (G, s), P (G, s, s) and used are changed in place."""
    G, s = x.shape
    f, work, h, p = np.empty((s, s)), np.empty((s, s)), np.empty(s), np.empty(s)
    x_new, P_new = np.empty((G, s)), np.empty((G, s, s))
    for k in range(len(z)):
        k_H, k_r = min(k, len(H) - 1), min(k, len(r) - 1)
        nis, log_det, det = 0.0, 0.0, 1.0
        for g in range(G):
            _predict(n, g, x, P, F, Q, u, (min(k, len(F) - 1), min(k, len(Q) - 1), min(k, len(u) - 1)), states, f, work)
            for i in range(len(n)):
                x_new[g, i] = x[g, i]
                for j in range(len(n)):
                    P_new[g, i, j] = P[g, i, j]
            for i in range(len(c)):
                row = rows[g, i]
                y_prior = z[k, row]
                for j in range(len(n)):
                    h[j] = H[k_H, row, states[g, j]]
                    y_prior -= h[j] * x[g, j]
                y, inverse = _measure_scalar(n, g, x_new, P_new, h, r[k_r, row], z[k, row], p)
                out_y[k, row] = y_prior
                white = y * np.sqrt(inverse)
                out_white[k, row] = white
                nis += white * white
                det *= inverse
                if not 1e-200 < det < 1e200:  # one logarithm for many components
                    log_det, det = log_det - np.log(det), 1.0
        used[k] = used[k] and nis <= gate
        for g in range(G):
            for i in range(len(n)):
                if used[k]:
                    x[g, i] = x_new[g, i]
                    for j in range(len(n)):
                        P[g, i, j] = P_new[g, i, j]
                elif volatile[states[g, i]]:
                    x[g, i] = 0.0
                    for j in range(len(n)):
                        P[g, i, j] = P[g, j, i] = 0.0
            for i in range(len(n)):
                out_x[k, states[g, i]] = x[g, i]
                out_sigma[k, states[g, i]] = np.sqrt(P[g, i, i])
                if len(out_P):
                    for j in range(len(n)):
                        out_P[k, states[g, i], states[g, j]] = P[g, i, j]
        out_nis[k] = nis
        out_log_det[k] = log_det - np.log(det)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def short_road(
    n: Size,
    c: Size,
    states: Index,
    rows: Index,
    x: Array,
    F: Array,
    H: Array,
    K: Array,
    whitener: Array,
    u: Array,
    z: Array,
    out_x: Array,
    out_y: Array,
    out_white: Array,
    out_nis: Array,
) -> None:
    """Run the filter over N samples with steady gains: x (G, s) is changed in place.

    F (G, s, s), H (G, c, s), K (G, s, c), and `whitener` (G, c, c), the inverse of the Cholesky factor of S.
    """
    G, s = x.shape
    x_new, y = np.empty(s), np.empty(max(1, rows.shape[1]))
    for k in range(len(z)):
        u_k = u[min(k, len(u) - 1)]
        nis = 0.0
        for g in range(G):
            for i in range(len(n)):
                total = u_k[states[g, i]]
                for j in range(len(n)):
                    total += F[g, i, j] * x[g, j]
                x_new[i] = total
            for i in range(len(c)):
                total = z[k, rows[g, i]]
                for j in range(len(n)):
                    total -= H[g, i, j] * x_new[j]
                y[i] = total
                out_y[k, rows[g, i]] = total
            for i in range(len(c)):
                total = 0.0
                for j in range(i + 1):
                    total += whitener[g, i, j] * y[j]
                out_white[k, rows[g, i]] = total
                nis += total * total
            for i in range(len(n)):
                total = x_new[i]
                for j in range(len(c)):
                    total += K[g, i, j] * y[j]
                x[g, i] = total
                out_x[k, states[g, i]] = total
        out_nis[k] = nis


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def drift(x: Array, F: Array, u: Array) -> Array:
    """Return x_k = F_k x_{k-1} + u_k (N, n): what is expected with no measurement."""
    N, n = len(u), len(x)
    out = np.empty((N, n))
    for k in range(N):
        F_k = F[min(k, len(F) - 1)]
        before = x if k == 0 else out[k - 1]
        for i in range(n):
            total = u[k, i]
            for j in range(n):
                total += F_k[i, j] * before[j]
            out[k, i] = total
    return out
