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
from functools import cached_property
from threading import Lock
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from driftlab.loop.evidence import Evidence
from fusion_core.chunk import Array
from fusion_core.contracts import Basis, Effect
from fusion_core.whitening import Whitening

SPAN = (-10.0, 8.0)  # of log(walk's share): the declared one may be wrong by e^5 in deviation
SMOOTHING = np.logspace(-6, 8, 43)  # lambda relative to the curves' own weight
STEP = 1.5  # of the grid over that span
CURVES, SIGNATURES, GAINS, WHITE = 64, 256, 256, 48  # of each that are kept at most
UNSEEN = 1e-7  # share of a signature's weight below which map and other effects take all of it

Model = tuple[Effect, ...]
Indices = NDArray[np.intp]
K = TypeVar("K")
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


@dataclass(frozen=True)
class WhiteMap:
    """The map's curves as a filter leaves them, and what makes their fit diagonal for every lambda.

    Attributes
    ----------
    curves, X : (N, q) arrays
        Before and after the filter.
    XX : (q, q) array
        X'X.
    B : (q, q) array
        With B'(X'X + epsilon I)B = I and B'PB = diag(e).
    e : (q,) array
    log_det, log_det_S : float
        Of X'X + epsilon I, and of S over all steps.
    """

    curves: Array
    X: Array
    XX: Array
    B: Array
    e: Array
    log_det: float
    log_det_S: float


