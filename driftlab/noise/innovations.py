"""Inflation: the factors on noise and walk with which a run's innovations are as large as the model predicts.

A sensor's reading d less what was predicted of its bias is a level and white noise, on each axis::

    d_k = b_k + n_k,    n_k ~ N(0, (alpha noise)^2 / tau_k),    b_k - b_{k-1} ~ N(0, (beta walk)^2 dt_k)

alpha and beta are those that make the innovations of the filter of this model most likely (R. K. Mehra, IEEE Trans.
Automatic Control 15 (1970) 175): at a given beta / alpha, alpha^2 is the mean NIS at alpha = 1. How sure they are is
measured: with the score g_b of each of B parts of the run and the second derivatives A of the log-likelihood,

    Cov(log alpha, log beta) = A^-1 (sum g_b g_b') A^-1

which holds where noise is not quite white or Gaussian too (H. White, Econometrica 50 (1982) 1). Steps of one update
decide; the bias over longer times is tested apart, by the differences of adjacent means m_j over a lag L::

    E (m_{j+1} - m_j)^2 = 2 (alpha noise)^2 / L + 2/3 (beta walk)^2 L

N updates, d axes, K lags.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from driftlab.noise.local_level import LevelLikelihood, minimum_near
from fusion_core.chunk import Array, Flags
from fusion_core.contracts import Factor, Inflation, Lag
from fusion_core.errors import SingularFit

LAGS = (10.0, 60.0, 600.0, 3600.0)  # s
MIN_DIFFERENCES = 8  # at a lag: with fewer it says nothing
MIN_UPDATES = 300
PARTS = 16  # of a run, whose scores give the deviation of the factors
SPAN = (-25.0, 25.0)  # of log((beta / alpha)^2)
TWO_SIDED = 1.96  # deviations: 95 %
DROP = 1.92  # of a log-likelihood: 95 %
UNKNOWN = 20.0  # deviation of a logarithm that is not known
STEP = 0.02  # of log alpha and log beta, over which derivatives are taken
PRESENT = 0.9  # of a lag that must have been measured
FALSE_ALARM = 1e-3  # of a lag: there are a dozen of them


@dataclass(frozen=True)
class SensorReadings:
    """Readings d (N, d) of a sensor less the predicted part of its bias; NaN where they do not count.

    `t` (N,) is the time, `tau` (N,) how long each lasted, s; `fresh` (N,) is true where the prediction starts anew.
    """

    t: Array
    tau: Array
    d: Array
    fresh: Flags


def inflation(readings: SensorReadings, noise: Array, walk: Array) -> Inflation:
    """Return the factors on white noise and walk, both (d,) and declared in unit/sqrt(Hz) and unit/sqrt(s).

    Raises SingularFit if fewer than MIN_UPDATES updates count, or a declared density is zero.
    """
    count = int(np.sum(np.all(np.isfinite(readings.d), axis=1)))
    if count < MIN_UPDATES:
        raise SingularFit(
            f"inflation of the noise: only {count} updates at rest count, at least {MIN_UPDATES} are needed; "
            "use a run of a longer recording"
        )
    if np.any(noise <= 0) or np.any(walk <= 0):
        raise SingularFit("inflation of the noise: noise or walk is declared zero; declare both larger than zero")
    axes = [_Axis(readings, k, float(noise[k]), float(walk[k])) for k in range(readings.d.shape[1])]
    factors = np.array([axis.factors() for axis in axes])  # (d, 2, 3)
    white, walked = (Factor(*factors[:, k].T) for k in (0, 1))
    variances = (white.value * noise) ** 2, (walked.value * walk) ** 2
    lags = [_lag(readings, L, *variances, walk) for L in LAGS]
    return Inflation(noise, walk, white, walked, tuple(lag for lag in lags if lag is not None))


class _Axis:
    """The likelihood of one axis, in units of its declared noise."""

    def __init__(self, readings: SensorReadings, axis: int, noise: float, walk: float) -> None:
        d = readings.d[:, axis] / noise
        dt = np.diff(readings.t, prepend=readings.t[0])
        dt[readings.fresh] = dt[0] = np.inf  # the level is unknown
        self.likelihood = LevelLikelihood([(d[:, None], np.where(np.isfinite(d), 1 / readings.tau, np.inf), dt)])
        self.starts = -(-np.arange(PARTS) * len(d) // PARTS)
        self.declared = (walk / noise) ** 2

    def concentrated(self, log_ratio: float) -> tuple[float, float]:
        """Return alpha^2, and less the log-likelihood at it."""
        cost, a, _ = self.likelihood.at(self.declared * float(np.exp(log_ratio)))
        return float(a[0]), 0.5 * float(cost[0])

    def log_likelihood(self, theta: Array) -> Array:
        """Return the log-likelihood (B,) of log alpha and log beta."""
        y, S = self.likelihood.rows(self.declared * float(np.exp(2 * (theta[1] - theta[0]))))[0]
        terms = y[:, 0] ** 2 * np.exp(-2 * theta[0]) + np.where(np.isfinite(S), np.log(S) + 2 * theta[0], 0.0)
        return np.asarray(-0.5 * np.add.reduceat(terms, self.starts))

    def factors(self) -> Array:
        """Return value, low and high of alpha and of beta (2, 3)."""
        best = minimum_near(lambda v: self.concentrated(v)[1], np.linspace(*SPAN, 26))
        a, least = self.concentrated(best)
        theta = np.array([0.5 * np.log(a), 0.5 * (np.log(a) + best)])
        sigma = np.minimum(self._sigma(theta), UNKNOWN)
        reach = np.exp(np.outer(theta, np.ones(3)) + TWO_SIDED * np.outer(sigma, [0.0, -1.0, 1.0]))
        if not sigma[1] < 1:  # hardly any walk shows: an upper limit is all there is
            reach[1, 1:] = 0.0, self._upper(best, least)
        return reach

    def _sigma(self, theta: Array) -> Array:
        """Return the deviation (2,) of log alpha and log beta; infinite where the likelihood is flat."""
        steps = STEP * np.eye(2)
        score = np.stack([self.log_likelihood(theta + s) - self.log_likelihood(theta - s) for s in steps]) / (2 * STEP)
        each = {
            (i, j): float(np.sum(self.log_likelihood(theta + i * steps[0] + j * steps[1])))
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        }
        first, second = (each[p] - 2 * each[0, 0] + each[q] for p, q in (((1, 0), (-1, 0)), ((0, 1), (0, -1))))
        mixed = (each[1, 1] - each[1, -1] - each[-1, 1] + each[-1, -1]) / 4
        A = -np.array([[first, mixed], [mixed, second]]) / STEP**2
        if not (A[0, 0] > 0 and np.linalg.det(A) > 0):
            return np.array([1 / np.sqrt(max(A[0, 0], 1e-300)), np.inf])
        inverse = np.linalg.inv(A)
        spread = inverse @ (score @ score.T) @ inverse
        return np.asarray(np.sqrt(np.maximum(np.diag(spread), np.diag(inverse))))

    def _upper(self, best: float, least: float) -> float:
        """Return the largest beta that the likelihood allows."""
        beyond = [v for v in np.linspace(best, SPAN[1], 400) if self.concentrated(float(v))[1] - least < DROP]
        top = float(max(beyond, default=best))
        return float(np.sqrt(self.concentrated(top)[0] * np.exp(top)))


def _lag(readings: SensorReadings, L: float, white: Array, walk: Array, declared: Array) -> Lag | None:
    """Test the variances of white noise and walk, each (d,), by differences of means over L seconds."""
    use = np.all(np.isfinite(readings.d), axis=1)
    weight = np.where(use, readings.tau, 0.0)
    # a new prediction begins a new series: two places further, so that no difference leads across
    place = np.floor((readings.t - readings.t[0]) / L).astype(np.int64) + 2 * np.cumsum(readings.fresh)
    total = np.bincount(place, weight)
    d = np.where(use[:, None], readings.d, 0.0)
    sums = np.stack([np.bincount(place, weight * column) for column in d.T], axis=1)
    means = np.where((total >= PRESENT * L)[:, None], sums / np.maximum(total, 1e-300)[:, None], np.nan)
    steps = np.diff(means, axis=0)
    steps = steps[np.isfinite(steps).all(axis=1)]
    J = len(steps)
    if J < MIN_DIFFERENCES or 2 * float(np.median(readings.tau)) > L:
        return None
    square, noise, drift = np.mean(steps**2, axis=0), 2 * white / L, 2 / 3 * walk * L
    expected = noise + drift
    # adjacent differences share a mean: correlation -1/2 of white noise, 1/4 of a walk
    correlation = (drift / 4 - noise / 2) / expected
    freedom = J / (1 + 2 * correlation**2)
    high = np.sqrt(special.chdtri(freedom, FALSE_ALARM) / freedom)
    need = np.sqrt(np.maximum(square - noise, 0.0) / (2 / 3 * L)) / declared
    return Lag(L, np.sqrt(square / expected), high, need, J)
