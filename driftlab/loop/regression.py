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
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from driftlab.loop.evidence import Evidence
from fusion_core.chunk import Array
from fusion_core.contracts import Basis, Effect

SPAN = (-10.0, 8.0)  # of log(walk's share): the declared one may be wrong by e^5 in deviation
SMOOTHING = np.logspace(-6, 8, 43)  # lambda relative to the curves' own weight
STEP = 1.5  # of the grid over that span
WHITE = 48  # whitened sets of curves that are kept
UNSEEN = 1e-7  # share of a signature's weight below which map and other effects take all of it

Model = tuple[Effect, ...]
Indices = NDArray[np.intp]
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


class Regression:
    """Fits of any effects on one evidence, jointly with one map."""

    def __init__(self, evidence: Evidence, basis: Basis) -> None:
        self.evidence, self.basis = evidence, basis
        self._pool = ThreadPoolExecutor(min(len(evidence.axes), os.cpu_count() or 1))
        P = basis.penalty
        self.rough = bool(np.any(P))
        scale = np.trace(P) if self.rough else 1.0
        self.penalty = P / scale
        values = np.linalg.eigvalsh(self.penalty)
        # what is not penalised stays so at any lambda: rounding, times the largest, would outweigh epsilon
        self.eigenvalues = np.where(values > 1e-12 * values[-1], values, 0.0)
        self._curves: dict[str, Array] = {}
        self._signatures: dict[str, Array] = {}
        self._white: dict[tuple[int, int, float], tuple[Array, Array, Array, float]] = {}

    # -- what the model looks like -------------------------------------------------------------------------------

    def curves(self, effects: Model) -> Array:
        """Return the map's curves (N, q) at the temperatures that the map sees."""
        acting = tuple(e for e in effects if e.acts_on_input)
        key = repr(acting)
        if key not in self._curves:
            if len(self._curves) > 64:
                self._curves.clear()
            parts = []
            for chunk in self.evidence.chunks:
                for effect in acting:
                    chunk = chunk.having(temperature=effect.input(chunk, None)[0])
                parts.append(self.basis.values(chunk["temperature"]))
            self._curves[key] = np.concatenate(parts)
        return self._curves[key]

    def signature(self, effect: Effect) -> Array:
        """Return the effect's regressors (N, d, p) over all recordings, centred: a constant is the turn-on's."""
        key = repr(effect)
        if key not in self._signatures:
            if len(self._signatures) > 256:
                self._signatures.clear()
            parts = [effect.signature(chunk, None)[0] for chunk in self.evidence.chunks]
            self._signatures[key] = np.concatenate([part - part.mean(axis=0) for part in parts])
        return self._signatures[key]

    def columns(self, effects: Model, axis: int) -> tuple[Array, Indices]:
        """Return what the effects show on one axis (N, p'), and to which of all p coefficients each column belongs."""
        stacked = np.concatenate(
            [self.signature(e)[:, axis] for e in effects] or [np.zeros((len(self.evidence), 0))], axis=1
        )
        own = np.flatnonzero(np.any(stacked != 0, axis=0))
        return stacked[:, own], own

    def forget(self) -> None:
        """Let go of what is kept to be fast."""
        for kept in (self._curves, self._signatures, self._white):
            kept.clear()
        self._pool.shutdown()

    # -- fits ----------------------------------------------------------------------------------------------------

    def fit(self, effects: Model, near: Fit | None = None) -> Fit:
        """Fit the model with its noise; `near`, a fit of a similar model, tells where to look."""
        return Fit(effects, tuple(self.each_axis(lambda axis: self._fit_axis(effects, axis, near), effects)))

    def at_noise_of(self, near: Fit, effects: Model) -> Fit:
        """Fit the model with the walk's share of another fit."""
        return Fit(
            effects, tuple(self.each_axis(lambda axis: self.axis_at(effects, axis, near.axes[axis].log_ratio), effects))
        )

    def each_axis(self, work: Callable[[int], T], effects: Model) -> list[T]:
        """Return the work done for each axis, side by side; what all axes need of the effects is made ready first."""
        self.curves(effects)
        for effect in effects:
            self.signature(effect)
        _ = self._weight
        return list(self._pool.map(work, range(len(self.evidence.axes))))

    def _fit_axis(self, effects: Model, axis: int, near: Fit | None) -> AxisFit:
        """Maximise the likelihood over the walk's share: it may have several maxima, so on a grid first."""
        from scipy.optimize import minimize_scalar

        tried: dict[float, AxisFit] = {}

        def cost(log_ratio: float) -> float:
            tried[log_ratio] = self.axis_at(effects, axis, log_ratio)
            return -tried[log_ratio].log_likelihood

        start = None if near is None else near.axes[axis].log_ratio
        grid = [float(v) for v in np.arange(SPAN[0], SPAN[1] + STEP, STEP) if start is None or -5 < v - start < 3.5]
        best = min(grid, key=cost)
        minimize_scalar(cost, bounds=(best - STEP, best + STEP), method="bounded", options={"xatol": 0.05})
        return max(tried.values(), key=lambda fit: fit.log_likelihood)

    def axis_at(self, effects: Model, axis: int, log_ratio: float) -> AxisFit:
        """Fit one axis with the walk's share given."""
        X, XX, log_det = self.white_curves(effects, axis, log_ratio)
        Z, _ = self.columns(effects, axis)
        rest, _ = self.whiten(np.hstack([Z, self.evidence.rate[:, axis : axis + 1]]), axis, log_ratio)
        XR = X.T @ rest
        return self.solve(np.block([[XX, XR], [XR.T, rest.T @ rest]]), len(XX), log_det, log_ratio)

    def white_curves(self, effects: Model, axis: int, log_ratio: float) -> tuple[Array, Array, float]:
        """Return the whitened curves (N, q), their Gram matrix, and log det S; the last few are kept."""
        X = self.curves(effects)
        key = (id(X), axis, log_ratio)
        if key not in self._white:
            if len(self._white) > WHITE:
                del self._white[next(iter(self._white))]
            white, log_det = self.whiten(X, axis, log_ratio)
            self._white[key] = (X, white, white.T @ white, float(np.sum(log_det)))
        return self._white[key][1:]

    def whiten(self, signals: Array, axis: int, log_ratio: float) -> tuple[Array, Array]:
        """Return the innovations of signals (N, M) on one axis, and log S (N,)."""
        return self.evidence.filters[axis].whiten(signals, float(np.exp(log_ratio)))

    def innovations(self, fit: Fit, axis: int) -> tuple[Array, Array]:
        """Return what a fit leaves on one axis (N,), white with unit variance where the model is right, and log S."""
        own = fit.axes[axis]
        Z, _ = self.columns(fit.effects, axis)
        left = self.evidence.rate[:, axis] - self.curves(fit.effects) @ own.c - Z @ own.theta
        white, log_det = self.whiten(left[:, None], axis, own.log_ratio)
        return white[:, 0] / own.scale, log_det

    def solve(self, G: Array, q: int, log_det: float, log_ratio: float) -> AxisFit:
        """Return the fit from the Gram matrix of [X Z y], at the smoothing of maximum likelihood.

        With B'(X'X + epsilon I)B = I and B'PB = diag(e), X'X + K is diagonal for every lambda.
        """
        N = len(self.evidence)
        own, vectors = np.linalg.eigh(G[:q, :q])
        own = np.clip(own, 0.0, None) + self._epsilon
        B = vectors / np.sqrt(own)
        e, U = np.linalg.eigh(B.T @ (self._weight * self.penalty) @ B)
        e, B = np.where(self.eigenvalues > 0, np.clip(e, 0.0, None), 0.0), B @ U  # of one rank, both ascending
        smoothing = SMOOTHING if self.rough else np.zeros(1)
        shrunk = 1 / (1 + smoothing[:, None] * e)  # (l, q)
        rest = B.T @ G[:q, q:]
        R = G[q:, q:] - np.einsum("qi,lq,qj->lij", rest, shrunk, rest, optimize=True)
        theta, covariance, RSS = _eliminate(R, np.diag(G)[q:-1])
        prior = np.log(smoothing[:, None] * self._weight * self.eigenvalues + self._epsilon)
        log_det_map = np.sum(np.log(own)) - np.sum(np.log(shrunk), axis=1) - np.sum(prior, axis=1)
        log_L = -0.5 * (N * (np.log(2 * np.pi * RSS / N) + 1) + log_det + log_det_map)
        k = int(np.argmax(log_L))
        variance = float(RSS[k] / N)
        c = B @ (shrunk[k] * (rest[:, -1] - rest[:, :-1] @ theta[k]))
        scale, smooth = float(np.sqrt(variance)), float(smoothing[k])
        return AxisFit(float(log_L[k]), log_ratio, smooth, scale, c, theta[k], variance * covariance[k])

    def prior(self, smoothing: float) -> Array:
        """Return K (q, q)."""
        return smoothing * self._weight * self.penalty + self._epsilon * np.eye(len(self.penalty))

    @cached_property
    def _weight(self) -> float:
        """Weight of the curves in the innovations as declared: what lambda is relative to."""
        white, _ = self.whiten(self.curves(()), 0, 0.0)
        return float(np.sum(white**2))

    @cached_property
    def _epsilon(self) -> float:
        return 1e-8 * self._weight / len(self.penalty)


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
