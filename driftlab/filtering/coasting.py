"""The bias as it is predicted from the end of the alignment on, with no further measurement, and how sure that is.

From the departure at t_0 the blocks of the bias model go on alone::

    x_k = F x_{k-1} + u,    P_k = F P_{k-1} F' + Q

which is the departure's own deviation and the walk. What the model does not know of is added, an axis each::

    sigma^2 = P                                   departure and walk
            + Var(e(T) - e(T_0))                  the map's curve (`fusion_core.contracts.curve_error`)
            + sigma_T^2 (b'^2 + b'_0^2 - 2 rho b' b'_0)     the thermometer's error times the slope b' of the map
            + tilt^2                              the Earth rate that a tilted vertical leaves (`Alignment.unsure`)

rho = exp(-2 (t - t_0) / p) is how much of the thermometer's error is still that of the departure, p the time in which
the temperature crosses one of its steps. The running estimate has the same parts as far as its filter, with the gain
g = P / noise^2 a second, does not take them out again::

    sigma^2 = P + Var(e'(T)) (T - T_g)^2 + sigma_T^2 b'^2 / (1 + g p / 6) + tilt^2

T_g is the temperature through a first-order lag of 1 / g: what the curve was off by then is in the estimate already.
Steps crossed in the time p leave a sawtooth that forgets itself in about p / 6. N epochs, d axes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import FittedMap, Transition
from fusion_core.kalman import expected

FINE = 2001  # temperatures of the tables
SECANT = 2.0  # K over which the slope of the curve's error is taken


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


@dataclass
class Thermometer:
    """What a thermometer's own readings tell of its error, epoch by epoch.

    Steps are seen between readings that stay for two epochs, unless many small changes lead from one to the other;
    noise in second differences. `memory` holds the last two readings, how many there were, the settled one, the step,
    the time since the last step and what the last step took, the mean square of the noise, and the largest change
    since the settled reading.

    Parameters
    ----------
    resolution : float
        Step that is known beforehand, K.
    window : float
        Over which the temperature is averaged before the map sees it, s.
    """

    resolution: float
    window: float
    memory: Array = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, np.nan, *np.zeros(5)]))

    def look(self, chunk: Chunk) -> tuple[Array, Array]:
        """Return the variance (N,) of the error in K^2, and the time (N,) in s in which it becomes another."""
        T = chunk.channels.get("temperature_raw", chunk["temperature"])
        dt = np.full(len(T), chunk.dt)
        variance, lasting = np.empty(len(T)), np.empty(len(T))
        self.memory = self.memory.copy()
        _thermometer(T, dt, self.resolution, self.window, self.memory, variance, lasting)
        return variance, lasting


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _thermometer(
    T: Array, dt: Array, known: float, window: float, memory: Array, variance: Array, lasting: Array
) -> None:
    one, two, count, settled, step, since, took, noise, largest = memory
    known_period, passed = 0.0, 1.0  # what was worked out last
    for k in range(len(T)):
        since += dt[k]
        if count >= 1 and abs(T[k] - one) < 1e-6:
            if settled == settled and abs(T[k] - settled) > 1e-6:
                size = abs(T[k] - settled)
                seen = size if 2 * largest >= size else largest  # else a ramp of a fine thermometer
                step = seen if step == 0.0 else min(step, seen)
                took, since = since * step / size, 0.0
            settled, largest = T[k], 0.0
        elif count >= 1:
            largest = max(largest, abs(T[k] - one))
        if count >= 2:
            noise += ((T[k] - 2 * one + two) ** 2 / 6 - noise) / min(count - 1, 6000.0)
        one, two, count = T[k], one, count + 1
        q = max(step, known)
        lasting[k] = max(since, took) if q > 0 else window
        # a temperature that has not crossed a step yet may stand still: nothing is averaged away
        if took > 0 and lasting[k] != known_period:
            known_period, passed = lasting[k], _of_tooth(lasting[k], window / 2)
        variance[k] = q * q / 12 * passed + noise * min(1.0, 1.25 * dt[k] / (window / 2))
    memory[:] = np.array([one, two, count, settled, step, since, took, noise, largest])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _of_tooth(period: float, tau: float) -> float:
    """Return what part of a sawtooth's variance passes a straight line through weights exp(-age / tau).

    Its harmonics k have parts 6 / (pi k)^2, and the end of the line (Brown's double smoothing) answers to them with
    H(s) = (1 + 2 tau s) / (1 + tau s)^2; to white noise that is new every dt by 1.25 dt / tau.
    """
    passed, rest = 0.0, 1.0
    for k in range(1, 6):
        x = (2 * np.pi * k * tau / period) ** 2
        part = 6 / (np.pi * k) ** 2 if k < 5 else rest
        passed += part * (1 + 4 * x) / (1 + x) ** 2
        rest -= part
    return passed


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
        self.fitted, self.noise = fitted, noise
        self.lagged = np.full(len(noise), np.nan)  # T_g of each axis
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
        self.unsure = np.zeros_like(self.slope)  # variance of the slope
        if fitted.record.error is not None:
            self.unsure = np.ascontiguousarray(fitted.record.error.slope_variance(self.grid, SECANT))

    def departed(self, coast: Coast) -> None:
        """Take note of the temperature that coasting begins at."""
        if self.fitted is not None:
            self._between = np.ascontiguousarray(self.fitted.sigma(self.grid, coast.T_0) ** 2)
            k, share = _place(coast.T_0, self.low, self.step, FINE)
            self._slope_0 = (1 - share) * self.slope[k] + share * self.slope[k + 1]

    def of_estimate(
        self, P: Array, dt: Array, T: Array | None, error: tuple[Array, Array] | None, tilt: Array
    ) -> Array:
        """Return the deviation (N, d) of the running estimate from the variance P (N, d) of its states."""
        if self.fitted is None or T is None or error is None:
            return np.asarray(np.sqrt(P + tilt**2))
        if np.isnan(self.lagged[0]):
            self.lagged = np.full(len(self.noise), T[0])
        lagged, sigma = self.lagged.copy(), np.empty(P.shape)
        tables = (self.low, self.step, self.slope, self.unsure)
        _of_estimate(P, np.full(len(T), dt), T, *error, self.noise**2, tilt**2, *tables, lagged, sigma)
        self.lagged = lagged
        return sigma

    def of_coast(
        self, P: Array, coast: Coast, t: Array, T: Array | None, error: tuple[Array, Array] | None, tilt: Array
    ) -> Array:
        """Return the deviation (N, d) of the prediction at times t (N,) from the variance P (N, d) of its states."""
        if self._between is None or T is None or error is None:
            return np.asarray(np.sqrt(P + tilt**2))
        sigma = np.empty(P.shape)
        tables = (self.low, self.step, self.slope, self._between)
        _of_coast(P, t - coast.t_0, T, *error, tilt**2, *tables, self._slope_0, sigma)
        return sigma


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _place(T: float, low: float, step: float, count: int) -> tuple[int, float]:
    """Return the row of a table at or below T, and the share of the next one; the ends of a table go on level."""
    place = min(max((T - low) / step, 0.0), count - 1.0)
    k = min(int(place), count - 2)
    return k, place - k


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _of_estimate(
    P: Array, dt: Array, T: Array, error: Array, lasting: Array, noise: Array, tilt: Array,
    low: float, step: float, slope: Array, unsure: Array, lagged: Array, sigma: Array,
) -> None:  # fmt: skip
    for k in range(len(T)):
        i, share = _place(T[k], low, step, len(slope))
        for j in range(len(lagged)):
            b = (1 - share) * slope[i, j] + share * slope[i + 1, j]
            gain = P[k, j] / noise[j]
            lagged[j] += (T[k] - lagged[j]) * gain * dt[k] / (1 + gain * dt[k])
            moved = ((1 - share) * unsure[i, j] + share * unsure[i + 1, j]) * (T[k] - lagged[j]) ** 2
            sigma[k, j] = np.sqrt(P[k, j] + moved + error[k] * b * b / (1 + gain * lasting[k] / 6) + tilt[j])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _of_coast(
    P: Array, elapsed: Array, T: Array, error: Array, lasting: Array, tilt: Array,
    low: float, step: float, slope: Array, between: Array, slope_0: Array, sigma: Array,
) -> None:  # fmt: skip
    for k in range(len(T)):
        i, share = _place(T[k], low, step, len(slope))
        rho = np.exp(-2 * elapsed[k] / lasting[k])
        for j in range(len(slope_0)):
            b = (1 - share) * slope[i, j] + share * slope[i + 1, j]
            seen = error[k] * (b * b + slope_0[j] ** 2 - 2 * rho * b * slope_0[j])
            sigma[k, j] = np.sqrt(P[k, j] + (1 - share) * between[i, j] + share * between[i + 1, j] + seen + tilt[j])
