"""The short road: the steady gain of a time-invariant model, once the covariance has come to it.

P and K of a time-invariant model do not depend on the data and settle at the solution of the Riccati equation::

    P_ = F P F' + Q,    S = H P_ H' + R,    K = P_ H' S^-1,    P = (I - K H) P_ (I - K H)' + K R K'

From there on a step is two small products. Until then the long road carries P; that it has settled is seen by
comparing P with its limit, which structured doubling gives beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fusion_core.chunk import Array

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
