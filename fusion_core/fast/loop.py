"""Compiled loops of the filter: one sample after the other, group by group (`fusion_core.fast.groups`).

Each has a readable twin in `fusion_core.reference`, to which the tests hold it. States and components are in group
order: G groups of s states and c components, state i of group g is column i G + g. Arrays that are the same for every
sample have a leading axis of length 1. The numbers s, c and G come as lengths of tuples: the compiler then knows them
and unrolls the loops over a group, which makes them two to three times as fast.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.cpython.unsafe.tuple import tuple_setitem

from fusion_core.chunk import Array
from fusion_core.model import Flags

Size = tuple[float, ...]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def predict(
    n: Size, d: Size, g: int, x: Array, P: Array, F: Array, Q: Array, u: Array, x_new: Array, P_new: Array, f: Array,
    w: Array,
) -> None:  # fmt: skip
    """Do x_new = F x + u and P_new = F P F' + Q for group g, on one triangle of P, mirrored; f, w (s,) are scratch."""
    G = len(d)
    for i in range(len(n)):
        total = u[i * G + g]
        for j in range(len(n)):
            f[j] = F[i * G + g, j * G + g]
            total += f[j] * x[g, j]
        x_new[g, i] = total
        for j in range(len(n)):
            total = 0.0
            for k in range(len(n)):
                total += f[k] * P[g, k, j]
            w[j] = total
        for j in range(i + 1):
            total = Q[i * G + g, j * G + g]
            for k in range(len(n)):
                total += w[k] * F[j * G + g, k * G + g]
            P_new[g, i, j] = total
            P_new[g, j, i] = total


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def measure(n: Size, g: int, x: Array, P: Array, h: Array, r: float, z: float, p: Array) -> tuple[float, float]:
    """Update group g of x and P in place with one scalar z = h x + r; return its innovation and 1 / s.

    Joseph's form for a scalar, one rank at a time, on one triangle of P, mirrored::

        p = P h',  s = h p + r,  K = p / s
        B = P - K p',  P = B - (B h') K' + K r K'

    p (s,) is left behind.
    """
    y, s = z, r
    for i in range(len(n)):
        total = 0.0
        for j in range(len(n)):
            total += P[g, i, j] * h[j]
        p[i] = total
        s += h[i] * total
        y -= h[i] * x[g, i]
    inverse = 1.0 / s
    for i in range(len(n)):
        K_i = p[i] * inverse
        x[g, i] += K_i * y
        q = 0.0
        for j in range(len(n)):
            q += (P[g, i, j] - K_i * p[j]) * h[j]
        surplus = (r * K_i - q) * inverse - K_i  # of row i: -K_i but for rounding
        for j in range(i, len(n)):
            P[g, i, j] += surplus * p[j]
        for j in range(i):
            P[g, i, j] = P[g, j, i]
    return y, inverse


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def recursive(
    n: Size,
    c: Size,
    d: Size,
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
    reset: Flags,
    out_x: Array,
    out_sigma: Array,
    out_y: Array,
    out_white: Array,
    out_nis: Array,
    out_log_det: Array,
    out_P: Array,
) -> tuple[Array, Array]:
    """Run the filter over N samples with scalar updates; return x (G, s) and P (G, s, s).

    `used` is changed in place: false where the gate refuses.
    """
    G, s = len(d), len(n)
    f, w, h, p, before = np.empty(s), np.empty(s), np.empty(s), np.empty(s), np.empty(s)
    x, P = x.copy(), P.copy()
    x_new, P_new = np.empty((G, s)), np.empty((G, s, s))
    for k in range(len(z)):
        F_k, Q_k, u_k = F[min(k, len(F) - 1)], Q[min(k, len(Q) - 1)], u[min(k, len(u) - 1)]
        H_k, r_k = H[min(k, len(H) - 1)], r[min(k, len(r) - 1)]
        nis, log_det, det = 0.0, 0.0, 1.0
        for g in range(G):
            predict(n, d, g, x, P, F_k, Q_k, u_k, x_new, P_new, f, w)
            for i in range(len(n)):
                before[i] = x_new[g, i]
            for i in range(len(c)):
                row = i * G + g
                innovation = z[k, row]
                for j in range(len(n)):
                    h[j] = H_k[row, j * G + g]
                    innovation -= h[j] * before[j]
                y, inverse = measure(n, g, x_new, P_new, h, r_k[row], z[k, row], p)
                out_y[k, row] = innovation
                white = y * np.sqrt(inverse)
                out_white[k, row] = white
                nis += white * white
                det *= inverse
                if not 1e-200 < det < 1e200:  # one logarithm for many components
                    log_det, det = log_det - np.log(det), 1.0
        used[k] = used[k] and nis <= gate
        if not used[k]:
            for g in range(G):
                predict(n, d, g, x, P, F_k, Q_k, u_k, x_new, P_new, f, w)
                for i in range(len(n)):
                    if reset[i * G + g]:
                        x_new[g, i] = 0.0
                        for j in range(len(n)):
                            P_new[g, i, j] = P_new[g, j, i] = 0.0
        x, x_new = x_new, x
        P, P_new = P_new, P
        for g in range(G):
            for i in range(len(n)):
                out_x[k, i * G + g] = x[g, i]
                out_sigma[k, i * G + g] = np.sqrt(P[g, i, i])
        if len(out_P):
            out_P[k] = P
        out_nis[k] = nis
        out_log_det[k] = log_det - np.log(det)
    return x, P


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def gains(
    n: Size,
    c: Size,
    d: Size,
    P: Array,
    F: Array,
    Q: Array,
    H: Array,
    r: Array,
    out_P: Array,
    out_K: Array,
    out_root: Array,
    out_log_det: Array,
) -> None:
    """Run the covariance alone over N steps of an invariant model, from P (D, s, s) of D groups.

    out_P (N, D, s, s), out_K (N, D, c, s) with the gain of each scalar update, out_root (N, D, c) with one over the
    deviation of its innovation, and out_log_det (N, D).
    """
    D, s = len(d), len(n)
    f, w, h, p = np.empty(s), np.empty(s), np.empty(s), np.empty(s)
    x, u = np.zeros((D, s)), np.zeros(D * s)
    for k in range(len(out_P)):
        for g in range(D):
            predict(n, d, g, x, P if k == 0 else out_P[k - 1], F, Q, u, x, out_P[k], f, w)
            log_det, det = 0.0, 1.0
            for i in range(len(c)):
                row = i * D + g
                for j in range(len(n)):
                    h[j] = H[row, j * D + g]
                inverse = measure(n, g, x, out_P[k], h, r[row], 0.0, p)[1]
                for j in range(len(n)):
                    out_K[k, g, i, j] = p[j] * inverse
                out_root[k, g, i] = np.sqrt(inverse)
                det *= inverse
                if not 1e-200 < det < 1e200:
                    log_det, det = log_det - np.log(det), 1.0
            out_log_det[k, g] = log_det - np.log(det)


