"""Fixed-interval smoothing: the states given all measurements, past and future.

In the form of Bryson and Frazier (G. J. Bierman, Automatica 9 (1973) 503). It returns what the Rauch-Tung-Striebel
smoother returns, but needs no inverse of the predicted covariance, which is singular where a state is known exactly::

    l_k  = -H' S^-1 y + B' l+_k,      L_k  = H' S^-1 H + B' L+_k B,      B = I - K H
    l+_{k-1} = F' l_k,                L+_{k-1} = F' L_k F
    x_k|N = x_k - P_k l+_k,           P_k|N = P_k - P_k L+_k P_k
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fusion_core.chunk import Array
from fusion_core.model import Estimates, Flags, Measurement, State, Transition


def smooth(
    state: State,
    transition: Transition,
    measurement: Measurement,
    estimates: Estimates,
    *,
    reset: Flags | None = None,
) -> tuple[Array, Array]:
    """Return the smoothed x (N, n) and P (N, n, n).

    Parameters
    ----------
    state, transition, measurement, reset
        What `fusion_core.kalman.estimate` was given.
    estimates : Estimates
        What it returned with `keep_P=True`.
    """
    if estimates.P is None:
        raise ValueError("the smoother needs P; call estimate(..., keep_P=True)")
    n = estimates.x.shape[1]
    F, Q = (np.ascontiguousarray(a if a.ndim == 3 else a[None]) for a in (transition.F, transition.Q))
    H, R = (np.ascontiguousarray(a if a.ndim == 3 else a[None]) for a in (measurement.H, measurement.R))
    keep = np.eye(n) if reset is None else np.diag(np.where(reset, 0.0, 1.0))
    P_before = np.concatenate([state.P[None], estimates.P[:-1]])
    P = np.ascontiguousarray(estimates.P)
    return _smooth(estimates.x, P, P_before, F, Q, H, R, estimates.y, estimates.used, keep)  # type: ignore[no-any-return]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _smooth(
    x: Array,
    P: Array,
    P_before: Array,
    F: Array,
    Q: Array,
    H: Array,
    R: Array,
    y: Array,
    used: Flags,
    keep: Array,
) -> tuple[Array, Array]:
    N, n = x.shape
    x_out, P_out = np.empty((N, n)), np.empty((N, n, n))
    lam, Lam = np.zeros(n), np.zeros((n, n))
    for back in range(N):
        k = N - 1 - back
        x_out[k] = x[k] - P[k] @ lam
        P_out[k] = P[k] - P[k] @ Lam @ P[k]
        F_k, H_k = F[min(k, len(F) - 1)], H[min(k, len(H) - 1)]
        if used[k]:
            P_predicted = F_k @ P_before[k] @ F_k.T + Q[min(k, len(Q) - 1)]
            S = H_k @ P_predicted @ H_k.T + R[min(k, len(R) - 1)]
            gain = np.linalg.solve(S, H_k)  # S^-1 H
            B = np.eye(n) - P_predicted @ H_k.T @ gain
            lam = B.T @ lam - gain.T @ y[k]
            Lam = H_k.T @ gain + B.T @ Lam @ B
        else:
            lam = keep @ lam
            Lam = keep @ Lam @ keep
        lam = F_k.T @ lam
        Lam = F_k.T @ Lam @ F_k
    return x_out, P_out
