"""The gains of a time-invariant model, which do not depend on the data.

P and K settle at the solution of the Riccati equation, which structured doubling gives beforehand::

    P_ = F P F' + Q,    S = H P_ H' + R,    K = P_ H' S^-1,    P = (I - K H) P_ (I - K H)' + K R K'

Until then the recursion of P is run alone, once for all groups of states that are alike (three axes of a triad are).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from fusion_core.chunk import Array, Flags, Integers
from fusion_core.fast.groups import IndependentGroups, find_groups

TRANSIENT = 2048  # steps whose gains are worked out at once, until the covariance has settled
MAX_TRANSIENTS = 8  # of a model in the cache: recordings begin alike, and so do units of one config
SETTLED = 1e-11  # distance of P from its limit, relative to the deviations: a tenth of what is promised of P


def steady_state(F: Array, Q: Array, H: Array, R: Array) -> tuple[Array, Array] | None:
    """Return the steady posterior P and predicted P_ of a model, or None (an undriven or unobserved state)."""
    try:
        P_ = _riccati(F, Q, H, R)
    except np.linalg.LinAlgError:  # of numbers that differ by more than double precision has
        return None
    if P_ is None:
        return None
    S = H @ P_ @ H.T + R
    K = np.asarray(np.linalg.solve(S, H @ P_).T, dtype=np.float64)
    B = np.eye(len(F)) - K @ H
    P = B @ P_ @ B.T + K @ R @ K.T
    return (P + P.T) / 2, P_


def _riccati(F: Array, Q: Array, H: Array, R: Array) -> Array | None:
    """Return the predicted covariance of the steady state by structured doubling, or None if it does not settle.

    Chu, Fan, Lin, Wang, Int. J. Control 77 (2004) 767: after i iterations, 2^i steps of the filter from P = 0.
    """
    n = len(F)
    A, G, P_ = F.T, H.T @ np.linalg.solve(R, H), Q
    for _ in range(60):
        W = np.linalg.inv(np.eye(n) + G @ P_)
        step = A.T @ P_ @ W @ A
        G = G + A @ W @ G @ A.T
        A = A @ W @ A
        P_ = P_ + (step + step.T) / 2
        G = (G + G.T) / 2
        scale = np.sqrt(np.diag(P_))
        if not np.all(np.isfinite(P_)):
            return None
        if np.all(np.abs(step) <= 1e-15 * np.outer(scale, scale)):
            return P_ if np.max(np.abs(A)) < 1 else None
    return None


@dataclass(frozen=True)
class Gains:
    """Covariances and gains of N steps, whatever is measured; N = 1 stands for any number.

    Of D kinds of groups: those of one kind are alike, with s states and c components.

    Attributes
    ----------
    kind : (G,) array of int
        Which of the D kinds each group is.
    P : (N, D, s, s) array
        After each step.
    K : (N, D, c, s) array
        Gain of each scalar update, one component after the other.
    root : (N, D, c) array
        One over the deviation of its innovation.
    log_det : (N,) array
        Logarithm of the determinant of S, of all groups.
    """

    kind: Integers
    P: Array
    K: Array
    root: Array
    log_det: Array

    def first(self, N: int) -> Gains:
        """Return the gains of the first N steps."""
        return self if len(self.P) == 1 else Gains(self.kind, self.P[:N], self.K[:N], self.root[:N], self.log_det[:N])

    @cached_property
    def lanes(self) -> tuple[Array, Array]:
        """K (N, c, s, G) and root (N, c, G) of all groups."""
        K, root = self.K[:, self.kind], self.root[:, self.kind]
        return np.ascontiguousarray(K.transpose(0, 2, 3, 1)), np.ascontiguousarray(root.transpose(0, 2, 1))

    @cached_property
    def last(self) -> Array:
        """Covariances (G, s, s) of the groups after the last step."""
        return np.ascontiguousarray(self.P[-1, self.kind])

    def sigma(self, groups: IndependentGroups) -> Array:
        """Return the deviations (N, n) of all states."""
        deviations = np.sqrt(np.diagonal(self.P, axis1=2, axis2=3))
        return groups.from_lanes(np.take(np.swapaxes(deviations, 1, 2), self.kind, axis=2), groups.states, groups.n)


class Invariant:
    """A time-invariant model (F, Q (n, n), H (m, n) and the diagonal r (m,) of R) group by group, and its gains.

    Attributes
    ----------
    groups : Groups
    F, Q : (G, s, s) arrays
    H : (G, c, s) array
    r : (G, c) array
    F_lanes, minus_H_lanes : (s, s, G), (c, s, G) arrays
        F and -H of all groups side by side.
    steady : Gains or None
        Those that stay; None where P never settles.
    """

    def __init__(self, F: Array, Q: Array, H: Array, r: Array, coupled: Flags) -> None:
        self.groups = groups = find_groups(F[None], Q[None], H[None], coupled.astype(np.float64))
        states, rows = groups.states, groups.rows
        self.F, self.Q = groups.blocks(F, states, states), groups.blocks(Q, states, states)
        self.H, self.r = groups.blocks(H, rows, states), np.append(r, 1.0)[rows]
        self.F_lanes, self.minus_H_lanes = (np.ascontiguousarray(a.transpose(1, 2, 0)) for a in (self.F, -self.H))
        self.steady = self._steady()
        self._transient = lru_cache(MAX_TRANSIENTS)(self._from)

    def _steady(self) -> Gains | None:
        P = np.zeros_like(self.F)
        for g, (states, rows) in enumerate(zip(self.groups.states, self.groups.rows, strict=True)):
            a, b = states < self.groups.n, rows < self.groups.m  # what is filled up is zero and stays so
            square = np.ix_(a, a)
            limit = steady_state(self.F[g][square], self.Q[g][square], self.H[g][np.ix_(b, a)], np.diag(self.r[g][b]))
            if limit is None:
                return None
            P[g][square] = limit[0]
        gains = self._gains(P, 1)
        return gains if np.all(np.isfinite(gains.log_det)) else None

    def gains_from(self, P: Array, N: int) -> tuple[Gains, int]:
        """Return gains from covariances P (G, s, s) on, and for how many steps: N, unless they still change."""
        if self.steady is not None:
            limit = self.steady.last
            if limit.tobytes() == P.tobytes():  # of a stretch that goes on
                return self.steady, N
            sigma = np.sqrt(np.diagonal(limit, axis1=1, axis2=2))
            if np.all(np.abs(P - limit) <= SETTLED * sigma[:, :, None] * sigma[:, None, :]):
                return self.steady, N
        N = min(N, TRANSIENT)
        return self._transient(P.tobytes(), N), N

    def _from(self, P: bytes, N: int) -> Gains:
        """Return the gains of N steps from covariances (G, s, s) on, given as bytes."""
        return self._gains(np.frombuffer(P).reshape(self.F.shape), N)

    def _gains(self, P: Array, N: int) -> Gains:
        from fusion_core.fast.loop import gains

        parts = self.F, self.Q, self.H, self.r, P
        first: dict[bytes, int] = {}  # group of each kind
        alike = [first.setdefault(b"".join(a[g].tobytes() for a in parts), g) for g in range(len(P))]
        leaders = list(first.values())
        P, K, root, log_det = gains(N, self.groups.size[0], P[leaders], *(a[leaders] for a in parts[:-1]))
        kind = np.searchsorted(leaders, alike)
        return Gains(kind, P, K, root, log_det @ np.bincount(kind).astype(np.float64))


def invariant(F: Array, Q: Array, H: Array, r: Array, P: Array) -> Invariant:
    """Return the model of F, Q (n, n), H (m, n) and the diagonal r (m,) of R, from a covariance P (n, n) on."""
    return _invariant(*((np.ascontiguousarray(a).tobytes(), a.shape) for a in (F, Q, H, r, P != 0)))


@lru_cache(maxsize=64)  # a recording comes in many stretches of the same model
def _invariant(*arrays: tuple[bytes, tuple[int, ...]]) -> Invariant:
    F, Q, H, r = (np.frombuffer(data).reshape(shape) for data, shape in arrays[:-1])
    return Invariant(F, Q, H, r, np.frombuffer(arrays[-1][0], dtype=np.bool_).reshape(arrays[-1][1]))
