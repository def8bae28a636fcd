"""The gains of a time-invariant model, which do not depend on the data.

P and K settle at the solution of the Riccati equation, which structured doubling gives beforehand::

    P_ = F P F' + Q,    S = H P_ H' + R,    K = P_ H' S^-1,    P = (I - K H) P_ (I - K H)' + K R K'

Until then the recursion of P is run alone, once for all groups of states that are alike (three axes of a triad are).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fusion_core.chunk import Array
from fusion_core.groups import Index, find_groups
from fusion_core.model import Flags

SETTLED = 1e-11  # distance of P from its limit, relative to the deviations: a tenth of what is promised of P


@dataclass(frozen=True)
class Steady:
    """The steady state of a time-invariant model: posterior P, predicted P_, gain K, innovation covariance S."""

    F: Array
    H: Array
    P: Array
    P_: Array
    K: Array
    S: Array


def steady_state(F: Array, Q: Array, H: Array, R: Array) -> Steady | None:
    """Return the steady filter of a model, or None where there is none (an undriven or unobserved state)."""
    return _steady_state(*((np.ascontiguousarray(a).tobytes(), a.shape) for a in (F, Q, H, R)))


@lru_cache(maxsize=256)
def _steady_state(*matrices: tuple[bytes, tuple[int, ...]]) -> Steady | None:
    F, Q, H, R = (np.frombuffer(data).reshape(shape) for data, shape in matrices)
    P_ = _riccati(F, Q, H, R)
    if P_ is None:
        return None
    S = H @ P_ @ H.T + R
    K = np.asarray(np.linalg.solve(S, H @ P_).T, dtype=np.float64)
    B = np.eye(len(F)) - K @ H
    P = B @ P_ @ B.T + K @ R @ K.T
    return Steady(F, H, (P + P.T) / 2, P_, K, S)


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
    """What N steps have in common whatever is measured; N = 1 stands for any number.

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

    kind: Index
    P: Array
    K: Array
    root: Array
    log_det: Array

    def sigma(self) -> Array:
        """Return the deviations of all states (N, s G), in group order."""
        deviations = np.sqrt(np.diagonal(self.P, axis1=2, axis2=3))
        return np.take(np.swapaxes(deviations, 1, 2), self.kind, axis=2).reshape(len(deviations), -1)


class Invariant:
    """A time-invariant model (F, Q (n, n), H (m, n) and the diagonal r (m,) of R) group by group, and its gains."""

    def __init__(self, F: Array, Q: Array, H: Array, r: Array, coupled: Flags) -> None:
        self.groups = groups = find_groups(F[None], Q[None], H[None], coupled.astype(np.float64))
        self._model = (
            groups.of_states(F, 2), groups.of_states(Q, 2), groups.of_measurement(H), groups.of_components(r, 1.0)
        )  # fmt: skip
        G, (s, c) = len(groups.states), (groups.states.shape[1], groups.rows.shape[1])
        self.F, self.Q = groups.blocks(self._model[0]), groups.blocks(self._model[1])
        rows, columns = np.arange(G)[:, None] + G * np.arange(c), np.arange(G)[:, None] + G * np.arange(s)
        self.H, self.r = self._model[2][rows[:, :, None], columns[:, None, :]], self._model[3][rows]
        self.steady = self._steady()

    def _steady(self) -> Gains | None:
        """Return the gains that stay, or None where P never settles."""
        P = np.zeros_like(self.F)
        for g, (states, rows) in enumerate(zip(self.groups.states, self.groups.rows, strict=True)):
            a, b = states < self.groups.n, rows < self.groups.m  # what is filled up is zero and stays so
            found = steady_state(
                self.F[g][np.ix_(a, a)], self.Q[g][np.ix_(a, a)], self.H[g][np.ix_(b, a)], np.diag(self.r[g][b])
            )
            if found is None:
                return None
            P[g][np.ix_(a, a)] = found.P
        return self.gains(P, 1)

    def settled(self, P: Array) -> bool:
        """Whether covariances (G, s, s) are the steady ones, but for rounding."""
        assert self.steady is not None, "there is no steady state"
        limit = self.steady.P[0, self.steady.kind]
        sigma = np.sqrt(np.diagonal(limit, axis1=1, axis2=2))
        return bool(np.all(np.abs(P - limit) <= SETTLED * sigma[:, :, None] * sigma[:, None, :]))

    def gains(self, P: Array, N: int) -> Gains:
        """Return the gains of N steps from covariances P (G, s, s)."""
        from fusion_core.kernels import gains

        G, s = self.groups.states.shape
        c = self.groups.rows.shape[1]
        alike: dict[bytes, int] = {}  # the first group of each kind
        kinds = [np.concatenate([a[g].ravel() for a in (self.F, self.Q, self.H, self.r, P)]).tobytes() for g in range(G)]
        first = [alike.setdefault(kind, g) for g, kind in enumerate(kinds)]
        leaders = list(alike.values())
        D = len(leaders)
        states, rows = (np.concatenate([G * k + np.array(leaders) for k in range(size)] or [[]]).astype(int) for size in (s, c))
        F, Q, H, r = self._model
        out = np.empty((N, D, s, s)), np.empty((N, D, c, s)), np.empty((N, D, c)), np.empty((N, D))
        size = ((0.0,) * s, (0.0,) * c, (0.0,) * D)
        gains(*size, P[leaders], F[np.ix_(states, states)], Q[np.ix_(states, states)], H[np.ix_(rows, states)], r[rows], *out)
        kind = np.searchsorted(leaders, first)
        return Gains(kind, *out[:3], out[3] @ np.bincount(kind).astype(np.float64))


@lru_cache(maxsize=64)  # a recording comes in many stretches of the same model
def invariant(*arrays: tuple[bytes, tuple[int, ...]]) -> Invariant:
    """Return the model of F, Q, H, r and where P is not zero, each as bytes and shape."""
    F, Q, H, r = (np.frombuffer(data).reshape(shape) for data, shape in arrays[:-1])
    return Invariant(F, Q, H, r, np.frombuffer(arrays[-1][0], dtype=np.bool_).reshape(arrays[-1][1]))
