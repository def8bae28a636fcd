"""Local level: a random walk under white noise, its filter on rows, its estimate, and the spectrum of residuals.

A bias that walks under white noise is a local level; its filter's normalised innovations are white, and the filter is
linear. So the same filter run on a column of a model gives that column's part of the innovations, and ordinary
least squares on these is generalised least squares on the rows. R rows, m columns.

A random walk seen through white noise is predicted best by an exponential average (the steady filter of a local
level): with gain g and one-step error of variance S, the white noise of a row has variance (1 - g) S and the walk
g^2 S a row. J. F. Muth, J. Am. Stat. Assoc. 55 (1960) 299. So the gain of least one-step error is the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from fusion_core.chunk import Array
from fusion_core.model import Flags


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def whitened(columns: Array, white: Array, walk: Array) -> Array:
    """Return columns (R, m) as normalised innovations (R, m) of a local level that begins at 0.

    Parameters
    ----------
    columns : (R, m) array
    white : (R,) array
        Variance of the white noise of each row.
    walk : (R,) array
        Variance by which the level walks from the row before to each; of the first, from what is known.
    """
    R, m = columns.shape
    out = np.empty_like(columns)
    x = np.zeros(m)
    P = 0.0
    for k in range(R):
        P += walk[k]
        S = P + white[k]
        gain, root = P / S, 1.0 / np.sqrt(S)
        for j in range(m):
            y = columns[k, j] - x[j]
            out[k, j] = y * root
            x[j] += gain * y
        P *= 1.0 - gain
    return out


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def log_determinant(white: Array, walk: Array) -> float:
    """Return the logarithm of the determinant of the covariance of the rows that `whitened` takes apart."""
    P, total = 0.0, 0.0
    for k in range(len(white)):
        P += walk[k]
        S = P + white[k]
        total += np.log(S)
        P -= P * P / S
    return total


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def innovation_sums(d: Array, tau: Array, dt: Array, fresh: Flags, q: float, parts: int) -> Array:
    """Return the sums of nis and log S, and the count, over parts of a series (3, parts).

    The readings d (N,) are of a level of walk q in white noise 1 / tau, NaN where they do not count; the level is
    unknown at the first one, and again from each on that is `fresh`.
    """
    sums = np.zeros((3, parts))
    m, P, started = 0.0, 0.0, False
    for k in range(len(d)):
        if fresh[k]:
            started = False
        P += q * dt[k]
        if not np.isfinite(d[k]):
            continue
        R = 1.0 / tau[k]
        if not started:
            m, P, started = d[k], R, True
            continue
        S, y = P + R, d[k] - m
        part = k * parts // len(d)
        sums[0, part] += y * y / S
        sums[1, part] += np.log(S)
        sums[2, part] += 1
        m += P / S * y
        P -= P * P / S
    return sums


def minimum_near(cost: Callable[[float], float], grid: Array, xatol: float = 1e-5) -> float:
    """Return the minimum of a cost, between the neighbours of the best place of a grid."""
    k = int(np.argmin([cost(float(x)) for x in grid]))
    bounds = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, len(grid) - 1)])
    return float(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": xatol}).x)


MIN_GAIN, MAX_GAIN = 1e-4, 0.98


@dataclass(frozen=True)
class LocalLevel:
    """A walk under white noise: gain and variance of the one-step error."""

    gain: float
    variance: float

    @classmethod
    def of(cls, white: float, walk: float) -> LocalLevel:
        """Return that of white noise of a row and of a walk's step from row to row, both as variances."""
        ratio = walk / max(white, 1e-300)
        gain = float(np.clip((np.sqrt(ratio**2 + 4 * ratio) - ratio) / 2, MIN_GAIN, MAX_GAIN))
        return cls(gain, white / (1 - gain))

    @property
    def white(self) -> float:
        """Variance of the white noise of a row."""
        return (1 - self.gain) * self.variance

    @property
    def walk(self) -> float:
        """Variance of the walk's step from row to row."""
        return self.gain**2 * self.variance

    def covariance(self, n: int) -> Array:
        """Return the covariance (n, n) of the first n rows, the walk's level at the start apart."""
        k = np.arange(n)
        return np.asarray(self.white * np.eye(n) + self.walk * np.minimum.outer(k, k))


def one_step(parts: Sequence[Array], gain: float) -> list[Array]:
    """Return the one-step errors (n - 1, ...) of signals (n, ...) predicted by an exponential average of their past."""
    errors = []
    for x in parts:
        before = lfilter([gain], [1.0, gain - 1.0], x - x[:1], axis=0)
        errors.append(x[1:] - x[:1] - before[:-1])
    return errors


def fit_local_level(parts: Sequence[Array]) -> LocalLevel:
    """Return the noise of residuals, one (n,) a recording, that of least one-step error."""

    def error(log_gain: float) -> float:
        return float(np.mean(np.concatenate(one_step(parts, float(np.exp(log_gain)))) ** 2))

    best = minimum_near(error, np.log(np.geomspace(MIN_GAIN, MAX_GAIN, 13)), xatol=0.02)
    return LocalLevel(float(np.exp(best)), max(error(best), 1e-300))


def effective(e: Array, s: Array, *, walking: bool) -> float:
    """Return the number of independent rows that residual e (n,) has for a signal s (n,).

    n |s|^2 var(e) / (s' Omega s), Omega the covariance by the periodogram of e, smooth and falling; where the
    signal runs with time alone (`walking`), white and flicker noise and a walk, and not the rest of the signal.
    """
    n = len(e)
    power = np.abs(np.fft.rfft(e - e.mean()))[1:] ** 2 / n
    signal = np.abs(np.fft.rfft(s - s.mean()))[1:] ** 2
    if n < 16 or not np.any(signal > 0) or not np.any(power > 0):
        return 0.0
    omega = _of_walk(power) if walking else falling(power)
    return float(n * np.sum(signal) * np.mean(omega) / np.sum(signal * omega))


def falling(power: Array) -> Array:
    """Return a periodogram (m,) smoothed over wider and wider bands, and never rising with frequency."""
    edges = np.unique(np.round(np.geomspace(1, len(power) + 1, 25)).astype(int)) - 1
    values = np.add.reduceat(power, edges[:-1])
    sizes = np.diff(edges).astype(float)
    pooled: list[list[float]] = []  # adjacent violators: value, weight, count of bands
    for value, size in zip(values / sizes, sizes, strict=True):
        pooled.append([value, size, 1])
        while len(pooled) > 1 and pooled[-1][0] > pooled[-2][0]:
            high, low = pooled.pop(), pooled.pop()
            weight = high[1] + low[1]
            pooled.append([(high[0] * high[1] + low[0] * low[1]) / weight, weight, high[2] + low[2]])
    bands = np.concatenate([np.full(int(count), value) for value, _, count in pooled])
    return np.repeat(bands, sizes.astype(int))


def _of_walk(power: Array) -> Array:
    """Return white noise, flicker noise and a walk fitted to a periodogram (m,), its five lowest bins left out."""
    from scipy.optimize import nnls

    f = np.arange(1, len(power) + 1) / len(power)
    shapes = np.stack([np.ones_like(f), 1 / f, 1 / f**2], axis=1)
    omega = np.full(len(f), float(np.mean(power)))
    high = np.arange(len(f)) >= min(5, len(f) // 4)
    for _ in range(8):  # Whittle's likelihood by reweighted least squares
        weight = 1 / omega[high]
        sizes, _ = nnls(shapes[high] * weight[:, None], power[high] * weight)
        omega = np.maximum(shapes @ sizes, 1e-12 * float(np.mean(power)))
    return np.asarray(omega)
