"""The Kalman filter over arrays: one call for a stretch of samples.

Two roads give the same estimates. The *short road* (`fusion_core.steady`) is taken where F, Q, H and R are the same
at every step and every sample is measured; the *long road* (`fusion_core.kernels`) everywhere else, and for a while
after a sample that the gate refused.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Transition
from fusion_core.model import Estimates, Flags, Measurement, State, join
from fusion_core.steady import Steady, short_road, steady_state

Road = Literal["auto", "long", "short"]

DETOUR = 64  # samples on the long road after the gate has refused one


def estimate(
    state: State,
    transition: Transition,
    measurement: Measurement,
    *,
    gate: float = np.inf,
    volatile: Flags | None = None,
    road: Road = "auto",
    keep_P: bool = False,
) -> Estimates:
    """Run the filter over N samples.

    Parameters
    ----------
    state : State
        Before the first step.
    transition : Transition
        The N steps that lead to the samples.
    measurement : Measurement
        The N measurements.
    gate : float
        A measurement whose nis exceeds this is refused, and the state only predicted.
    volatile : (n,) array of bool
        States that lose their meaning when a measurement is missing or refused: they start again from zero, known
        exactly (an integral that is taken anew).
    road : {"auto", "long", "short"}
        "auto" takes the short road where it is exact.
    keep_P : bool
        Whether to return P (N, n, n), which the smoother needs.

    Raises
    ------
    ValueError
        If road is "short" and the model is not time-invariant or has no steady state.
    """
    steady = _steady(transition, measurement) if road != "long" else None
    if road == "short" and steady is None:
        raise ValueError("the short road needs constant F, Q, H, R, every sample measured, and a steady state")
    u = np.broadcast_to(transition.u, (len(measurement.z), len(state.x)))
    parts: list[Estimates] = []
    start, span, N = 0, len(u), len(u)
    while start < N:
        stop = min(N, start + span)
        if steady is None:
            part = _long_road(state, transition, measurement, start, stop, gate, volatile, keep_P)
        else:
            part = short_road(steady, state, u[start:stop], measurement.z[start:stop], keep_P=keep_P)
            refused = np.flatnonzero(part.nis > gate)
            if len(refused):
                # what came before the refused sample stands; from there on, the long road, then try again
                good = start + int(refused[0])
                if good > start:
                    part = short_road(steady, state, u[start:good], measurement.z[start:good], keep_P=keep_P)
                    parts.append(part)
                    state = part.state
                start, stop = good, min(N, good + DETOUR)
                part = _long_road(state, transition, measurement, start, stop, gate, volatile, keep_P)
                span = 4 * DETOUR
            else:
                span *= 4
        parts.append(part)
        state, start = part.state, stop
    return join(parts)


def _steady(transition: Transition, measurement: Measurement) -> Steady | None:
    if not (transition.invariant and measurement.invariant):
        return None
    return steady_state(transition.F, transition.Q, measurement.H, measurement.R)


def _long_road(
    state: State,
    transition: Transition,
    measurement: Measurement,
    start: int,
    stop: int,
    gate: float,
    volatile: Flags | None,
    keep_P: bool,
) -> Estimates:
    from fusion_core.kernels import long_road

    N, n, m = stop - start, len(state.x), measurement.z.shape[1]

    def rows(array: Array, ndim: int) -> Array:
        """Return the rows of this stretch, or the one row for all of them."""
        return np.ascontiguousarray(array[start:stop] if array.ndim == ndim else array[None])

    z, H, r, root = _whitened(rows(measurement.z, 2), rows(measurement.H, 3), rows(measurement.R, 3))
    x, P, used = state.x.copy(), np.ascontiguousarray(state.P).copy(), measurement.used[start:stop].copy()
    out = [np.empty((N, n)), np.empty((N, n)), np.empty((N, m)), np.empty((N, m)), np.empty(N), np.empty(N)]
    P_all = np.empty((N if keep_P else 0, n, n))
    F, Q, u = rows(transition.F, 3), rows(transition.Q, 3), rows(transition.u, 2)
    no_state = np.zeros(n, dtype=bool)
    long_road(x, P, F, Q, u, z, H, r, used, gate, no_state if volatile is None else volatile, *out, P_all)
    x_all, sigma, y, white, nis, log_det = out
    if root is not None:
        y = np.einsum("...ij,...j->...i", root, y)
        log_det += 2 * np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
    return Estimates(x_all, sigma, y, white, nis, log_det, used, State(x, P), P_all if keep_P else None)


def _whitened(z: Array, H: Array, R: Array) -> tuple[Array, Array, Array, Array | None]:
    """Return z, H and the diagonal of R such that R is diagonal, and the root that undoes it on the innovations."""
    variances = np.diagonal(R, axis1=1, axis2=2)
    if np.all(variances[:, :, None] * np.eye(R.shape[1]) == R):
        return z, H, np.ascontiguousarray(variances), None
    root = np.asarray(np.linalg.cholesky(R), dtype=np.float64)
    to_white = np.asarray(np.linalg.inv(root), dtype=np.float64)
    return (to_white @ z[..., None])[..., 0], to_white @ H, np.ones(R.shape[:2], dtype=np.float64), root
