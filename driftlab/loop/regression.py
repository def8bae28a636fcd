"""Map and effects fitted jointly: generalised least squares of the innovations on the filtered signatures.

Per axis, with everything whitened by the filter (`fusion_core.whitening`): y the rate, X the map's curves, Z the
effects' signatures, all (N, .)::

    y = X c + Z theta + a e,    e ~ N(0, I),    c ~ N(0, a^2 K^-1),    K = lambda P + epsilon I

    -2 log L = N log(2 pi a^2) + log det S + log det(X'X + K) - log det K + RSS / a^2

P is the roughness penalty of the map. The scale a and the walk's share of the noise (which the filter was run with),
and lambda, are those of maximum likelihood; theta has no prior. So the gain of an effect is a generalised likelihood
ratio (Willsky and Jones, IEEE Trans. Automatic Control 21 (1976) 108), with the noise estimated anew with and without.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from driftlab.loop.evidence import Evidence
from driftlab.loop.signals import Kept, Model, Signals, WhiteMap
from fusion_core.chunk import Array
from fusion_core.contracts import Basis

SPAN = (-10.0, 8.0)  # of log(walk's share): the declared one may be wrong by e^5 in deviation
SMOOTHING = np.logspace(-6, 8, 43)  # lambda relative to the curves' own weight
STEP = 1.5  # of the grid over that span
UNSEEN = 1e-7  # share of a signature's weight below which map and other effects take all of it

S = TypeVar("S")
T = TypeVar("T")


@dataclass(frozen=True)
class AxisFit:
    """One axis of a fitted model.

    Attributes
    ----------
    log_likelihood, log_ratio, smoothing, scale : float
        At the maximum; log of the factor on the declared walk's variance, relative lambda, and a.
    c, theta : (q,) and (p,) arrays
        Coefficients of the map's curves and of the effects, SI.
    covariance : (p, p) array
        Of theta.
    """

    log_likelihood: float
    log_ratio: float
    smoothing: float
    scale: float
    c: Array
    theta: Array
    covariance: Array


@dataclass(frozen=True)
class Fit:
    """A fitted model: effects and one fit an axis."""

    effects: Model
    axes: tuple[AxisFit, ...]

    @property
    def log_likelihood(self) -> float:
        """Of all axes."""
        return sum(axis.log_likelihood for axis in self.axes)


class Regression(Signals):
    """Fits of any effects on one evidence, jointly with one map."""

    def __init__(self, evidence: Evidence, basis: Basis) -> None:
        super().__init__(evidence, basis)
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1)
        self._fits: Kept[tuple[str, tuple[float, ...] | None], tuple[AxisFit, ...]] = Kept(256)

    def fit(self, effects: Model, near: Fit | None = None) -> Fit:
        """Fit the model with its noise; `near`, a fit of a similar model, tells where to look.

        The likelihood may have several maxima over the walk's share, so it is looked at on a grid first.
        """
        starts = None if near is None else tuple(axis.log_ratio for axis in near.axes)
        axes = range(len(self.evidence.axes))
        grid = np.arange(SPAN[0], SPAN[1] + STEP, STEP)

        def look(log_ratio: float) -> dict[int, AxisFit]:
            found = [axis for axis in axes if starts is None or -5 < log_ratio - starts[axis] < 3.5]
            return {axis: self.axis_at(effects, axis, log_ratio) for axis in found}

        def make() -> tuple[AxisFit, ...]:
            looked = self.side_by_side(look, grid.tolist(), effects)
            return tuple(self.side_by_side(lambda axis: self._climb(effects, axis, looked), axes, effects))

        return Fit(effects, self._fits.get((repr(effects), starts), make))

    def forget(self) -> None:
        """Let go of what is kept to be fast."""
        super().forget()
        self._pool.shutdown()

    def at_noise_of(self, near: Fit, effects: Model) -> Fit:
        """Fit the model with the walk's share of another fit."""

        def work(axis: int) -> AxisFit:
            return self.axis_at(effects, axis, near.axes[axis].log_ratio)

        return Fit(effects, tuple(self.side_by_side(work, range(len(self.evidence.axes)), effects)))

    def side_by_side(self, work: Callable[[S], T], tasks: Iterable[S], effects: Model) -> list[T]:
        """Return the work done for each task, on all cores; what they need of the effects is made ready first."""
        self.curves(effects)
        for effect in effects:
            self._columns(effect)
        _ = self.weight
        return list(self._pool.map(work, tasks))

    def _climb(self, effects: Model, axis: int, looked: list[dict[int, AxisFit]]) -> AxisFit:
        """Maximise the likelihood of one axis over the walk's share, about the best of those that were looked at."""
        from scipy.optimize import minimize_scalar

        tried = [fits[axis] for fits in looked if axis in fits]

        def cost(log_ratio: float) -> float:
            tried.append(self.axis_at(effects, axis, log_ratio))
            return -tried[-1].log_likelihood

        best = max(tried, key=lambda fit: fit.log_likelihood).log_ratio
        minimize_scalar(cost, bounds=(best - STEP, best + STEP), method="bounded", options={"xatol": 0.05})
        return max(tried, key=lambda fit: fit.log_likelihood)

    def axis_at(self, effects: Model, axis: int, log_ratio: float) -> AxisFit:
        """Fit one axis with the walk's share given."""
        of_map = self.white_map(effects, axis, log_ratio)
        Z, _ = self.columns(effects, axis)
        rest = self.whitening(axis, log_ratio)(np.hstack([Z, self.evidence.rate[:, axis : axis + 1]]))
        return self.solve(of_map, of_map.X.T @ rest, rest.T @ rest, log_ratio)

    def innovations(self, fit: Fit, axis: int) -> tuple[Array, Array]:
        """Return what a fit leaves on one axis (N,), white with unit variance where the model is right, and log S."""
        own = fit.axes[axis]
        Z, _ = self.columns(fit.effects, axis)
        left = self.evidence.rate[:, axis] - self.curves(fit.effects) @ own.c - Z @ own.theta
        whitening = self.whitening(axis, own.log_ratio)
        return whitening(left[:, None])[:, 0] / own.scale, whitening.log_S

    def solve(self, of_map: WhiteMap, XR: Array, RR: Array, log_ratio: float) -> AxisFit:
        """Return the fit from the products X'[Z y] and [Z y]'[Z y], at the smoothing of maximum likelihood."""
        N, B = len(self.evidence), of_map.B
        smoothing = SMOOTHING if self.rough else np.zeros(1)
        shrunk = 1 / (1 + smoothing[:, None] * of_map.e)  # (l, q)
        rest = B.T @ XR
        R = RR - np.einsum("qi,lq,qj->lij", rest, shrunk, rest, optimize=True)
        theta, covariance, RSS = _eliminate(R, np.diag(RR)[:-1])
        prior = np.log(smoothing[:, None] * self.weight * self.eigenvalues + self.epsilon)
        log_det_map = of_map.log_det - np.sum(np.log(shrunk), axis=1) - np.sum(prior, axis=1)
        log_L = -0.5 * (N * (np.log(2 * np.pi * RSS / N) + 1) + of_map.log_det_S + log_det_map)
        k = int(np.argmax(log_L))
        variance = float(RSS[k] / N)
        c = B @ (shrunk[k] * (rest[:, -1] - rest[:, :-1] @ theta[k]))
        scale, smooth = float(np.sqrt(variance)), float(smoothing[k])
        return AxisFit(float(log_L[k]), log_ratio, smooth, scale, c, theta[k], variance * covariance[k])


