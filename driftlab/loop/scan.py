"""A first look at many candidates at once: how much each would gain, at a few shares of the walk.

All signatures go through the filter together, as columns of one matrix; the map and the effects of the present model
are then taken out of each. An effect that changes what the map sees has other curves, and is fitted for itself. The
walk that a model without the effect needs is too large, so smaller ones are tried too. What is kept fixed (smoothing,
hyper-parameters between the grid's values) makes a gain too small, never too large; the best are fitted in full later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from driftlab.loop.regression import SMOOTHING, UNSEEN, Fit, Regression, solution
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

SHARES = (0.0, -1.5, -3.0, -4.5)  # log of the walk's variance, relative to the present model's


@dataclass(frozen=True)
class Score:
    """A candidate and about how much log-likelihood it gains."""

    effect: Effect
    gain: float


def scan(regression: Regression, base: Fit, candidates: Sequence[Effect]) -> list[Score]:
    """Return a score for each candidate beside the effects of the base."""
    for effect in candidates:
        regression.columns((effect,), 0)
        regression.curves((*base.effects, effect))

    def work(task: tuple[int, float]) -> Array:
        axis, share = task
        fit = base.axes[axis]
        return _at(regression, base, axis, fit.log_ratio + share, candidates) - fit.log_likelihood

    tasks = [(axis, share) for axis in range(len(base.axes)) for share in SHARES]
    found = np.reshape(regression.side_by_side(work, tasks, base.effects), (len(base.axes), len(SHARES), -1))
    gains = np.sum(np.maximum(np.max(found, axis=1), 0.0), axis=0)
    return [Score(effect, float(gain)) for effect, gain in zip(candidates, gains, strict=True)]


def columns_seen(regression: Regression, effect: Effect) -> int:
    """Return how many coefficients of an effect the recordings can tell apart, a map without bends taken out."""
    count = 0
    stiff = SMOOTHING[-1] if regression.rough else 0.0
    for axis in range(len(regression.evidence.axes)):
        of_map, (Z, _) = regression.white_map((), axis, 0.0), regression.columns((effect,), axis)
        if Z.shape[1]:
            white = regression.whitening(axis, 0.0)(Z)
            rest, G = of_map.B.T @ (of_map.X.T @ white), white.T @ white
            R = G - rest.T @ (rest / (1 + stiff * of_map.e)[:, None])
            unit = 1 / np.sqrt(np.where(np.diag(G) > 0, np.diag(G), 1.0))
            count += int(np.sum(np.linalg.eigvalsh(R * unit[:, None] * unit) > UNSEEN))
    return count


def _at(regression: Regression, present: Fit, axis: int, log_ratio: float, candidates: Sequence[Effect]) -> Array:
    """Return the log-likelihood (c,) of one axis with each candidate, the walk's share given."""
    acting = [e.acts_on_input for e in candidates]
    of_map = regression.white_map(present.effects, axis, log_ratio)
    X, XX = of_map.X, of_map.XX
    Z, _ = regression.columns(present.effects, axis)
    blocks = [
        np.zeros((len(X), 0)) if acts else regression.columns((effect,), axis)[0]
        for effect, acts in zip(candidates, acting, strict=True)
    ]
    y = regression.evidence.rate[:, axis : axis + 1]
    rest = regression.whitening(axis, log_ratio)(np.hstack([Z, y, *blocks]))
    q, p = len(XX), Z.shape[1]
    XR = X.T @ rest
    RR = rest[:, : p + 1].T @ rest
    fit = regression.solve(of_map, XR[:, : p + 1], RR[:, : p + 1], log_ratio)
    G = np.block([[XX, XR], [XR[:, : p + 1].T, RR]])
    found = np.full(len(candidates), -np.inf)
    base = q + p
    K = np.zeros((base, base))
    K[:q, :q] = regression.prior(fit.smoothing)
    known = solution(G[:base, :base] + K, G[:base, base:])
    ends = np.cumsum([base + 1, *(block.shape[1] for block in blocks)])
    for k, (first, last) in enumerate(pairwise(ends)):
        if acting[k]:
            effects = (*present.effects, candidates[k])
            found[k] = regression.axis_at(effects, axis, log_ratio).log_likelihood
        elif last > first:
            own = rest[:, first - q : last - q]
            R = own.T @ own - G[:base, first:last].T @ known[:, first - base : last - base]
            right = G[base, first:last] - G[:base, first:last].T @ known[:, 0]
            squares = _explained(R, right, np.sum(own**2, axis=0))
            share = min(squares / (fit.scale**2 * len(X)), 0.999999)
            found[k] = fit.log_likelihood - 0.5 * len(X) * float(np.log1p(-share))
    return found


def _explained(R: Array, right: Array, weight: Array) -> float:
    """Return right' R^-1 right (p,), without the combinations that keep less than UNSEEN of their weight (p,)."""
    unit = 1 / np.sqrt(np.where(weight > 0, weight, 1.0))
    values, vectors = np.linalg.eigh(R * unit[:, None] * unit)
    seen = values > UNSEEN
    return float(np.sum(((unit * right) @ vectors)[seen] ** 2 / values[seen]))
