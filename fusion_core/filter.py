"""The Kalman filter over arrays: one call for a stretch of samples.

Two roads give the same estimates, both group by group of states that have nothing to do with one another. The *long
road* carries the covariance through every sample. The *short road* is taken where F, Q, H and R are the same at every
step and every sample is measured: the gains are then known before the data (`fusion_core.steady`). A sample that the
gate refuses leads back to the long road for a while.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Transition
from fusion_core.groups import Groups, find_groups
from fusion_core.model import Estimates, Flags, Measurement, State
from fusion_core.steady import Invariant, invariant

Road = Literal["auto", "long", "short"]

DETOUR = 256  # samples on the long road once one is refused: others are often near
TRANSIENT = 2048  # samples whose gains are worked out at once, until the covariance has settled
SPAN = 16_384  # samples on the short road at first; each further stretch is longer


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
    z, H, r, root = _whitened(measurement.z, _lead(measurement.H, 3), _lead(measurement.R, 3))
    F, Q, u = _lead(transition.F, 3), _lead(transition.Q, 3), _lead(transition.u, 2)
    model: Invariant | None = None
    if transition.invariant and measurement.invariant and road != "long":
        model = invariant(*((a.tobytes(), a.shape) for a in (F[0], Q[0], H[0], r[0], state.P != 0)))
        groups = model.groups
    else:
        groups = find_groups(F, Q, H, state.P)
    if road == "short" and (model is None or model.steady is None):
        raise ValueError("the short road needs constant F, Q, H, R, every sample measured, and a steady state")
    no_state = np.zeros(len(state.x), dtype=np.bool_)
    job = _Job(state, (F, Q, u, z, H, r), groups, measurement.used, no_state if volatile is None else volatile, keep_P)
    start, span, N = 0, SPAN, len(z)
    while start < N:
        if model is None or model.steady is None:
            start = job.long_road(start, N, gate)
            continue
        settled = model.settled(job.P)
        stop = min(N, start + (span if settled else TRANSIENT))
        start, span = job.short_road(start, stop, gate, model, settled=settled), 4 * span
        if start < N and job.nis[start] > gate and start < stop:  # to be judged again, with what led to it
            start, span = job.long_road(start, min(N, start + DETOUR), gate), SPAN
    return job.estimates(root)


def expected(x: Array, transition: Transition, N: int) -> Array:
    """Return the mean of the states (N, n) over N steps from x (n,), with no measurement."""
    from fusion_core.kernels import drift

    u = np.ascontiguousarray(np.broadcast_to(transition.u, (N, len(x))))
    return np.asarray(drift(x, _lead(transition.F, 3), u), dtype=np.float64)


def _lead(array: Array, ndim: int) -> Array:
    """Return an array with a leading axis of length 1 where it has none."""
    return np.ascontiguousarray(array if array.ndim == ndim else array[None])


def _whitened(z: Array, H: Array, R: Array) -> tuple[Array, Array, Array, Array | None]:
    """Return z, H and the diagonal of R such that R is diagonal, and the root that undoes it on the innovations."""
    variances = np.diagonal(R, axis1=1, axis2=2)
    if np.all(variances[:, :, None] * np.eye(R.shape[1]) == R):
        return np.ascontiguousarray(z), H, np.ascontiguousarray(variances), None
    root = np.asarray(np.linalg.cholesky(R), dtype=np.float64)
    to_white = np.asarray(np.linalg.inv(root), dtype=np.float64)
    white = np.ascontiguousarray((to_white @ z[..., None])[..., 0])
    return white, np.ascontiguousarray(to_white @ H), np.ones(R.shape[:2], dtype=np.float64), root


class _Job:
    """One call in progress: the state group by group, and the estimates so far, in group order."""

    def __init__(
        self, state: State, arrays: tuple[Array, ...], groups: Groups, used: Flags, volatile: Flags, keep_P: bool
    ) -> None:
        F, Q, u, z, H, r = arrays
        self.groups, self.used = groups, used.copy()
        self.volatile = groups.of_states(volatile)
        self.F, self.Q, self.u = groups.of_states(F, 2), groups.of_states(Q, 2), groups.of_states(u)
        self.z, self.H, self.r = groups.of_components(z), groups.of_measurement(H), groups.of_components(r, 1.0)
        G, s = groups.states.shape
        N, n, m = len(used), G * s, groups.rows.size
        self.x = np.ascontiguousarray(groups.of_states(state.x).reshape(s, G).T)
        self.P = groups.blocks(groups.of_states(state.P, 2))
        self.x_all, self.sigma = np.empty((N, n)), np.empty((N, n))
        self.y, self.white = np.empty((N, m)), np.empty((N, m))
        self.nis, self.log_det = np.empty(N), np.empty(N)
        self.P_all = np.empty((N if keep_P else 0, G, s, s))

    def long_road(self, start: int, stop: int, gate: float) -> int:
        from fusion_core.kernels import long_road

        rows = slice(start, stop)
        model = (a if len(a) == 1 else a[rows] for a in (self.F, self.Q, self.u, self.z, self.H, self.r))
        out = (self.x_all, self.sigma, self.y, self.white, self.nis, self.log_det, self.P_all)
        self.x, self.P = long_road(
            *self.groups.size, self.x, self.P, *model, self.used[rows], gate, self.volatile, *(a[rows] for a in out)
        )
        return stop

    def short_road(self, start: int, stop: int, gate: float, model: Invariant, *, settled: bool) -> int:
        """Run up to `stop`, or to the first sample that the gate refuses; return which."""
        from fusion_core.kernels import short_road

        rows = slice(start, stop)
        gains = model.steady if settled and model.steady is not None else model.gains(self.P, stop - start)
        x = self.x.copy()
        short_road(
            *self.groups.size, x, model.F, model.H, tuple(gains.kind.tolist()), gains.K, gains.root, self.u if len(self.u) == 1 else self.u[rows],
            self.z[rows], *(a[rows] for a in (self.x_all, self.y, self.white, self.nis)),
        )  # fmt: skip
        refused = self.nis[rows] > gate
        if np.any(refused):
            stop = start + int(np.argmax(refused))
            if stop == start:
                return stop
            x = self.x_all[stop - 1].reshape(self.x.T.shape).T.copy()
        rows = slice(start, stop)
        P = gains.P if settled else gains.P[: stop - start]
        sigma = gains.sigma()[: len(P)]
        self.x, self.P = x, P[-1, gains.kind]
        if settled and stop - start == len(self.nis):  # all of it: nothing to write down for each sample
            self.sigma = np.broadcast_to(sigma[0], self.sigma.shape)
            self.log_det = np.broadcast_to(gains.log_det[0], self.log_det.shape)
        else:
            self.sigma[rows], self.log_det[rows] = sigma, gains.log_det[: stop - start]
        if len(self.P_all):
            self.P_all[rows] = P[:, gains.kind]
        return stop

    def estimates(self, root: Array | None) -> Estimates:
        """Return what was found; `root` takes the innovations back to where R was not diagonal."""
        states, components = self.groups.places
        x_all, sigma, y, white, x = self.x_all, self.sigma, self.y, self.white, self.x.T.ravel()
        if not self.groups.ordered:
            x_all, sigma, x = x_all[:, states], sigma[:, states], x[states]
            y, white = y[:, components], white[:, components]
        log_det = self.log_det
        if root is not None:
            y = np.einsum("...ij,...j->...i", root, y)
            log_det = log_det + 2 * np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
        return Estimates(
            x_all, sigma, y, white, self.nis, log_det, self.used, State(x, self.groups.whole(self.P)),
            self.groups.whole(self.P_all) if len(self.P_all) else None,
        )  # fmt: skip
