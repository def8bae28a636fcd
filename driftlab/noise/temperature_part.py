"""The part of a bias that follows the temperature, in a recording that was to be at rest at one.

A bias that follows the temperature raises the Allan deviation at long averaging times, where it passes for a walk, a
ramp or a step. So means y over R blocks are held against a local level, white noise and walk of any ratio, with and
without a curve f over the mean temperature T of the blocks, a ramp g t in time, and a warming up w exp(-t / tau)::

    gain = max of l(y | f(T)), l(y | f(T) + g t) - max of l(y), l(y | g t), l(y | g t + w exp(-t / tau))

with l the largest log-likelihood, less log R / 2 for each coefficient. f is straight between knots; how many there are
is found the same way. A room that drifts while a bias ages or warms up by itself gains nothing: these explain y as
well. R blocks, d axes.

Source: G. Schwarz, Estimating the dimension of a model, Ann. Stat. 6 (1978) 461.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftlab.noise.bias_step import SURE, TINY, BlockMeans, mean_of
from driftlab.noise.local_level import whitened
from fusion_core.chunk import Array

PIECES = (1, 2, 4, 8, 16)  # of the curve, of equal width
WARMING = (1, 2, 4, 8, 16, 32, 64)  # times tau in a recording
MATERIAL = 0.1  # of the variance of what the bias moves: less changes no coefficient beyond its limits


class TemperaturePart(NamedTuple):
    """The temperature's span in K, its part of the variance of what the bias moves, and the nats it gains.

    A ramp beside it, as of ageing, is not counted in that variance.
    """

    moved: float
    part: float
    gain: float


def temperature_parts(means: BlockMeans, temperature: Array) -> list[TemperaturePart | None]:
    """Find what each axis of means owes to the temperatures (N,) of the samples; None where it is nothing material."""
    T = mean_of(temperature[:, None], means.rows)[:, 0]
    if np.ptp(T) == 0:
        return [None] * means.y.shape[1]
    ramp = _hats(means.t, 1)
    curves = [_hats(T, pieces) for pieces in PIECES if 2 * pieces < len(T)]
    others = [ramp[:, :0], ramp, *(np.hstack([ramp, np.exp(-times * ramp)]) for times in WARMING)]
    found = (_part(y, white, means.walks, curves, others) for y, white in zip(means.y.T, means.white.T, strict=True))
    return [
        TemperaturePart(float(np.ptp(T)), part, gain) if gain > SURE and part > MATERIAL else None
        for part, gain in found
    ]


def _hats(T: Array, pieces: int) -> Array:
    """Return columns (R, pieces): one at a knot, zero at the others, straight between; none for the first knot."""
    knots = np.linspace(np.min(T), np.max(T), pieces + 1)
    return np.stack([np.interp(T, knots, one) for one in np.eye(pieces + 1)[1:]], axis=1)


def _part(y: Array, white: Array, walks: list[Array], curves: list[Array], others: list[Array]) -> tuple[float, float]:
    """Return the part of the likeliest curve in the variance of what y (R,) moves, and what it gains beside others."""
    ramp = others[1]
    sets = [*others, *curves, *(np.hstack([curve, ramp]) for curve in curves)]
    own = [0] * len(others) + [curve.shape[1] for curve in curves] * 2  # columns over the temperature
    columns, ends = np.column_stack([y, *sets]), 1 + np.cumsum([one.shape[1] for one in sets])
    best = [(-np.inf, 0.0, 0.0)] * 2  # of the others and of the curves: likelihood, variance of a curve, of all
    for walk in walks:
        e, variances = whitened(columns, white, walk)
        e, determinant = e[np.isfinite(variances)], float(np.sum(np.log(variances[np.isfinite(variances)])))
        for one, q, end in zip(sets, own, ends, strict=True):
            X = e[:, end - one.shape[1] : end]
            found, *_ = np.linalg.lstsq(X, e[:, 0])
            scale = max(float(np.sum((e[:, 0] - X @ found) ** 2)), TINY) / len(e)
            likely = -(len(e) * np.log(scale) + determinant + X.shape[1] * np.log(len(e))) / 2
            moved = float(np.var(y - one[:, q:] @ found[q:]) - np.mean(white) * scale)  # but for the ramp
            of_curve = float(np.var(one[:, :q] @ found[:q]))
            best[q > 0] = max(best[q > 0], (float(likely), of_curve, moved))
    (without, *_), (likely, of_curve, moved) = best
    return of_curve / max(moved, of_curve, TINY), likely - without
