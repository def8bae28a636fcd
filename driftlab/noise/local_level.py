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

from fusion_core.chunk import Array
from fusion_core.contracts import Sensor
from fusion_core.fast import compiled
from fusion_core.units import along_axes


@compiled
def whitened(columns: Array, white: Array, walk: Array) -> tuple[Array, Array]:
    """Return columns (R, m) as normalised innovations (R, m) of a local level that begins at 0, and variances (R,).

    An innovation is 0, and the variance that it had infinite, where a row says nothing: it was not read, or is the
    first of an unknown level.

    Parameters
    ----------
    columns : (R, m) array
    white : (R,) array
        Variance of the white noise of each row; infinite where it was not read.
    walk : (R,) array
        Variance by which the level walks from the row before to each; infinite where it is unknown from there on.
    """
    (R, m), P = columns.shape, 0.0
    out, variances, x = np.zeros_like(columns), np.full(R, np.inf), np.zeros(m)
    for k in range(R):
        P += walk[k]
        if np.isinf(white[k]):
            continue
        if np.isinf(P):
            for j in range(m):
                x[j] = columns[k, j]
            P = white[k]
            continue
        S = P + white[k]
        gain, root = P / S, 1.0 / np.sqrt(S)
        for j in range(m):
            y = columns[k, j] - x[j]
            out[k, j] = y * root
            x[j] += gain * y
        P *= 1.0 - gain
        variances[k] = S
    return out, variances


class LevelLikelihood:
    """Restricted likelihood of white noise and walk in signals y beside free columns X, by the ratio r of the two.

    With white noise of the variance s^2 w_k in a row and a walk by r s^2 dt_k from the one before, the noise of the
    rows has the covariance s^2 V(r), and what no columns can make of them is as likely as::

        - 2 l(s, r) = nu log s^2 + Q(r) / s^2 + log det V + log det X' V^-1 X,
        Q = y' V^-1 y - y' V^-1 X (X' V^-1 X)^-1 X' V^-1 y

    with nu rows less columns and unknown levels, which are taken out as columns are; s^2 = Q / nu is taken out, too.

    Source: H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal,
    Biometrika 58 (1971) 545.

    Parameters
    ----------
    parts : sequence of (R, q + d), (R,) and (R,) arrays
        X and y, w and dt of each recording; w is infinite where a row was not read, dt where the level is unknown.
    q : int
        Number of columns X, which are independent of one another and of the unknown levels.
    """

    def __init__(self, parts: Sequence[tuple[Array, Array, Array]], q: int = 0) -> None:
        self.parts = [(np.ascontiguousarray(columns), white, dt) for columns, white, dt in parts]
        self.q = q

    def rows(self, ratio: float) -> list[tuple[Array, Array]]:
        """Return the columns of each part as innovations where s is 1, and their variances (`whitened`)."""
        walks = [np.multiply(dt, ratio, out=np.full(len(dt), np.inf), where=np.isfinite(dt)) for *_, dt in self.parts]
        return [whitened(columns, white, walk) for (columns, white, _), walk in zip(self.parts, walks, strict=True)]

    def at(self, ratio: float) -> tuple[Array, Array, int]:
        """Return - 2 l and s^2 (d,) of each signal where s^2 is the likeliest, and nu."""
        costs, scales, nu = self._over([ratio])
        return costs[0], scales[0], nu

    def over(self, ratios: Array) -> tuple[Array, Array]:
        """Return - 2 l and s^2 (G, d) of ratios (G,)."""
        return self._over(ratios)[:2]

    def _over(self, ratios: Sequence[float] | Array) -> tuple[Array, Array, int]:
        q, sums = self.q, [self._sums(ratio) for ratio in ratios]
        N, variances = (np.stack(part) for part in zip(*sums, strict=True))
        L, nu = np.linalg.cholesky(N[:, :q, :q]), max(variances.shape[1] - q, 1)
        taken = np.linalg.solve(L, N[:, :q, q:])
        squares = np.diagonal(N, axis1=1, axis2=2)[:, q:] - np.sum(taken**2, axis=1)
        s2 = np.maximum(squares, np.finfo(float).tiny) / nu
        free = 2 * np.sum(np.log(np.diagonal(L, axis1=1, axis2=2)), axis=1)
        return nu * np.log(s2) + (np.sum(np.log(variances), axis=1) + free)[:, None], s2, nu

    def _sums(self, ratio: float) -> tuple[Array, Array]:
        """Return the products (q + d, q + d) of the innovations, whose rows are not kept, and their variances."""
        rows = self.rows(ratio)
        return np.asarray(sum(X.T @ X for X, _ in rows)), np.concatenate([S[np.isfinite(S)] for _, S in rows])


def walk_of(sensor: Sensor) -> Array | None:
    """Return the declared density (d,) of the random walk of a sensor's bias; None where its model has none."""
    walk = getattr(sensor.bias, "walk", None)
    return None if walk is None else along_axes(walk, len(sensor.axes))


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
    return [_one_step(np.atleast_2d(x.T).T, gain).reshape(len(x) - 1, *x.shape[1:]) for x in parts]


@compiled
def _one_step(x: Array, gain: float) -> Array:
    """Return the errors (n - 1, d) of the signals (n, d)."""
    n, d = x.shape
    errors, level = np.empty((n - 1, d)), np.zeros(d)  # the level over the first row
    for k in range(1, n):
        for j in range(d):
            errors[k - 1, j] = x[k, j] - x[0, j] - level[j]
            level[j] = gain * (x[k, j] - x[0, j]) - (gain - 1.0) * level[j]
    return errors


def fit_local_level(parts: Sequence[Array]) -> LocalLevel:
    """Return the noise of residuals, one (n,) a recording, that of least one-step error."""

    def errors(gains: Array) -> Array:
        return np.asarray(sum(_squares(x, gains) for x in parts) / sum(len(x) - 1 for x in parts))

    def error(log_gain: float) -> float:
        return float(errors(np.array([np.exp(log_gain)]))[0])

    grid = np.geomspace(MIN_GAIN, MAX_GAIN, 13)
    best = minimum_near(error, np.log(grid), xatol=0.02, costs=errors(grid))
    return LocalLevel(float(np.exp(best)), max(error(best), 1e-300))


@compiled
def _squares(x: Array, gains: Array) -> Array:
    """Return the sums of squares (G,) of the one-step errors of a signal (n,), predicted with each of the gains."""
    sums, level = np.zeros(len(gains)), np.zeros(len(gains))
    for k in range(1, len(x)):
        value = x[k] - x[0]
        for j in range(len(gains)):
            sums[j] += (value - level[j]) ** 2
            level[j] = gains[j] * value - (gains[j] - 1.0) * level[j]
    return sums


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
    from scipy.optimize import isotonic_regression

    edges = np.unique(np.round(np.geomspace(1, len(power) + 1, 25)).astype(int)) - 1
    sizes = np.diff(edges)
    means = np.add.reduceat(power, edges[:-1]) / sizes
    return np.repeat(isotonic_regression(means, weights=sizes, increasing=False).x, sizes)


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


def minimum_near(cost: Callable[[float], float], grid: Array, xatol: float = 1e-5, costs: Array | None = None) -> float:
    """Return the minimum of a cost, between the neighbours of the best place of a grid, where it may be known."""
    from scipy.optimize import minimize_scalar

    k = int(np.argmin([cost(float(x)) for x in grid] if costs is None else costs))
    bounds = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, len(grid) - 1)])
    return float(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": xatol}).x)
