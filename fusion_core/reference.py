"""The filter as the textbook has it, in plain NumPy: what the compiled loops are held to.

One step, Joseph form (Brown and Hwang, 4th ed., sec. 4.2; R. E. Kalman, 1960)::

    x- = F x + u,                 P- = F P F' + Q
    y  = z - H x-,                S  = H P- H' + R,      K = P- H' S^-1
    x  = x- + K y,                P  = (I - K H) P- (I - K H)' + K R K'

It is slow and clear. Nothing in the program calls it.
"""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Array
from fusion_core.model import Estimates, Flags, Measurement, State, Transition


def predict(state: State, F: Array, Q: Array, u: Array) -> State:
    """Return the state one step later."""
    return State(F @ state.x + u, F @ state.P @ F.T + Q)


def measure(state: State, z: Array, H: Array, R: Array) -> tuple[State, Array, Array]:
    """Return the state after measurement z (m,), the innovation y (m,) and its covariance S (m, m)."""
    y = z - H @ state.x
    S = H @ state.P @ H.T + R
    K = np.linalg.solve(S, H @ state.P).T
    B = np.eye(len(state.x)) - K @ H
    return State(state.x + K @ y, B @ state.P @ B.T + K @ R @ K.T), y, S


def estimate(
    state: State,
    transition: Transition,
    measurement: Measurement,
    *,
    gate: float = np.inf,
    reset: Flags | None = None,
) -> Estimates:
    """Run the filter over N samples; arguments as in `fusion_core.kalman.estimate`."""
    N, m = measurement.z.shape
    n = len(state.x)
    F, Q = (np.broadcast_to(a, (N, n, n)) for a in (transition.F, transition.Q))
    u = np.broadcast_to(transition.u, (N, n))
    H = np.broadcast_to(measurement.H, (N, m, n))
    R = np.broadcast_to(measurement.R, (N, m, m))
    rows, P, used = [], np.empty((N, n, n)), measurement.used.copy()
    for k in range(N):
        state = predict(state, F[k], Q[k], u[k])
        after, y, S = measure(state, measurement.z[k], H[k], R[k])
        white = np.linalg.solve(np.linalg.cholesky(S), y)
        used[k] = used[k] and white @ white <= gate
        if used[k]:
            state = after
        elif reset is not None:
            keep = np.where(reset, 0.0, 1.0)
            state = State(state.x * keep, state.P * np.outer(keep, keep))
        rows.append((state.x, np.sqrt(np.diag(state.P)), y, white, white @ white, np.linalg.slogdet(S)[1]))
        P[k] = state.P
    x, sigma, y, white, nis, log_det = (np.array(column) for column in zip(*rows, strict=True))
    return Estimates(x, sigma, y, white, nis, log_det, used, state, P)
