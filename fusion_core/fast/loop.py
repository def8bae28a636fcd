"""The compiled recursion: one sample after the other, group by group (`fusion_core.fast.groups`).

Its readable twin is `fusion_core.kalman.estimate(..., method="plain")`. What a group works on is gathered by its lists
of places, so that `predict` and `correct` are the textbook's, for s states that depend on nothing else. The numbers s
and c come as lengths of tuples: the compiler then knows them and unrolls the loops, which are two to three times as
fast. What is compiled together stands in one file: the compiler keeps its results file by file. And few views, no
further parts in `recursive`: past a size the compiler no longer drops its count of references, at three times the time.
Nor are arrays made there: that takes an eighth of the time to compile it.

Where P is far wider than R, what is measured would be lost in its rounding, whatever the form of the update: such a
sample is given up, and done by `fusion_core.fast.factored`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array, Flags
from fusion_core.fast import compiled, inlined
from fusion_core.fast.groups import Size

Index = NDArray[np.uint64]  # unsigned: no index counts from the end, which would cost a comparison each


class Places(NamedTuple):
    """The places of the groups' states and components in the model, and their number in a group.

    A place that is filled up, because groups differ in size, is n for a state and m for a component.
    """

    states: Index  # (G, s)
    rows: Index  # (G, c)
    s: Size
    c: Size
    gains: Size  # of length 0 where gains are not written down: the compiler then leaves that out


class Model(NamedTuple):
    """`Transition` and `Measurement` with R diagonal; K is N, or 1 for what is the same at every sample."""

    F: Array  # (K, n, n)
    Q: Array  # (K, n, n)
    u: Array  # (K, n)
    H: Array  # (K, m, n)
    r: Array  # (K, m)


class Data(NamedTuple):
    """The measured values, and the rules by which they are not taken."""

    z: Array  # (N, m)
    used: Flags  # (N, m)
    gates: Array  # (m + 1,) largest nis by the number of components that were measured
    reset: Flags  # (n,)


Pair = tuple[Array, Array]


class SampleStep(NamedTuple):
    """The step to a sample and its measurement, group by group."""

    F: Array  # (G, s, s)
    F_t: Array  # (G, s, s) transposed
    Q: Array  # (G, s, s)
    H: Array  # (G, c, s)
    u: Array  # (G, s)
    x: Array  # (s,) predicted, of one group
    w: Array  # (s,) scratch
    q: Array  # (s,) scratch


class InnovationSums(NamedTuple):
    """Sums over the innovations of one sample."""

    nis: float
    log_det: float
    inverse: float  # of the determinants that log_det does not have yet: one logarithm for many components
    dof: int


class SampleArrays(NamedTuple):
    """The results of each sample, as in `Estimates`; P is (N, G, s, s), or of length 0."""

    x: Array
    sigma: Array
    y: Array
    white: Array
    nis: Array
    log_det: Array
    used: Flags  # (N,)
    P: Array
    K: Array  # (N, G, c, s) gain of each scalar update, or of length 0
    root: Array  # (N, G, c) one over the deviation of its innovation; 0 where nothing was measured


Four = tuple[float, float, float, float]
WIDE = 1e12  # of variances over R: beyond it the fourth digit of what was measured is lost in the rounding of P


@compiled
def uneven(Q: Array) -> bool:
    """Return True if a matrix has a variance below zero or is not symmetric by more than rounding."""
    for i in range(len(Q)):
        if not Q[i, i] >= 0:
            return True
        for j in range(i):
            apart = abs(Q[i, j] - Q[j, i])
            if apart != 0 and not apart <= 1e-9 * np.sqrt(Q[i, i]) * np.sqrt(Q[j, j]):
                return True
    return False


@inlined
def gather(places: Places, g: int, model: Model, k: int, step: SampleStep) -> bool:
    """Take of group g what leads to sample k and is measured there: once only, what is the same for every sample.

    Return whether Q is symmetric to the last bit.
    """
    symmetric = True
    n, m = np.uint64(model.H.shape[2]), np.uint64(model.H.shape[1])
    states, rows = places.states[g], places.rows[g]
    for i in range(len(places.s)):
        if states[i] < n:
            step.u[g, i] = model.u[min(k, len(model.u) - 1), states[i]]
    F_anew, Q_anew = k == 0 or len(model.F) > 1, k == 0 or len(model.Q) > 1
    if F_anew or Q_anew:
        for i in range(len(places.s)):
            for j in range(len(places.s)):
                if F_anew and states[i] < n and states[j] < n:
                    step.F[g, i, j] = step.F_t[g, j, i] = model.F[k, states[i], states[j]]
                if Q_anew and j <= i and states[i] < n and states[j] < n:
                    step.Q[g, i, j] = model.Q[k, states[i], states[j]]
                    symmetric &= step.Q[g, i, j] == model.Q[k, states[j], states[i]]
    if k == 0 or len(model.H) > 1:
        for i in range(len(places.c)):
            for j in range(len(places.s)):
                if rows[i] < m and states[j] < n:
                    step.H[g, i, j] = model.H[k, rows[i], states[j]]
    return symmetric


@inlined
def four_sums(s: Size, a: Array, B: Array, j: int, sums: Four) -> Four:
    """Return four sums with the products of a (s,) and columns j to j + 3 of B (s, s) added, in the states' order.

    None waits for another, and a processor does them as one.
    """
    a_0, a_1, a_2, a_3 = sums
    for k in range(len(s)):
        f = a[k]
        a_0, a_1 = a_0 + f * B[k, j], a_1 + f * B[k, j + 1]
        a_2, a_3 = a_2 + f * B[k, j + 2], a_3 + f * B[k, j + 3]
    return a_0, a_1, a_2, a_3


@inlined
def predict(
    s: Size, x: Array, P: Array, F: Array, F_t: Array, Q: Array, u: Array, x_new: Array, P_new: Array, w: Array,
    fours: bool | None,
) -> None:  # fmt: skip
    """Do x_new = F x + u and P_new = F P F' + Q, on one triangle of P, mirrored; F_t is F', which only `fours` need."""
    for i in range(len(s)):
        total, row, done = u[i], F[i], 0
        for j in range(len(s)):
            total += row[j] * x[j]
        x_new[i] = total
        if fours is not None:
            done = len(s) // 4 * 4
            for j in range(0, done, 4):
                w[j], w[j + 1], w[j + 2], w[j + 3] = four_sums(s, row, P, j, (0.0, 0.0, 0.0, 0.0))
        for j in range(done, len(s)):
            total = 0.0
            for k in range(len(s)):
                total += row[k] * P[k, j]
            w[j] = total
        if fours is not None:
            done = (i + 1) // 4 * 4
            for j in range(0, done, 4):
                sums = four_sums(s, w, F_t, j, (Q[i, j], Q[i, j + 1], Q[i, j + 2], Q[i, j + 3]))
                P_new[i, j], P_new[i, j + 1], P_new[i, j + 2], P_new[i, j + 3] = sums
                P_new[j, i], P_new[j + 1, i], P_new[j + 2, i], P_new[j + 3, i] = sums
        for j in range(done, i + 1):
            total = Q[i, j]
            for k in range(len(s)):
                total += w[k] * F[j, k]
            P_new[i, j] = P_new[j, i] = total


@inlined
def correct(
    s: Size, x: Array, P: Array, h: Array, r: float, z: float, p: Array, q: Array, fours: bool | None
) -> tuple[float, float]:
    """Update x and P in place with one scalar z = h x + r; return its innovation and 1 / s, NaN where P is too wide.

    Joseph's form for a scalar, one rank at a time, on one triangle of P, mirrored; p and q (s,) are left behind::

        p = P h',  s = h p + r,  K = p / s
        B = P - K p',  q = B h',  P = B - q K' + K r K'
    """
    done = 0
    if fours is not None:
        done = len(s) // 4 * 4
        for i in range(0, done, 4):
            p[i], p[i + 1], p[i + 2], p[i + 3] = four_sums(s, h, P, i, (0.0, 0.0, 0.0, 0.0))
    for i in range(done, len(s)):
        total = 0.0
        for j in range(len(s)):
            total += P[i, j] * h[j]
        p[i] = total
    y, S, widest = z, r, 0.0
    for i in range(len(s)):
        S += h[i] * p[i]
        y -= h[i] * x[i]
        widest += h[i] * h[i] * P[i, i]
    inverse = 1.0 / S if widest <= WIDE * r else np.nan
    if fours is not None:
        covariance_left(s, P, h, p, inverse, q)
    for i in range(len(s)):
        K_i = p[i] * inverse
        x[i] += K_i * y
        if i >= done:
            q[i] = 0.0
            for j in range(len(s)):
                q[i] += (P[i, j] - K_i * p[j]) * h[j]
        surplus = (r * K_i - q[i]) * inverse - K_i  # of row i: -K_i but for rounding
        for j in range(i, len(s)):
            P[i, j] += surplus * p[j]
        for j in range(i):
            P[i, j] = P[j, i]
    return y, inverse


@inlined
def covariance_left(s: Size, P: Array, h: Array, p: Array, inverse: float, q: Array) -> None:
    """Do q = (P - K p') h', the covariance of the states with z that is left, with K = p `inverse`, in whole fours."""
    for i in range(0, len(s) // 4 * 4, 4):
        a_0 = a_1 = a_2 = a_3 = 0.0
        K_0, K_1, K_2, K_3 = p[i] * inverse, p[i + 1] * inverse, p[i + 2] * inverse, p[i + 3] * inverse
        for j in range(len(s)):
            f, c = p[j], h[j]
            a_0, a_1 = a_0 + (P[j, i] - K_0 * f) * c, a_1 + (P[j, i + 1] - K_1 * f) * c
            a_2, a_3 = a_2 + (P[j, i + 2] - K_2 * f) * c, a_3 + (P[j, i + 3] - K_3 * f) * c
        q[i], q[i + 1], q[i + 2], q[i + 3] = a_0, a_1, a_2, a_3


@inlined
def measure(
    places: Places, g: int, model: Model, data: Data, k: int, x: Array, P: Array, step: SampleStep,
    sums: InnovationSums, results: SampleArrays, fours: bool | None,
) -> InnovationSums:  # fmt: skip
    """Correct x and P of group g, as predicted, with its measurement at sample k; return the new sums."""
    s, m = places.s, np.uint64(data.z.shape[1])
    for i in range(len(s)):
        step.x[i] = x[i]
    k_r = min(k, len(model.r) - 1)
    nis, log_det, det, count = sums
    for c in range(len(places.c)):
        row = places.rows[g, c]
        if row == m or not data.used[k, row]:
            continue
        innovation = data.z[k, row]
        h = step.H[g, c]
        for j in range(len(s)):
            innovation -= h[j] * step.x[j]
        y, inverse = correct(s, x, P, h, model.r[k_r, row], data.z[k, row], step.w, step.q, fours)
        white = y * np.sqrt(inverse)
        results.y[k, row], results.white[k, row] = innovation, white
        if len(places.gains):
            results.root[k, g, c] = np.sqrt(inverse)
            for j in range(len(s)):
                results.K[k, g, c, j] = step.w[j] * inverse
        nis += white * white
        count += 1
        det *= inverse
        if not 1e-200 < det < 1e200:  # one logarithm for many components
            log_det, det = log_det - np.log(det), 1.0
    return InnovationSums(nis, log_det, det, count)


@compiled
def recursive(
    places: Places, of_x: Pair, of_P: Pair, step: SampleStep, model: Model, data: Data, results: SampleArrays,
    fours: bool | None,
) -> tuple[Array, Array, int]:  # fmt: skip
    """Run the filter over N samples, from x (G, s) and P (G, s, s) of the groups to those after the last sample.

    Both are the first of a pair of arrays that it writes to. The third that is returned is the first sample after which
    anything is not finite, or N. The gate looks at all groups: each is predicted and corrected, and what was predicted
    stands where it refuses. `fours` is None for groups of fewer than four states: the compiler leaves out then what
    only many need.
    """
    (x, x_), (P, P_), G, n = of_x, of_P, len(places.states), np.uint64(model.F.shape[1])
    for k in range(len(data.z)):
        sums = InnovationSums(0.0, 0.0, 1.0, 0)
        for g in range(G):
            if not gather(places, g, model, k, step) and uneven(model.Q[k]):
                return x, P, k
            predict(places.s, x[g], P[g], step.F[g], step.F_t[g], step.Q[g], step.u[g], x_[g], P_[g], step.w, fours)
            sums = measure(places, g, model, data, k, x_[g], P_[g], step, sums, results, fours)
        used = sums.dof > 0 and sums.nis <= data.gates[sums.dof]
        if not used and sums.dof > 0:
            for g in range(G):
                predict(places.s, x[g], P[g], step.F[g], step.F_t[g], step.Q[g], step.u[g], x_[g], P_[g], step.w, fours)
        x, P, x_, P_ = x_, P_, x, P
        log_det = sums.log_det - np.log(sums.inverse)
        check = sums.nis + log_det
        for g in range(G):
            for i in range(len(places.s)):
                at = places.states[g, i]
                if at == n:
                    break
                if data.reset[at] and not used:
                    x[g, i], P[g, i], P[g, :, i] = 0.0, 0.0, 0.0
                results.x[k, at], results.sigma[k, at] = x[g, i], np.sqrt(P[g, i, i])
                check += results.x[k, at] + results.sigma[k, at]
            if len(results.P):
                for i in range(len(places.s)):
                    for j in range(len(places.s)):
                        results.P[k, g, i, j] = P[g, i, j]
        results.nis[k], results.log_det[k], results.used[k] = sums.nis, log_det, used
        if not np.isfinite(check):
            return x, P, k
    return x, P, len(data.z)


@compiled
def single(
    z: Array, x: Array, P: Array, F: Array, Q: Array, u: Array, H: Array, R: Array, gate: float,
    of_x: Array, of_z: Array, sums: Array,
) -> bool:  # fmt: skip
    """Do one sample z (1, m) of n states as one group; return whether it is ordinary, else nothing of it counts.

    Ordinary are covariances P and Q, R diagonal, nothing refused, all finite. The results are x, sigma, x again and P
    after the sample in `of_x` (n + 3, n), y and white in `of_z` (2, m), nis and log_det in `sums` (2,).
    """
    (m, n), ordinary = H.shape, not (uneven(P) or uneven(Q))
    for i in range(m):
        for j in range(m):
            ordinary &= R[i, j] > 0 if i == j else R[i, j] == 0
    if not ordinary:
        return False
    w, x_, P_ = of_x[1], of_x[2], of_x[3:]
    predict(x, x, P, F, F, Q, u[0], x_, P_, w, None)
    for i in range(m):
        of_z[0, i] = z[0, i]
        for j in range(n):
            of_z[0, i] -= H[i, j] * x_[j]
    sums[0] = sums[1] = 0.0
    for i in range(m):
        y, inverse = correct(x, x_, P_, H[i], R[i, i], z[0, i], w, of_x[0], None)
        of_z[1, i] = y * np.sqrt(inverse)
        sums[0] += of_z[1, i] ** 2
        sums[1] -= np.log(inverse)
    check = sums[0] + sums[1]
    for i in range(n):
        of_x[0, i], of_x[1, i] = x_[i], np.sqrt(P_[i, i])
        check += of_x[0, i] + of_x[1, i]
    return bool(np.isfinite(check) and sums[0] <= gate)


@compiled
def gains(N: int, s: Size, P: Array, F: Array, Q: Array, H: Array, r: Array) -> tuple[Array, Array, Array, Array]:
    """Run the covariance alone over N steps, from P (D, s, s); F, Q (D, s, s), H (D, c, s), r (D, c) stay the same.

    Returned are P after each step (N, D, s, s), the gain of each scalar update (N, D, c, s), one over the deviation of
    its innovation (N, D, c), and log_det (N, D).
    """
    nothing, p, w, q = np.zeros(len(s)), np.empty(len(s)), np.empty(len(s)), np.empty(len(s))
    x, u, log_det = np.zeros(len(s)), np.zeros(len(s)), np.zeros((N, len(P)))
    all_P, all_K, root = np.empty((N, *P.shape)), np.empty((N, *H.shape)), np.empty((N, *r.shape))
    for k in range(N):
        for g in range(len(P)):
            before, after = P[g] if k == 0 else all_P[k - 1, g], all_P[k, g]
            predict(s, nothing, before, F[g], F[g], Q[g], u, x, after, w, None)
            for i in range(H.shape[1]):
                inverse = correct(s, x, after, H[g, i], r[g, i], 0.0, p, q, None)[1]
                for j in range(len(s)):
                    all_K[k, g, i, j] = p[j] * inverse
                root[k, g, i] = np.sqrt(inverse)
                log_det[k, g] -= np.log(inverse)
    return all_P, all_K, root, log_det