class Regression:
    """Fits of any effects on one evidence, jointly with one map."""

    def __init__(self, evidence: Evidence, basis: Basis) -> None:
        self.evidence, self.basis = evidence, basis
        self._pool, self._lock = ThreadPoolExecutor(os.cpu_count() or 1), Lock()
        filters = evidence.filters
        self._alike = [next(k for k, other in enumerate(filters) if other.same_as(one)) for one in filters]
        P = basis.penalty
        self.rough = bool(np.any(P))
        scale = np.trace(P) if self.rough else 1.0
        self.penalty = P / scale
        values = np.linalg.eigvalsh(self.penalty)
        # what is not penalised stays so at any lambda: rounding, times the largest, would outweigh epsilon
        self.eigenvalues = np.where(values > 1e-12 * values[-1], values, 0.0)
        self._curves: dict[str, Array] = {}
        self._signatures: dict[str, Array] = {}
        self._gains: dict[tuple[int, float], Whitening] = {}
        self._white: dict[tuple[int, int, float], WhiteMap] = {}

    # -- what the model looks like -------------------------------------------------------------------------------

    def curves(self, effects: Model) -> Array:
        """Return the map's curves (N, q) at the temperatures that the map sees."""
        acting = tuple(e for e in effects if e.acts_on_input)
        key = repr(acting)
        if (known := self._curves.get(key)) is not None:
            return known
        parts = []
        for chunk in self.evidence.chunks:
            for effect in acting:
                chunk = chunk.having(temperature=effect.input(chunk, None)[0])
            parts.append(self.basis.values(chunk["temperature"]))
        return self._keep(self._curves, key, np.concatenate(parts), CURVES)

    def signature(self, effect: Effect) -> Array:
        """Return the effect's regressors (N, d, p) over all recordings, centred: a constant is the turn-on's."""
        key = repr(effect)
        if (known := self._signatures.get(key)) is not None:
            return known
        parts = [effect.signature(chunk, None)[0] for chunk in self.evidence.chunks]
        centred = np.concatenate([part - part.mean(axis=0) for part in parts])
        return self._keep(self._signatures, key, centred, SIGNATURES)

    def columns(self, effects: Model, axis: int) -> tuple[Array, Indices]:
        """Return what the effects show on one axis (N, p'), and to which of all p coefficients each column belongs."""
        stacked = np.concatenate(
            [self.signature(e)[:, axis] for e in effects] or [np.zeros((len(self.evidence), 0))], axis=1
        )
        own = np.flatnonzero(np.any(stacked != 0, axis=0))
        return stacked[:, own], own

    def _keep(self, kept: dict[K, T], key: K, value: T, most: int) -> T:
        """Keep a value, the oldest gone where there are too many, and return it; any thread may do so."""
        with self._lock:
            while len(kept) >= most:
                del kept[next(iter(kept))]
            kept[key] = value
        return value

    def forget(self) -> None:
        """Let go of what is kept to be fast."""
        for kept in (self._curves, self._signatures, self._gains, self._white):
            kept.clear()
        self._pool.shutdown()

    # -- fits ----------------------------------------------------------------------------------------------------

    def fit(self, effects: Model, near: Fit | None = None) -> Fit:
        """Fit the model with its noise; `near`, a fit of a similar model, tells where to look.

        The likelihood may have several maxima over the walk's share, so it is looked at on a grid first.
        """
        axes = range(len(self.evidence.axes))
        grid = np.arange(SPAN[0], SPAN[1] + STEP, STEP)

        def look(log_ratio: float) -> dict[int, AxisFit]:
            starts = [None if near is None else near.axes[axis].log_ratio for axis in axes]
            found = [axis for axis in axes if (start := starts[axis]) is None or -5 < log_ratio - start < 3.5]
            return {axis: self.axis_at(effects, axis, log_ratio) for axis in found}

        def climb(axis: int) -> AxisFit:
            return self._climb(effects, axis, [fits[axis] for fits in looked if axis in fits])

        looked = self.side_by_side(look, grid.tolist(), effects)
        return Fit(effects, tuple(self.side_by_side(climb, axes, effects)))

    def at_noise_of(self, near: Fit, effects: Model) -> Fit:
        """Fit the model with the walk's share of another fit."""

        def work(axis: int) -> AxisFit:
            return self.axis_at(effects, axis, near.axes[axis].log_ratio)

        return Fit(effects, tuple(self.side_by_side(work, range(len(self.evidence.axes)), effects)))

    def side_by_side(self, work: Callable[[S], T], tasks: Iterable[S], effects: Model) -> list[T]:
        """Return the work done for each task, on all cores; what all of them need of the effects is made ready first."""
        self.curves(effects)
        for effect in effects:
            self.signature(effect)
        _ = self._weight
        return list(self._pool.map(work, tasks))

    def _climb(self, effects: Model, axis: int, looked: list[AxisFit]) -> AxisFit:
        """Maximise the likelihood of one axis over the walk's share, about the best of those that were looked at."""
        from scipy.optimize import minimize_scalar

        tried = list(looked)

        def cost(log_ratio: float) -> float:
            tried.append(self.axis_at(effects, axis, log_ratio))
            return -tried[-1].log_likelihood

        best = max(looked, key=lambda fit: fit.log_likelihood).log_ratio
        minimize_scalar(cost, bounds=(best - STEP, best + STEP), method="bounded", options={"xatol": 0.05})
        return max(tried, key=lambda fit: fit.log_likelihood)

    def axis_at(self, effects: Model, axis: int, log_ratio: float) -> AxisFit:
        """Fit one axis with the walk's share given."""
        of_map = self.white_map(effects, axis, log_ratio)
        Z, _ = self.columns(effects, axis)
        rest = self.whitening(axis, log_ratio)(np.hstack([Z, self.evidence.rate[:, axis : axis + 1]]))
        return self.solve(of_map, of_map.X.T @ rest, rest.T @ rest, log_ratio)

    def white_map(self, effects: Model, axis: int, log_ratio: float) -> WhiteMap:
        """Return the map's curves as the filter of an axis leaves them."""
        curves = self.curves(effects)
        key = (id(curves), self._alike[axis], log_ratio)
        if (known := self._white.get(key)) is not None:
            return known
        whitening = self.whitening(axis, log_ratio)
        X = whitening(curves)
        XX = X.T @ X
        own, vectors = np.linalg.eigh(XX)
        own = np.clip(own, 0.0, None) + self._epsilon
        B = vectors / np.sqrt(own)
        e, U = np.linalg.eigh(B.T @ (self._weight * self.penalty) @ B)
        e = np.where(self.eigenvalues > 0, np.clip(e, 0.0, None), 0.0)  # of one rank, both ascending
        found = WhiteMap(curves, X, XX, B @ U, e, float(np.sum(np.log(own))), float(np.sum(whitening.log_S)))
        return self._keep(self._white, key, found, WHITE)

    def whitening(self, axis: int, log_ratio: float) -> Whitening:
        """Return the filter of an axis with its gains."""
        key = (self._alike[axis], log_ratio)
        if (known := self._gains.get(key)) is not None:
            return known
        return self._keep(self._gains, key, self.evidence.filters[axis].at(float(np.exp(log_ratio))), GAINS)

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
        prior = np.log(smoothing[:, None] * self._weight * self.eigenvalues + self._epsilon)
        log_det_map = of_map.log_det - np.sum(np.log(shrunk), axis=1) - np.sum(prior, axis=1)
        log_L = -0.5 * (N * (np.log(2 * np.pi * RSS / N) + 1) + of_map.log_det_S + log_det_map)
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
        return float(np.sum(self.whitening(0, 0.0)(self.curves(())) ** 2))

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
