"""The Kalman filter over arrays: one call for a stretch of samples.

Two roads give the same estimates, both group by group of states that have nothing to do with one another. The *long
road* carries the covariance through every sample. The *short road* (`fusion_core.steady`) is taken where F, Q, H and R
are the same at every step, every sample is measured, and the covariance has come to its steady state; a sample that
the gate refuses leads back to the long road for as long as that takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Transition
from fusion_core.groups import Groups, find_groups
from fusion_core.model import Estimates, Flags, Measurement, State
from fusion_core.steady import SETTLED, steady_state

Road = Literal["auto", "long", "short"]

DETOUR = 256  # samples on the long road before it is asked whether the covariance has settled
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
    steady: _SteadyGroups | None = None
    if transition.invariant and measurement.invariant and road != "long":
        groups, steady = _steady(*((a.tobytes(), a.shape) for a in (F, Q, H, r, state.P != 0)))
    else:
        groups = find_groups(F, Q, H, state.P)
    if road == "short" and steady is None:
        raise ValueError("the short road needs constant F, Q, H, R, every sample measured, and a steady state")
    no_state = np.zeros(len(state.x), dtype=np.bool_)
    job = _Job(state, (F, Q, u, z, H, r), groups, measurement.used, no_state if volatile is None else volatile, keep_P)
    start, span, N = 0, SPAN, len(z)
    while start < N:
        if steady is None:
            start = job.long_road(start, N, gate)
        elif not steady.reached_by(job.P):
            start = job.long_road(start, min(N, start + DETOUR), gate)
        else:
            start, span = job.short_road(start, min(N, start + span), gate, steady), 4 * span
            if start < N and job.nis[start] > gate:  # to be judged again, with what led to it
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


@dataclass(frozen=True)
class _SteadyGroups:
    """The steady state of each of G groups of s states and c components, as the compiled loop wants it."""

    F: Array
    H: Array
    K: Array
    P: Array
    whitener: Array  # (G, c, c), inverse of the Cholesky factor of S
    log_det: float

    def reached_by(self, P: Array) -> bool:
        """Whether covariances (G, s, s) are the steady ones, but for rounding."""
        sigma = np.sqrt(np.diagonal(self.P, axis1=1, axis2=2))
        return bool(np.all(np.abs(P - self.P) <= SETTLED * sigma[:, :, None] * sigma[:, None, :]))


@lru_cache(maxsize=64)  # a recording comes in many stretches of the same model
def _steady(*arrays: tuple[bytes, tuple[int, ...]]) -> tuple[Groups, _SteadyGroups | None]:
    """Return the groups of an invariant model (F, Q, H, r and where P is not zero), and their steady state."""
    F, Q, H, r = (np.frombuffer(data).reshape(shape) for data, shape in arrays[:-1])
    groups = find_groups(
        F, Q, H, np.frombuffer(arrays[-1][0], dtype=np.bool_).reshape(arrays[-1][1]).astype(np.float64)
    )
    places = [(a[a < F.shape[1]], b[b < r.shape[1]]) for a, b in zip(groups.states, groups.rows, strict=True)]
    found = [
        steady_state(F[0][np.ix_(a, a)], Q[0][np.ix_(a, a)], H[0][np.ix_(b, a)], np.diag(r[0][b])) for a, b in places
    ]
    each = [one for one in found if one is not None]
    if len(each) < len(found):
        return groups, None
    s, c = groups.states.shape[1], groups.rows.shape[1]
    roots = [np.linalg.cholesky(one.S) for one in each]

    def stack(matrices: list[Array], rows: int, columns: int) -> Array:
        return np.stack([np.pad(a, ((0, rows - a.shape[0]), (0, columns - a.shape[1]))) for a in matrices])

    return groups, _SteadyGroups(
        F=stack([one.F for one in each], s, s),
        H=stack([one.H for one in each], c, s),
        K=stack([one.K for one in each], s, c),
        P=stack([one.P for one in each], s, s),
        whitener=stack([np.asarray(np.linalg.inv(root)) for root in roots], c, c),
        log_det=2 * sum(float(np.sum(np.log(np.diag(root)))) for root in roots),
    )


class _Job:
    """One call in progress: the state group by group, and the estimates so far.

    Where groups had to be filled up, the model has one more state and component, which are zero.
    """

    def __init__(
        self, state: State, arrays: tuple[Array, ...], groups: Groups, used: Flags, volatile: Flags, keep_P: bool
    ) -> None:
        self.groups, self.used, self.volatile = groups, used.copy(), volatile
        self.n, self.m = len(state.x), arrays[3].shape[1]
        x, P = state.x, state.P
        if groups.padded:
            more = ((0, 1),)
            self.volatile = np.pad(volatile, more)
            F, Q, u, z, H, r = arrays
            arrays = (
                *(np.pad(a, ((0, 0), (0, 1), (0, 1))) for a in (F, Q)), *(np.pad(a, ((0, 0), (0, 1))) for a in (u, z)),
                np.pad(H, ((0, 0), (0, 1), (0, 1))), np.pad(r, ((0, 0), (0, 1)), constant_values=1.0),
            )  # fmt: skip
            x, P = np.pad(x, more), np.pad(P, more * 2)
        self.arrays = arrays
        N, n, m = len(used), len(x), arrays[3].shape[1]
        self.x, self.P = x[groups.states], groups.blocks(P)
        self.x_all, self.sigma = np.empty((N, n)), np.empty((N, n))
        self.y, self.white = np.empty((N, m)), np.empty((N, m))
        self.nis, self.log_det = np.empty(N), np.empty(N)
        self.P_all = np.zeros((N if keep_P else 0, n, n))

    def long_road(self, start: int, stop: int, gate: float) -> int:
        from fusion_core.kernels import long_road

        rows = slice(start, stop)
        model = (a if len(a) == 1 else a[rows] for a in self.arrays)
        out = (self.x_all, self.sigma, self.y, self.white, self.nis, self.log_det, self.P_all)
        long_road(
            *self.groups.shape, self.groups.states, self.groups.rows, self.x, self.P, *model, self.used[rows], gate,
            self.volatile, *(a[rows] for a in out),
        )  # fmt: skip
        return stop

    def short_road(self, start: int, stop: int, gate: float, steady: _SteadyGroups) -> int:
        """Run up to `stop`, or to the first sample that the gate refuses; return which."""
        from fusion_core.kernels import short_road

        rows = slice(start, stop)
        u, z = (a if len(a) == 1 else a[rows] for a in self.arrays[2:4])
        x = self.x.copy()
        short_road(
            *self.groups.shape, self.groups.states, self.groups.rows, x, steady.F, steady.H, steady.K, steady.whitener,
            u, z, *(a[rows] for a in (self.x_all, self.y, self.white, self.nis)),
        )  # fmt: skip
        refused = self.nis[rows] > gate
        if np.any(refused):
            stop = start + int(np.argmax(refused))
            x = self.x_all[stop - 1][self.groups.states] if stop > start else self.x
        self.x, self.P = x, steady.P.copy()
        rows = slice(start, stop)
        P = self._whole(self.P)
        if stop - start == len(self.nis):  # all of it: nothing to write down for each sample
            self.sigma = np.broadcast_to(np.sqrt(np.diag(P)), self.sigma.shape)
            self.log_det = np.broadcast_to(np.float64(steady.log_det), self.log_det.shape)
        else:
            self.sigma[rows], self.log_det[rows] = np.sqrt(np.diag(P)), steady.log_det
        if len(self.P_all):
            self.P_all[rows] = P
        return stop

    def _whole(self, blocks: Array) -> Array:
        P = np.zeros((self.sigma.shape[1],) * 2)
        P[self.groups.states[:, :, None], self.groups.states[:, None, :]] = blocks
        return P

    def estimates(self, root: Array | None) -> Estimates:
        """Return what was found; `root` takes the innovations back to where R was not diagonal."""
        n, m = self.n, self.m
        x = np.zeros(self.sigma.shape[1])
        x[self.groups.states] = self.x
        y, log_det = self.y[:, :m], self.log_det
        if root is not None:
            y = np.einsum("...ij,...j->...i", root, y)
            log_det = log_det + 2 * np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
        return Estimates(
            self.x_all[:, :n], self.sigma[:, :n], y, self.white[:, :m], self.nis, log_det, self.used,
            State(x[:n], self._whole(self.P)[:n, :n]), self.P_all[:, :n, :n] if len(self.P_all) else None,
        )  # fmt: skip