# tuples in place of small arrays: what a group's step needs then stays in registers, 19 ns a step and not 27
@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def steady(
    n: Size,
    c: Size,
    d: Size,
    x: Array,
    F: Array,
    H: Array,
    kind: tuple[int, ...],
    K: Array,
    root: Array,
    u: Array,
    z: Array,
    out_x: Array,
    out_y: Array,
    out_white: Array,
    out_nis: Array,
) -> None:
    """Run the filter over N samples with gains that are known: x (G, s) is changed in place.

    F (G, s, s), H (G, c, s); `kind` (G,) of each group, and K (N or 1, D, c, s), `root` (N or 1, D, c) of the kinds.
    """
    G = len(d)
    for k in range(len(z)):
        k_u, k_K = min(k, len(u) - 1), min(k, len(K) - 1)
        nis = 0.0
        for g in range(G):
            before = n
            for i in range(len(n)):
                total = u[k_u, i * G + g]
                for j in range(len(n)):
                    total += F[g, i, j] * x[g, j]
                before = tuple_setitem(before, i, total)
            after = before
            for i in range(len(c)):
                innovation = y = z[k, i * G + g]
                for j in range(len(n)):
                    innovation -= H[g, i, j] * before[j]
                    y -= H[g, i, j] * after[j]
                white = y * root[k_K, kind[g], i]
                out_y[k, i * G + g] = innovation
                out_white[k, i * G + g] = white
                nis += white * white
                for j in range(len(n)):
                    after = tuple_setitem(after, j, after[j] + K[k_K, kind[g], i, j] * y)
            for i in range(len(n)):
                x[g, i] = after[i]
                out_x[k, i * G + g] = after[i]
        out_nis[k] = nis


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def fleet(
    n: Size,
    c: Size,
    d: Size,
    x: Array,
    F: Array,
    H: Array,
    kind: tuple[int, ...],
    K: Array,
    shared: Array,
    own: Array,
    z: Array,
    step: int,
    every: int,
    out: Array,
    first: int,
) -> None:
    """Run steady gains over N samples of U units for each `step`-th group from `first` on; x (s G, U) in place.

    Units are the last axis and the innermost loop, where several go through one instruction. z (N, c G, U); drifts
    `shared` (s G,), and `own` (N, s G, U) or of length 0; `out` (N / every, s G, U) is x after every so many samples.
    """
    G, U = len(d), z.shape[2]
    for k in range(len(z)):
        k_K = min(k, len(K) - 1)
        for g in range(G):
            if g % step != first:
                continue
            K_g = K[k_K, kind[g]]  # outside of the lanes' loop, or they would not go through it together
            for v in range(U):
                after = n
                for i in range(len(n)):
                    total = shared[i * G + g]
                    if len(own) > 0:
                        total += own[k, i * G + g, v]
                    for j in range(len(n)):
                        total += F[g, i, j] * x[j * G + g, v]
                    after = tuple_setitem(after, i, total)
                for i in range(len(c)):
                    y = z[k, i * G + g, v]
                    for j in range(len(n)):
                        y -= H[g, i, j] * after[j]
                    for j in range(len(n)):
                        after = tuple_setitem(after, j, after[j] + K_g[i, j] * y)
                for i in range(len(n)):
                    x[i * G + g, v] = after[i]
            if (k + 1) % every == 0:
                for i in range(len(n)):
                    out[k // every, i * G + g] = x[i * G + g]


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
