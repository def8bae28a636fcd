"""A step of the bias in a recording at rest, beside white noise and a walk.

One step raises the Allan deviation at long averaging times as a walk does: the slope is the same, and a curve does not
tell the two apart. The samples do: a walk moves a little all the time, a step moves once. So means y over R blocks are
held against a local level, white noise and walk of any ratio, without and with a step at one of the R - 1 instants::

    gain = max over ratio and instant of l(y | step) - max over ratio of l(y)

with l the largest log-likelihood for the strength of the noise, and for the size of the step. A gain of log R pays for
the choice of the instant. R blocks, d axes, G ratios.

Source: A. C. Harvey and S. J. Koopman, Diagnostic checking of unobserved-components time series models, J. Bus. Econ.
Stat. 10 (1992) 377: breaks of a level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftlab.noise.local_level import whitened
from fusion_core.chunk import Array, Integers

BLOCKS = 400  # that a recording is averaged to, about
RATIOS = np.concatenate([[0.0], np.logspace(-6, 2, 17)])  # of the walk's variance a block to the white noise's
SURE = 10.0  # nats beside the choice of the instant: noise and walk alone have them once in 20,000 recordings
MANY = 30  # samples of a block, whose scatter says how loud it is
TINY = np.finfo(float).tiny
MOST = 4 * BLOCKS  # a recording that is cut into more stretches is not looked at
EDGE = 3  # blocks at either end of the recording, where white noise of some rows would pass for a step


class BiasStep(NamedTuple):
    """A step of one axis: when it begins in s, its size and deviation in the axis's unit, and the nats that it gains.

    `walk` is the density of the walk beside it, in the unit/sqrt(s), and 0 where none is seen.
    """

    t: float
    size: float
    sigma: float
    gain: float
    walk: float


class BlockMeans(NamedTuple):
    """Means y (R, d) of R blocks of readings, at times t (R,) in s, the first of them begun at `starts` (R,).

    `white` (R, d) is the white noise of each beside the usual one, `walks` the variance (R,) by which the bias walks to
    each, for each of RATIOS; `usual` is the step between blocks in s, `rows` (R, 2) are first row and end of each.
    """

    starts: Array
    t: Array
    y: Array
    white: Array
    walks: list[Array]
    usual: float
    rows: Integers


def block_means(t: Array, rate: Array, stretches: Integers) -> BlockMeans | None:
    """Average readings `rate` (N, d) at times t (N,) in s; None where they are too few, or in too many pieces.

    `stretches` (S, 2) are first row and end of what can be used; what lies between is not read, and the bias walks on.
    """
    starts, last = _blocks(stretches)
    if not 4 * EDGE <= len(starts) <= MOST:
        return None
    rows = np.stack([starts, last], axis=1)
    at = (t[starts] + t[last - 1]) / 2
    dt = np.diff(at)
    usual = float(np.median(dt))
    walks = [np.concatenate([[np.inf], ratio * dt / usual]) for ratio in RATIOS]
    return BlockMeans(t[starts], at, mean_of(rate, rows), _white(rate, starts, last), walks, usual, rows)


def mean_of(values: Array, rows: Integers) -> Array:
    """Return the means (R, d) of values (N, d) between first rows and ends (R, 2)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - np.mean(values, axis=0), axis=0)])
    return np.asarray((total[rows[:, 1]] - total[rows[:, 0]]) / np.diff(rows, axis=1))


def bias_steps(means: BlockMeans | None, axes: int) -> list[BiasStep | None]:
    """Find the likeliest step of each of so many axes; None where none is seen, or there are no means to look at."""
    if means is None:
        return [None] * axes
    n = len(means.t)
    places = np.arange(EDGE, n - EDGE)
    steps_at = np.arange(n)[:, None] >= places
    steps: list[BiasStep | None] = []
    for y, white in zip(means.y.T, means.white.T, strict=True):
        found = [_gains(np.column_stack([y, steps_at]), white, walk) for walk in means.walks]
        without, with_step, size, sigma, scale = (np.stack(parts) for parts in zip(*found, strict=True))
        g, k = np.unravel_index(int(np.argmax(with_step)), with_step.shape)
        gain, density = float(with_step[g, k] - np.max(without)), float(np.sqrt(RATIOS[g] * scale[g, k] / means.usual))
        step = BiasStep(float(means.starts[places[k]]), float(size[g, k]), float(sigma[g, k]), gain, density)
        steps.append(step if gain > np.log(n) + SURE else None)
    return steps


def _white(rate: Array, starts: Integers, ends: Integers) -> Array:
    """Return variances (R, d) of the white noise of blocks beside the usual one; bursts have more, none has less."""
    n = (ends - starts)[:, None]
    squares = np.diff(rate, axis=0, prepend=rate[:1]) ** 2
    squares[starts] = 0.0  # of the row before
    total = np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(squares, axis=0)])
    own = (total[ends] - total[starts]) / np.maximum(n - 1, 1)
    usual = np.median(own, axis=0)
    known = (usual > 0) & (np.median(n) >= MANY)
    return np.asarray(np.maximum(np.divide(own, usual, out=np.ones_like(own), where=known), 1.0) * np.median(n) / n)


def _blocks(stretches: Integers) -> tuple[Integers, Integers]:
    """Return first rows and ends (R,) of blocks, alike in length but for the last one of each stretch."""
    lengths = stretches[:, 1] - stretches[:, 0]
    size = max(1, int(np.sum(lengths)) // BLOCKS)
    starts = np.concatenate([np.arange(a, b, size) for a, b in stretches])
    ends = np.concatenate([np.minimum(np.arange(a, b, size) + size, b) for a, b in stretches])
    return starts.astype(np.int64), ends.astype(np.int64)


def _gains(columns: Array, white: Array, walk: Array) -> tuple[float, Array, Array, Array, Array]:
    """Return log-likelihoods without a step and (K,) with one, its size, its deviation, and the noise's variance.

    `columns` (R, 1 + K) are the readings and the K steps; what is returned of these is (K,).
    """
    e, variances = whitened(np.ascontiguousarray(columns, dtype=np.float64), white, walk)
    known = np.isfinite(variances)
    y, h, R = e[known, 0], e[known, 1:], int(np.sum(known))
    square, length = float(y @ y), np.maximum(np.sum(h**2, axis=0), TINY)
    size = (y @ h) / length
    left = np.maximum(square - size**2 * length, TINY) / R
    determinant = float(np.sum(np.log(variances[known])))
    without = -(R * np.log(max(square, TINY) / R) + determinant) / 2
    return float(without), -(R * np.log(left) + determinant) / 2, size, np.sqrt(left / length), left
