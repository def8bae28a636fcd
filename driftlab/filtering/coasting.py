"""Prediction without updates: the bias from the end of the alignment on, no further measurement, and its deviation.

From the departure at t_0 the blocks of the bias model go on alone::

    x_k = F x_{k-1} + u,    P_k = F P_{k-1} F' + Q

which is the departure's own deviation and the walk. Errors outside the model are added, an axis each::

    sigma^2 = P                                   departure and walk
            + Var(e(T) - e(T_0))                  the map's curve (`fusion_core.thermal.curve_error`)
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
from typing import Any, NamedTuple

import numpy as np

from driftlab.filtering.extrapolation import Extrapolation
from driftlab.filtering.setup import RunSetup
from driftlab.filtering.thermometer import ReadingError, ThermometerError, copied
from fusion_core import recursions
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Alignment, FittedMap, State, ThermalBias, Transition
from fusion_core.fast import compiled, inlined
from fusion_core.model import Estimates
from fusion_core.thermal.thermometer import NO_STEPS

FINE = 2001  # temperatures of the tables
NEAR = 0.1  # K that a temperature moves by, and what a filter learns of an error, before it is looked at again
LITTLE = 0.02


@dataclass
class Coast:
    """The prediction in progress: mean x (n,) and covariance P (n, n) of the bias states, and the departure."""

    x: Array
    P: Array
    T_0: float  # degC; NaN where there is no thermometer

    def advance(self, N: int, step: Transition) -> tuple[Array, Array]:
        """Return the bias (N, d) that is predicted for the next N epochs, and its variance (N, d)."""
        F = step.F if step.F.ndim == 3 else step.F[None]
        u = step.u if step.u.ndim == 2 else np.broadcast_to(step.u, (N, len(self.x)))
        x = np.empty(u.shape)
        recursions.drift(self.x, F, np.ascontiguousarray(u), x)
        self.x = x[-1]
        variance, self.P = spread(self.P, step, N)
        return x if step.C is None else np.einsum("...ij,...j->...i", step.C, x), variance


def spread(P: Array, step: Transition, N: int) -> tuple[Array, Array]:
    """Return the variance (N, d) of C x over N steps from covariance P (n, n), and P after them."""
    F, Q = (a if a.ndim == 3 else a[None] for a in (step.F, step.Q))
    after, variance = P.copy(), np.empty((N, len(P)))
    if step.C is None and _alone(after, F, Q, variance):
        return variance, after
    C = np.eye(len(P))[None] if step.C is None else step.C if step.C.ndim == 3 else step.C[None]
    variance, after = np.empty((N, C.shape[1])), P.copy()
    _together(after, np.ascontiguousarray(F), np.ascontiguousarray(Q), np.ascontiguousarray(C), variance)
    return variance, after


@compiled
def _alone(P: Array, F: Array, Q: Array, variance: Array) -> bool:
    """Go on from P, state by state; return whether all of them are alone (P, F and Q diagonal), else nothing counts."""
    n = len(P)
    for k in range(len(variance)):
        k_F, k_Q = min(k, len(F) - 1), min(k, len(Q) - 1)
        if k < max(len(F), len(Q)):  # else the same as before
            for i in range(n):
                for j in range(n):
                    if i != j and (F[k_F, i, j] != 0 or Q[k_Q, i, j] != 0 or P[i, j] != 0):
                        return False
        for i in range(n):
            P[i, i] = variance[k, i] = F[k_F, i, i] ** 2 * P[i, i] + Q[k_Q, i, i]
    return True


@compiled
def _together(P: Array, F: Array, Q: Array, C: Array, variance: Array) -> None:
    for k in range(len(variance)):
        F_k, C_k = F[min(k, len(F) - 1)], C[min(k, len(C) - 1)]
        after, Q_k = F_k @ P @ F_k.T, Q[min(k, len(Q) - 1)]
        for i in range(len(P)):
            for j in range(len(P)):
                P[i, j] = after[i, j] + Q_k[i, j]
        CP = C_k @ P
        for j in range(len(C_k)):
            variance[k, j] = np.sum(CP[j] * C_k[j])


class Uncertainty:
    """Variances that a run's map, thermometer and vertical add to those of its states.

    Parameters
    ----------
    fitted : FittedMap or None
        The tracked sensor's.
    noise : (d,) array
        White-noise density of the tracked sensor.
    """

    def __init__(self, fitted: FittedMap | None, noise: Array) -> None:
        self.fitted, self.noise, self.noise_squared, d = fitted, noise, noise**2, len(noise)
        # c, h and the imaginary c of both parts of the thermometer's error: of the running estimate, and of the coast
        self.following, self.departing = np.zeros((3, 2, d)), np.zeros((3, 2, d))
        self.learnt, self._between = np.zeros((0, d)), np.zeros((FINE, d))
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
        """Return the state so far."""
        return self.following.copy(), self.departing.copy(), self.learnt.copy()

    def restore(self, snapshot: tuple[Array, ...]) -> None:
        """Go on from a snapshot."""
        self.following, self.departing, self.learnt = copied(snapshot, self.snapshot())

    def depart(self, coast: Coast) -> None:
        """Begin a prediction with the filter's estimate of the errors so far."""
        self.departing = self.following.copy()
        self.resume(coast)

    def resume(self, coast: Coast) -> None:
        """Go on with a prediction that departed earlier."""
        if self.fitted is not None:
            self._between = np.ascontiguousarray(self.fitted.sigma(self.grid, coast.T_0) ** 2)

    def deviations(
        self, variances: tuple[Array, Array], weight: Array, T: Array | None, error: ReadingError | None,
        tilts: tuple[Array, Array],
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the deviations (N, d) of running estimate and prediction, from the variances (N, d) of their states.

        Each has a vertical (d,) of its own. `weight` (N,) is how long each epoch was measured for, s.
        """
        squares = tilts[0] ** 2, tilts[1] ** 2
        if self.fitted is None or T is None or error is None:
            return np.sqrt(variances[0] + squares[0]), np.sqrt(variances[1] + squares[1])
        sigmas = np.empty(variances[1].shape), np.empty(variances[1].shape)
        tables = self.low, self.step, self.slope, self.modes, self._between
        memory = self.following, self.departing, self.learnt
        of_states = map(np.ascontiguousarray, variances)
        _deviations(T, *error, *of_states, weight, self.noise_squared, *squares, *tables, *memory, *sigmas)
        return sigmas


@compiled
def _place(T: float, low: float, step: float, count: int) -> tuple[int, float]:
    """Return the row of a table at or below T, and the share of the next one; the ends of a table go on level."""
    place = min(max((T - low) / step, 0.0), count - 1.0)
    k = min(int(place), count - 2)
    return k, place - k


@compiled
def _deviations(
    T: Array, error: Array, left: Array, P: Array, P_coast: Array, weight: Array, noise: Array, tilt: Array,
    tilt_coast: Array, low: float, step: float, slope: Array, modes: Array, between: Array, following: Array,
    departing: Array, learnt: Array, sigma: Array, sigma_coast: Array,
) -> None:  # fmt: skip
    r, d = modes.shape[1], modes.shape[2]
    known, passed, last = np.zeros((3, d)), np.empty((3, d)), -1.0  # variance, gain and its logarithm worked out last
    known[0] = -1.0
    for k in range(len(T)):
        i, share = _place(T[k], low, step, len(slope))
        if weight[k] != last:
            known[0], last = -1.0, weight[k]
        since = 0.0
        for j in range(d):
            if P[k, j] != known[0, j]:
                _gain(P[k, j], last, noise[j], j, known)
                g = known[1, j]
                passed[0, j], passed[1, j], passed[2, j] = (1 - g) ** 2, 2 * g * (1 - g), g * g
            learnt[r + 1, j] += known[2, j]
            since = max(since, learnt[r + 1, j])
        if learnt[r, 0] != learnt[r, 0] or abs(T[k] - learnt[r, 0]) > NEAR or since > LITTLE:
            _learn(T[k], i, share, modes, learnt)
        root = np.sqrt(error[k, 0]), np.sqrt(error[k, 1])
        for j in range(d):
            b = (1 - share) * slope[i, j] + share * slope[i + 1, j]
            total, total_coast = _reading_errors(b, root, left, k, known[1, j], passed, j, following, departing)
            apart = (1 - share) * between[i, j] + share * between[i + 1, j]
            sigma[k, j] = np.sqrt(P[k, j] + tilt[j] + total + learnt[r + 2, j])
            sigma_coast[k, j] = np.sqrt(P_coast[k, j] + tilt_coast[j] + apart + total_coast)


@inlined
def _reading_errors(
    b: float,
    root: tuple[float, float],
    left: Array,
    k: int,
    g: float,
    passed: Array,
    j: int,
    following: Array,
    departing: Array,
) -> tuple[float, float]:
    """Go on to epoch k with both parts of the thermometer's error in axis j, y; return what is left of their variance.

    That is in the running estimate, of gain g, and in the prediction.
    """
    total = total_coast = 0.0
    for m in range(2):
        y, kept, kept_coast = b * root[m], left[k, m] * following[0, m, j], left[k, m] * departing[0, m, j]
        if m == 0:
            turned = left[k, 0] * following[2, 0, j] + left[k, 2] * following[0, 0, j]
            turned_coast = left[k, 0] * departing[2, 0, j] + left[k, 2] * departing[0, 0, j]
            kept, kept_coast = kept - left[k, 2] * following[2, 0, j], kept_coast - left[k, 2] * departing[2, 0, j]
            following[2, 0, j], departing[2, 0, j] = _unless_tiny((1 - g) * turned), _unless_tiny(turned_coast)
        h = passed[0, j] * following[1, m, j] + passed[1, j] * kept * y + passed[2, j] * y * y
        c, c_coast = _unless_tiny((1 - g) * kept + g * y), _unless_tiny(kept_coast)
        following[0, m, j], following[1, m, j], departing[0, m, j] = c, _unless_tiny(h), c_coast
        total += max(y * y - 2 * y * c + h, 0.0)
        total_coast += max(y * y - 2 * y * c_coast + departing[1, m, j], 0.0)
    return total, total_coast


@compiled
def _gain(P: float, weight: float, noise: float, j: int, known: Array) -> None:
    """Work out how much of an error of its own an epoch takes out of axis j of the estimate, and the logarithm."""
    gain = min(P * weight / noise, 1.0)
    if j > 0 and gain == known[1, j - 1]:
        known[2, j] = known[2, j - 1]
    else:
        known[2, j] = -np.log(1 - min(gain, 1 - 1e-9))
    known[0, j], known[1, j] = P, gain


@compiled
def _unless_tiny(x: float) -> float:
    """Return x, and 0 where it is too small to matter: a processor takes long over such numbers."""
    return x if abs(x) > 1e-200 else 0.0


@compiled
def _learn(T: float, i: int, share: float, modes: Array, learnt: Array) -> None:
    """Work out the variance of the map's error less what the filter has learnt of it, mode by mode.

    That is where the temperature has moved, or the filter has learnt, by enough to make a difference.
    """
    r, d = modes.shape[1], modes.shape[2]
    new = learnt[r, 0] != learnt[r, 0]
    for j in range(d):
        kept, total = np.exp(-learnt[r + 1, j]), 0.0
        for m in range(r):
            here = (1 - share) * modes[i, m, j] + share * modes[i + 1, m, j]
            learnt[m, j] = here if new else here + (learnt[m, j] - here) * kept
            total += (here - learnt[m, j]) ** 2
        learnt[r, j], learnt[r + 1, j], learnt[r + 2, j] = T, 0.0, total


class BiasOutput(NamedTuple):
    """Bias and deviation, by the filter and by prediction, (N, d) each; of the latter NaN before the departure."""

    bias: Array
    sigma: Array
    coast: Array
    coast_sigma: Array


class Prediction:
    """The bias of the tracked sensor, estimated and predicted, with all parts of its deviation.

    Parameters
    ----------
    plan : RunSetup
    first : Alignment
        From which on it is predicted.
    """

    def __init__(self, plan: RunSetup, first: Alignment) -> None:
        tracked, fitted = plan.model.tracked, plan.fitted
        self.block = plan.model.places[tracked.channel]
        self.effects = isinstance(tracked.bias, ThermalBias) and bool(tracked.bias.effects)
        self.first = first
        self.coast: Coast | None = None  # from the end of the first alignment on
        known = NO_STEPS if fitted is None else fitted.record.steps
        self.thermometer = ThermometerError(known, plan.model.temperature_rate.memory_s)
        self.uncertainty = Uncertainty(fitted, tracked.noise)
        self.extrapolation = Extrapolation(tracked.bias)
        self.departed = np.zeros(len(tracked.axes))  # the extrapolation then

    def snapshot(self) -> dict[str, Any]:
        """Return the state so far."""
        return {
            "coast": self.coast,
            "thermometer": self.thermometer.snapshot(),
            "uncertainty": self.uncertainty.snapshot(),
            "extrapolated": (
                self.extrapolation.memories,
                self.extrapolation.last,
                self.extrapolation.lagged,
                self.departed,
            ),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self.coast = snapshot["coast"]
        self.thermometer.restore(snapshot["thermometer"])
        self.uncertainty.restore(snapshot["uncertainty"])
        own = self.extrapolation
        own.memories, own.last, own.lagged, self.departed = snapshot["extrapolated"]
        if self.coast is not None:
            self.uncertainty.resume(self.coast)

    def depart(self, state: State, T_0: float) -> None:
        """Begin to predict from the state at the end of the alignment, at T_0 in degC (NaN: not known)."""
        block = self.block
        self.coast = Coast(state.x[block], state.P[block, block], T_0)
        self.uncertainty.depart(self.coast)
        self.departed = self.extrapolation.last

    def look(self, done: Chunk, estimates: Estimates, step: Transition, tilt: Array, calibration: Array) -> BiasOutput:
        """Return the bias over the next epochs, whose block went by `step`; `calibration` (N, d) was subtracted.

        `tilt` (d,) is the deviation that the vertical leaves.
        """
        T = done.channels.get("temperature")
        error = None if T is None else self.thermometer.look(done)
        states, at, variance = _output(estimates, self.block, step.C)
        x = self.extrapolation.look(done)
        left = self.extrapolation.of_estimate(x, variance, done.dt, self.uncertainty.noise)
        if self.coast is None:
            coast = ahead = np.full(variance.shape, np.nan)
        else:
            coast, ahead = self.coast.advance(len(done), step)
        weight, tilts = done["tau"] * estimates.used, (tilt, self.first.unsure)
        sigma, coast_sigma = self.uncertainty.deviations((variance, ahead), weight, T, error, tilts)
        sigma = sigma if left is None else np.hypot(sigma, left)
        if self.extrapolation.effects and (x is not None or np.count_nonzero(self.departed)):
            coast_sigma = np.hypot(coast_sigma, (0.0 if x is None else x) - self.departed)
        known = np.ascontiguousarray(calibration if calibration.strides[0] else calibration[:1])
        drift = step.u if step.C is None else np.einsum("...ij,...j->...i", step.C, step.u)
        drift = drift if drift.ndim == 2 else drift[None]
        # half a step more of effects is more noise: their channels are not smoothed
        share = 0.0 if self.effects else 0.5
        bias, ahead = np.empty(coast.shape), np.empty(coast.shape)
        _to_the_end(states, at, coast, share, done["tau"], done.dt.reshape(-1), drift, known, bias, ahead)
        return BiasOutput(bias, sigma, ahead, coast_sigma)


@compiled
def _to_the_end(
    states: Array, at: int, coast: Array, share: float, tau: Array, dt: Array, drift: Array, calibration: Array,
    bias: Array, ahead: Array,
) -> None:  # fmt: skip
    """Write the bias, of states (N, n) from place `at` on, and the prediction (N, d) at the ends of the epochs.

    That is with a `share` of the known drift (N or 1, d) of tau (N,) in dt (N or 1,) s, from the middle of an epoch, of
    which it is, to its end; and with the calibration (N or 1, d).
    """
    N, d = coast.shape
    for k in range(N):
        k_u, k_c, dt_k = min(k, len(drift) - 1), min(k, len(calibration) - 1), dt[min(k, len(dt) - 1)]
        part = tau[k] / dt_k * share if dt_k > 0 else 0.0
        for j in range(d):
            late, known = part * drift[k_u, j], calibration[k_c, j]
            bias[k, j], ahead[k, j] = states[k, at + j] + late + known, coast[k, j] + late + known


def _output(estimates: Estimates, block: slice, C: Array | None) -> tuple[Array, int, Array]:
    """Return states that hold the bias, from which place on, and its variance (N, d), from the states of its block."""
    if C is None:
        return estimates.x, block.start, estimates.sigma[:, block] ** 2
    assert estimates.P is not None, "the deviation of an output needs P"
    variance = np.einsum("...ij,...jl,...il->...i", C, estimates.P[:, block, block], C)
    return np.einsum("...ij,...j->...i", C, estimates.x[:, block]), 0, variance