def solution(A: Array, B: Array) -> Array:
    """Return the least-norm solution of A X = B for a positive semi-definite A (n, n) whose columns differ in scale."""
    diagonal = np.diag(A)
    unit = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    right = unit.reshape(-1, *[1] * (B.ndim - 1)) * B
    found = np.linalg.lstsq(A * unit[:, None] * unit, right, rcond=1e-12)[0]
    return np.asarray(unit.reshape(-1, *[1] * (B.ndim - 1)) * found)


def _eliminate(R: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Return theta (l, p), its covariance over a^2 (l, p, p) and RSS (l,) from reduced Gram matrices of [Z y].

    Combinations of signatures that keep less than UNSEEN of their weight get the coefficient zero.
    """
    p = R.shape[1] - 1
    if p == 0:
        return np.zeros((len(R), 0)), np.zeros((len(R), 0, 0)), R[:, -1, -1]
    unit = 1 / np.sqrt(np.where(weight > 0, weight, 1.0))
    values, vectors = np.linalg.eigh(R[:, :p, :p] * unit[:, None] * unit)
    inverse = np.where(values > UNSEEN, 1 / np.where(values > UNSEEN, values, 1.0), 0.0)
    half = unit[:, None] * vectors
    covariance = (half * inverse[:, None, :]) @ np.swapaxes(half, 1, 2)
    theta = (covariance @ R[:, :p, p:])[..., 0]
    return theta, covariance, R[:, p, p] - np.einsum("lp,lp->l", theta, R[:, :p, p])
