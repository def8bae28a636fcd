"""The Kalman filter over arrays: one call for a stretch of samples.

Two methods give the same estimates, both group by group of states that have nothing to do with one another. The
*recursive* one carries the covariance through every sample. The *steady* one is taken where F, Q, H and R are the same
at every step and every sample is measured: the gains are then known before the data (`fusion_core.fast.steady`). A
sample that the gate refuses leads back to the recursion for a while.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fusion_core.chunk import Array
from fusion_core.fast.groups import Groups, find_groups
from fusion_core.fast.steady import Gains, Invariant, invariant
from fusion_core.model import Estimates, Flags, Measurement, State, Transition

Method = Literal["auto", "recursive", "steady"]

DETOUR = 256  # samples of recursion once one is refused: others are often near
SPAN = 16_384  # samples with steady gains at first; each further stretch is longer


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
        A measurement whose nis exceeds this is refused, and the state only predicted.
    reset : (n,) array of bool
        States that lose their meaning when a measurement is missing or refused: they start again from zero, known
        exactly (an integral that is taken anew).
    method : {"auto", "recursive", "steady"}
        "auto" takes the steady gains where there are any.
    keep_P : bool
        Whether to return P (N, n, n), which the smoother needs.

    Raises
    ------
    ValueError
        If method is "steady" and the model is not time-invariant, or a sample is not measured.
    """
    z, H, r, root = _whitened(measurement.z, _lead(measurement.H, 3), _lead(measurement.R, 3))
    F, Q, u = _lead(transition.F, 3), _lead(transition.Q, 3), _lead(transition.u, 2)
    model: Invariant | None = None
    if method != "recursive" and transition.invariant and measurement.invariant:
        model = invariant(F[0], Q[0], H[0], r[0], state.P)
        groups = model.groups
    else:
        groups = find_groups(F, Q, H, state.P)
    if method == "steady" and model is None:
        raise ValueError("steady gains need constant F, Q, H and R, and every sample measured")
    no_state = np.zeros(len(state.x), dtype=np.bool_)
    job = _Job(state, (F, Q, u, z, H, r), groups, measurement.used, no_state if reset is None else reset, keep_P)
    start, span, N = 0, SPAN, len(z)
    while start < N:
        if model is None:
            start = job.recursive(start, N, gate)
            continue
        gains, length = model.ahead(job.P, min(N - start, span))
        stop = start + length
        start, span = job.steady(start, stop, gate, model, gains), 4 * span
        if start < stop:  # a sample was refused: it is judged again, with those after it
            start, span = job.recursive(start, min(N, start + DETOUR), gate), DETOUR
    return job.estimates(root)


def expected(x: Array, transition: Transition, N: int) -> Array:
    """Return the mean of the states (N, n) over N steps from x (n,), with no measurement."""
    from fusion_core.fast.loop import drift

    u = np.ascontiguousarray(np.broadcast_to(transition.u, (N, len(x))))
    return np.asarray(drift(x, _lead(transition.F, 3), u), dtype=np.float64)


def _lead(array: Array, ndim: int) -> Array:
    """Return an array with a leading axis of length 1 where it has none."""
    return np.ascontiguousarray(array if array.ndim == ndim else array[None])


def _whitened(z: Array, H: Array, R: Array) -> tuple[Array, Array, Array, Array | None]:
    """Return z, H and the diagonal of R such that R is diagonal, and the root that undoes it on the innovations."""
    variances = np.diagonal(R, axis1=1, axis2=2)
    if np.count_nonzero(R) == np.count_nonzero(variances):
        return np.ascontiguousarray(z), H, np.ascontiguousarray(variances), None
    root = np.asarray(np.linalg.cholesky(R), dtype=np.float64)
    to_white = np.asarray(np.linalg.inv(root), dtype=np.float64)
    white = np.ascontiguousarray((to_white @ z[..., None])[..., 0])
    return white, np.ascontiguousarray(to_white @ H), np.ones(R.shape[:2], dtype=np.float64), root


class _Job:
    """One call in progress: the state group by group, and the estimates so far, in group order."""

    def __init__(
        self, state: State, arrays: tuple[Array, ...], groups: Groups, used: Flags, reset: Flags, keep_P: bool
    ) -> None:
        F, Q, u, z, H, r = arrays
        self.groups, self.used = groups, used.copy()
        self.reset = groups.arranged(reset, states=(0,))
        self.F, self.Q = groups.arranged(F, states=(1, 2)), groups.arranged(Q, states=(1, 2))
        self.u, self.z = groups.arranged(u, states=(1,)), groups.arranged(z, components=(1,))
        self.H = groups.arranged(H, components=(1,), states=(2,))
        self.r = groups.arranged(r, components=(1,), filling=1.0)
        G, s = groups.states.shape
        N, n, m = len(used), G * s, groups.rows.size
        self.x = np.ascontiguousarray(groups.arranged(state.x, states=(0,)).reshape(s, G).T)
        self.P = groups.blocks(groups.arranged(state.P, states=(0, 1)))
        self.x_all, self.sigma = np.empty((N, n)), np.empty((N, n))
        self.y, self.white = np.empty((N, m)), np.empty((N, m))
        self.nis, self.log_det = np.empty(N), np.empty(N)
        self.P_all = np.empty((N if keep_P else 0, G, s, s))

    def recursive(self, start: int, stop: int, gate: float) -> int:
        from fusion_core.fast.loop import recursive

        rows = slice(start, stop)
        model = (a if len(a) == 1 else a[rows] for a in (self.F, self.Q, self.u, self.z, self.H, self.r))
        out = (self.x_all, self.sigma, self.y, self.white, self.nis, self.log_det, self.P_all)
        self.x, self.P = recursive(
            *self.groups.size, self.x, self.P, *model, self.used[rows], gate, self.reset, *(a[rows] for a in out)
        )
        return stop

    def steady(self, start: int, stop: int, gate: float, model: Invariant, gains: Gains) -> int:
        """Run up to `stop`, or to the first sample that the gate refuses; return which."""
        from fusion_core.fast.loop import steady

        rows = slice(start, stop)
        x, u = self.x.copy(), self.u if len(self.u) == 1 else self.u[rows]
        steady(
            *self.groups.size, x, model.F, model.H, gains.kinds, gains.K, gains.root, u, self.z[rows],
            *(a[rows] for a in (self.x_all, self.y, self.white, self.nis)),
        )  # fmt: skip
        refused = ~(self.nis[rows] <= gate)  # NaN too
        if np.any(refused):
            stop = start + int(np.argmax(refused))
            if stop == start:
                return stop
            x = self.x_all[stop - 1].reshape(self.x.T.shape).T.copy()
            gains = gains.first(stop - start)
        rows = slice(start, stop)
        self.x, self.P = x, gains.last
        if len(gains.P) == 1 and stop - start == len(self.nis):  # all of it: nothing to write down for each sample
            self.sigma = np.broadcast_to(gains.sigma(), self.sigma.shape)
            self.log_det = np.broadcast_to(gains.log_det, self.log_det.shape)
        else:
            self.sigma[rows], self.log_det[rows] = gains.sigma(), gains.log_det
        if len(self.P_all):
            self.P_all[rows] = gains.P[:, gains.kind]
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
