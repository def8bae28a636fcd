"""The Kalman filter: one step as the textbook has it, and a stretch of samples at once.

::

    x- = F x + u,                 P- = F P F' + Q                                  (predict)
    y  = z - H x-,                S  = H P- H' + R,      K = P- H' S^-1            (correct)
    x  = x- + K y,                P  = (I - K H) P- (I - K H)' + K R K'

R. E. Kalman, J. Basic Eng. 82 (1960) 35; P in the form of Joseph, which stays positive whatever K is rounded to
(Brown and Hwang, Introduction to Random Signals and Applied Kalman Filtering, 4th ed., sec. 4.2).

`estimate` runs these steps over N samples: as they stand here (`method="plain"`), or compiled, with the same results.
`fusion_core.fast` has the table of which way is taken when, and what it gains.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from fusion_core.checks import (
    NotFinite,
    TooWide,
    checked_measurement,
    checked_reset,
    checked_state,
    checked_transition,
    covariance,
    finite,
    numbers,
)
from fusion_core.chunk import Array, Flags
from fusion_core.model import Estimates, Measurement, State, Transition

Method = Literal["auto", "recursive", "steady", "plain"]
METHODS = get_args(Method)
SHORT = 256  # samples at most for which "auto" does not look for steady gains: the look costs what as many steps do


def predict(state: State, F: Array, Q: Array, u: Array) -> State:
    """Return the state one step later; F, Q (n, n), u (n,)."""
    return State(F @ state.x + u, F @ state.P @ F.T + Q)


def correct(state: State, z: Array, H: Array, R: Array) -> tuple[State, Array, Array]:
    """Return the state after the measurement z (m,) of H (m, n) and R (m, m), its innovation y and that one's S."""
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
    method: Method = "auto",
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
        A measurement of all m components whose nis exceeds this is refused, and the state only predicted. Where fewer
        are measured the gate is what a right model exceeds as rarely (`fusion_core.consistency.gates_of`).
    reset : (n,) array of bool
        States that lose their meaning where a sample has no measurement or it is refused: they start again from zero,
        known exactly (an integral that is taken anew).
    method : {"auto", "recursive", "steady", "plain"}
        "recursive" carries P through every sample. "steady" has gains that are known before the data, which asks for
        F, Q, H and R without a leading N and every component measured; "auto" takes it where it can and gains by it.
        "plain" is `predict` and `correct` sample by sample, for reading and testing.
    keep_P : bool
        Whether to return P (N, n, n).

    Returns
    -------
    Estimates

    Raises
    ------
    ValueError
        If an array has another shape or kind than `Transition` and `Measurement` say, P, Q or R is no covariance, or
        method is "steady" and the model varies.
    NotFinite
        If an estimate is not finite: a ValueError that names the sample.
    TooWide
        If P is 1e26 times R (along a row of H) and more, or 1e12 times and nearly singular: a ValueError. With
        `method="plain"` from 1e12 times on.
    """
    if method not in METHODS:
        raise ValueError(f"estimate: method is {method!r}, one of {', '.join(METHODS)} was expected")
    if not gate >= 0:
        raise ValueError(f"estimate: gate is {gate}, a nis from 0 to infinity was expected")
    from fusion_core.fast.job import alone, run

    n = np.size(state.x)
    reset = checked_reset(reset, n)
    if method in ("auto", "recursive") and (one := alone(state, transition, measurement, gate, keep_P)) is not None:
        return one
    state = checked_state(state)
    measurement = checked_measurement(measurement, n)
    transition = checked_transition(transition, n, len(measurement.z))
    steady = transition.invariant and measurement.invariant and measurement.z.shape[1] > 0
    if method == "steady" and not steady:
        raise ValueError("estimate: steady gains need F, Q, H and R without a leading N, and every component measured")
    given = state, transition, measurement, _gates(gate, measurement.used), reset
    if method == "plain":
        return _plain(*given, keep_P=keep_P)
    steady = method == "steady" or (method == "auto" and steady and len(measurement.z) > SHORT)
    return run(*given, steady=steady, keep_P=keep_P)


def _gates(gate: float, used: Flags) -> Array:
    """Return the largest nis (m + 1,) by the number of components that a sample has."""
    m = used.shape[1]
    if gate == np.inf or used.all():
        return np.full(m + 1, gate)
    from fusion_core.consistency import gates_of

    return gates_of(gate, m)


def _plain(
    state: State, transition: Transition, measurement: Measurement, gates: Array, reset: Flags, *, keep_P: bool
) -> Estimates:
    """Run `predict` and `correct` sample by sample."""
    from fusion_core.fast.loop import WIDE

    (N, m), n = measurement.z.shape, len(state.x)
    F, Q, u = (np.broadcast_to(a, (N, *shape)) for a, shape in zip(
        (transition.F, transition.Q, transition.u), ((n, n), (n, n), (n,)), strict=True))  # fmt: skip
    H, R = np.broadcast_to(measurement.H, (N, m, n)), np.broadcast_to(measurement.R, (N, m, m))
    x, P, y, white = np.empty((N, n)), np.empty((N, n, n)), np.full((N, m), np.nan), np.full((N, m), np.nan)
    nis, log_det, dof = np.zeros(N), np.zeros(N), np.sum(measurement.used, axis=1)
    used = dof > 0
    for k in range(N):
        if transition.Q.ndim == 3:
            covariance("Q", Q[k], sample=k)
        state = predict(state, F[k], Q[k], u[k])
        some = measurement.used[k]  # the components that this sample has
        if used[k]:
            R_k = R[k][np.ix_(some, some)]
            after, y[k, some], S = correct(state, measurement.z[k, some], H[k, some], R_k)
            if not np.all(np.isfinite(S)):
                raise NotFinite(k)
            if np.any(H[k, some] ** 2 @ np.diag(state.P) > WIDE * np.diag(R_k)):
                raise TooWide(k)
            root = np.linalg.cholesky(S)
            white[k, some] = np.linalg.solve(root, y[k, some])
            nis[k], log_det[k] = np.sum(white[k, some] ** 2), 2 * np.sum(np.log(np.diag(root)))
            used[k] = nis[k] <= gates[dof[k]]
        if used[k]:
            state = after
        else:
            state = State(np.where(reset, 0.0, state.x), np.where(reset | reset[:, None], 0.0, state.P))
        x[k], P[k] = state.x, state.P
    variances = np.diagonal(P, axis1=1, axis2=2)
    good = np.isfinite(nis) & np.all(np.isfinite(x) & (variances >= 0) & np.isfinite(variances), axis=1)
    if not np.all(good):
        raise NotFinite(int(np.argmin(good)))
    return Estimates(x, np.sqrt(variances), y, white, nis, log_det, dof, used, state, P if keep_P else None)


def expected(x: Array, transition: Transition, N: int) -> Array:
    """Return the mean of the states (N, n) over N steps from x (n,), with no measurement."""
    from fusion_core.recursions import drift

    n = np.size(x)
    x = finite("x", numbers("x", x, (n,), "of the states"))
    steps = checked_transition(transition, n, N)
    u, out = np.ascontiguousarray(np.broadcast_to(steps.u, (N, n))), np.empty((N, n))
    drift(x, steps.F if steps.F.ndim == 3 else steps.F[None], u, out)
    return out
