"""The bias as it is predicted from the end of the alignment on, with no further measurement, and how sure that is.

From the departure at t_0 the blocks of the bias model go on alone::

    x_k = F x_{k-1} + u,    P_k = F P_{k-1} F' + Q

which is the departure's own deviation and the walk. What the model does not know of is added, an axis each::

    sigma^2 = P                                   departure and walk
            + Var(e(T) - e(T_0))                  the map's curve (`fusion_core.contracts.curve_error`)
            + Var(y - l_0)                        the thermometer's error times the map's slope, l_0 as it departed
            + tilt^2                              the Earth rate that a tilted vertical leaves (`Alignment.unsure`)

The running estimate has the same parts as far as its filter, with the gain g = P tau / noise^2 an epoch, does not take
them out again: of an error e the part l = l + g (e - l) is learnt::

    sigma^2 = P + sum_i (m_i(T) - l_i)^2 + Var(y - l) + tilt^2

with the modes m_i of the map's error, and y and l of the thermometer (`driftlab.filtering.thermometer`).
N epochs, d axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from driftlab.filtering.thermometer import Following, ReadingError
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, Transition
from fusion_core.kalman import expected

FINE = 2001  # temperatures of the tables
NEAR = 0.1  # K that a temperature moves by, and what a filter learns of an error, before it is looked at again
LITTLE = 0.02


@dataclass
class Coast:
    """The prediction in progress: mean x (n,) and covariance P (n, n) of the bias states, and the departure."""

    x: Array
    P: Array
    t_0: float
    T_0: float  # degC; NaN where there is no thermometer

    def advance(self, N: int, step: Transition) -> tuple[Array, Array]:
        """Return the bias (N, d) that is predicted for the next N epochs, and its variance (N, d)."""
        x = expected(self.x, step, N)
        self.x = x[-1]
        variance, self.P = spread(self.P, step, N)
        return x if step.C is None else np.einsum("...ij,...j->...i", step.C, x), variance


def spread(P: Array, step: Transition, N: int) -> tuple[Array, Array]:
    """Return the variance (N, d) of C x over N steps from covariance P (n, n), and P after them."""
    F, Q = (a if a.ndim == 3 else a[None] for a in (step.F, step.Q))
    if step.C is None and _diagonal(F) and _diagonal(Q) and _diagonal(P[None]):
        f, q = (np.ascontiguousarray(np.diagonal(a, axis1=1, axis2=2)) for a in (F, Q))
        variance = np.empty((N, len(P)))
        _alone(np.diag(P).copy(), f, q, variance)
        return variance, np.diag(variance[-1])
    C = np.eye(len(P))[None] if step.C is None else step.C if step.C.ndim == 3 else step.C[None]
    variance, after = np.empty((N, C.shape[1])), P.copy()
    _together(after, np.ascontiguousarray(F), np.ascontiguousarray(Q), np.ascontiguousarray(C), variance)
    return variance, after


def _diagonal(matrices: Array) -> bool:
    return bool(np.count_nonzero(matrices) == np.count_nonzero(np.diagonal(matrices, axis1=1, axis2=2)))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _alone(P: Array, f: Array, q: Array, variance: Array) -> None:
    for k in range(len(variance)):
        for j in range(len(P)):
            P[j] = f[min(k, len(f) - 1), j] ** 2 * P[j] + q[min(k, len(q) - 1), j]
            variance[k, j] = P[j]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _together(P: Array, F: Array, Q: Array, C: Array, variance: Array) -> None:
    for k in range(len(variance)):
        F_k, C_k = F[min(k, len(F) - 1)], C[min(k, len(C) - 1)]
        P[:] = F_k @ P @ F_k.T + Q[min(k, len(Q) - 1)]
        CP = C_k @ P
        for j in range(len(C_k)):
            variance[k, j] = np.sum(CP[j] * C_k[j])


class Uncertainty:
    """What is added to the variances of a run because of its map, its thermometer and its vertical.

    Parameters
    ----------
    fitted : FittedMap or None
        The tracked sensor's.
    noise : (d,) array
        White-noise density of the tracked sensor.
    """

    def __init__(self, fitted: FittedMap | None, noise: Array) -> None:
        self.fitted, self.noise, d = fitted, noise, len(noise)
        self.following = self.departing = Following.start(d)  # of the running estimate, and of the coast
        self.learnt: Array = np.zeros((0, d))
        self._between: Array | None = None
        if fitted is None:
            return
        low, high = fitted.domain
        self.low, self.step = low - (high - low), 3 * (high - low) / (FINE - 1)
        self.grid: Array = self.low + self.step * np.arange(FINE, dtype=np.float64)
        inside = np.clip(self.grid, low, high)
        slope = fitted.slope(inside)
        beyond = (inside != self.grid)[:, None] & (fitted.outside == "clamp")
        self.slope = np.ascontiguousarray(np.where(beyond, 0.0, slope))
        error = fitted.record.error
        self.modes = np.zeros((FINE, 0, d)) if error is None else error.at(self.grid)
        # the modes as the filter has learnt them; at which temperature; the gain and the variance since
        self.learnt = np.zeros((self.modes.shape[1] + 3, d))
        self.learnt[-3] = np.nan

    def snapshot(self) -> tuple[Array, ...]:
        """Return what was learned so far."""
        return (*self.following.snapshot(), *self.departing.snapshot(), self.learnt.copy())

    def restore(self, snapshot: tuple[Array, ...]) -> None:
        """Go on from a snapshot."""
        self.following, self.departing = Following(*snapshot[:2]), Following(*snapshot[2:4])
        self.learnt = snapshot[4].copy()

    def departed(self, coast: Coast) -> None:
        """Take note of the temperature that coasting begins at, and of what the filter has learnt by then."""
        self.departing = Following(*self.following.snapshot())
        self._at_departure(coast)

    def resumed(self, coast: Coast) -> None:
        """Go on with a coast that departed earlier."""
        self._at_departure(coast)

    def _at_departure(self, coast: Coast) -> None:
        if self.fitted is not None:
            self._between = np.ascontiguousarray(self.fitted.sigma(self.grid, coast.T_0) ** 2)

    def of_estimate(self, P: Array, gain: Array, T: Array | None, error: ReadingError | None, tilt: Array) -> Array:
        """Return the deviation (N, d) of the running estimate from the variance P (N, d) of its states.

        `gain` (N, d) is how much of an error of its own an epoch takes out of it.
        """
        if self.fitted is None or T is None or error is None:
            return np.asarray(np.sqrt(P + tilt**2))
        variance = P + tilt**2 + self.following.advance(error, self._looked_up(self.slope, T), gain)
        self.learnt = self.learnt.copy()
        _of_map(T, gain, self.low, self.step, self.modes, self.learnt, variance)
        return np.asarray(np.sqrt(variance))

    def of_coast(self, P: Array, T: Array | None, error: ReadingError | None, tilt: Array) -> Array:
        """Return the deviation (N, d) of the prediction from the variance P (N, d) of its states."""
        if self._between is None or T is None or error is None:
            return np.asarray(np.sqrt(P + tilt**2))
        slope, between = self._looked_up(self.slope, T), self._looked_up(self._between, T)
        return np.asarray(np.sqrt(P + tilt**2 + between + self.departing.advance(error, slope, np.zeros_like(P))))

    def _looked_up(self, table: Array, T: Array) -> Array:
        """Return the values (N, d) of a table over the grid; its ends go on level."""
        found = np.empty((len(T), table.shape[1]))
        _look_up(T, self.low, self.step, table, found)
        return found


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _place(T: float, low: float, step: float, count: int) -> tuple[int, float]:
    """Return the row of a table at or below T, and the share of the next one; the ends of a table go on level."""
    place = min(max((T - low) / step, 0.0), count - 1.0)
    k = min(int(place), count - 2)
    return k, place - k


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _look_up(T: Array, low: float, step: float, table: Array, found: Array) -> None:
    for k in range(len(T)):
        i, share = _place(T[k], low, step, len(table))
        for j in range(table.shape[1]):
            found[k, j] = (1 - share) * table[i, j] + share * table[i + 1, j]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _of_map(T: Array, gain: Array, low: float, step: float, modes: Array, learnt: Array, variance: Array) -> None:
    """Add the variance of the map's error less what the filter has learnt of it, mode by mode.

    It is worked out where the temperature has moved, or the filter has learnt, by enough to make a difference.
    """
    r, d = modes.shape[1], modes.shape[2]
    for k in range(len(T)):
        new, since = learnt[r, 0] != learnt[r, 0], 0.0
        for j in range(d):
            learnt[r + 1, j] += -np.log(1 - min(gain[k, j], 1 - 1e-9))
            since = max(since, learnt[r + 1, j])
        if new or abs(T[k] - learnt[r, 0]) > NEAR or since > LITTLE:
            i, share = _place(T[k], low, step, len(modes))
            for j in range(d):
                kept, total = np.exp(-learnt[r + 1, j]), 0.0
                for m in range(r):
                    here = (1 - share) * modes[i, m, j] + share * modes[i + 1, m, j]
                    learnt[m, j] = here if new else here + (learnt[m, j] - here) * kept
                    total += (here - learnt[m, j]) ** 2
                learnt[r, j], learnt[r + 1, j], learnt[r + 2, j] = T[k], 0.0, total
        for j in range(d):
            variance[k, j] += learnt[r + 2, j]
