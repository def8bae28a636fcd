"""Noise of a sensor by a part of its recording: white noise of the quietest stretch, and walk beside the temperature.

The white noise is the Allan deviation at the shortest averaging times. The walk is the likeliest one in means of all
that is quiet, beside any smooth curve of the temperature, and of how fast it moves: a bias that follows a ramp is no
walk. It is known where the limits of 99 % of its likelihood are within a factor of it, and curves that bend within a
kelvin, as those of units with a step do, leave it as large; else its upper limit is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from driftlab.noise.allan import curve
from driftlab.noise.local_level import LevelLikelihood
from driftlab.recordings.plausibility import alone, usual_change
from fusion_core.chunk import Array, Flags

MIN_SAMPLES = 200  # of a stretch
WINDOWS = 20  # in which the rows are looked at
STILL = 2.0  # times the scatter of the quietest window: more is motion
GAP = 1.5  # usual steps
MIN_IN_MEAN = 8  # samples, of which the scatter about a line tells motion
MEANS = 1500  # from which the walk is estimated, at most
COLUMNS = 16  # of curves over the temperature, at most
BEND, STEP = 4.0, 1.0  # K, between knots: of a curve that bends, and of one with a step
STEPS = 96  # columns of such curves, at most
LAG = 300.0  # s, of what follows the temperature
RATIOS = np.geomspace(1e-8, 1e4, 73)  # of the walk's variance from mean to mean to that of their white noise
DEPENDENT = 1e-9  # of the largest singular value: columns that are combinations of others
LIMIT = 6.63  # of -2 log likelihood at 99 %
FACTOR = 2.0  # between the walk and its limits, at most, where it is known


@dataclass(frozen=True)
class QuickNoise:
    """White noise and walk (d,) in the values' unit per sqrt(Hz) and per sqrt(s); of `seconds` from `start` on.

    `known` (d,) says of which axes the walk is known; that of the others is at most so.
    """

    white: Array
    walk: Array
    start: float
    seconds: float
    known: Flags


def noise_of(t: Array, values: Array, temperature: Array | None = None) -> QuickNoise | None:
    """Return the noise of values (N, d) at times t (N,), s; None where there is too little, or nothing moves.

    `temperature` (N,) is that of the sensor, in any unit; without one its drift cannot be separated from a walk.
    """
    values = _mended(values)
    rows = _quietest(t, values)
    if rows is None:
        return None
    quiet = values[rows]
    dt = float(np.median(np.diff(t[rows])))
    white = np.empty(values.shape[1])
    for k in range(values.shape[1]):
        allan = curve(np.ascontiguousarray(quiet[:, k]), dt)
        early = allan.tau <= max(1.0, 4 * dt)
        white[k] = float(np.median(allan.allan[early] * np.sqrt(allan.tau[early])))
    if not np.all(white > 0):
        return None
    walk, known = _walk(t, values, temperature)
    return QuickNoise(white, walk, float(t[rows.start] - t[0]), len(quiet) * dt, known)


def _mended(values: Array) -> Array:
    """Return values (N, d) with the means of the neighbours in the place of readings that stand alone far off."""
    mended = values.copy()
    for x, usual in zip(mended.T, usual_change(values), strict=True):
        rows = alone(x, usual)
        x[rows] = (x[rows - 1] + x[rows + 1]) / 2
    return mended


def _walk(t: Array, values: Array, temperature: Array | None) -> tuple[Array, Flags]:
    """Return the walk (d,) of means beside curves of the temperature, and where it is known; else its upper limit."""
    T = np.zeros(len(t)) if temperature is None else temperature
    good = np.isfinite(t) & np.isfinite(T) & np.all(np.isfinite(values), axis=1)
    if temperature is not None and np.sum(good) < MIN_SAMPLES:  # of rows of their own, as some loggers write
        return _walk(t, values, None)
    n = max(1, int(np.sum(good)) // MEANS)
    K = int(np.sum(good)) // n
    cut = [x[good][: K * n].reshape(K, n, -1) for x in (t, T, values)]
    times, means, y = (np.mean(x, axis=1) for x in cut)
    scatter = _scatter(cut[2]) if n >= MIN_IN_MEAN else np.ones((K, 1))
    moving = np.any(scatter > STILL * np.median(scatter, axis=0), axis=1)
    step = float(np.median(np.diff(times[:, 0])))
    dt = np.concatenate([[np.inf], np.maximum(np.diff(times[:, 0]) / step, 0.0)])
    white = np.where(moving, np.inf, 1.0)
    found = []
    for X in (*_curves(times[:, 0], means[:, 0]), _orthonormal(_cubic(means[:, 0], STEP, STEPS))):
        costs, scales = LevelLikelihood([(np.hstack([X, y - y[:1]]), white, dt)], X.shape[1]).over(RATIOS)
        walks = np.sqrt(RATIOS[:, None] * scales / step)
        likely = np.where(costs - np.min(costs, axis=0) <= LIMIT, walks, np.nan)
        best = walks[np.argmin(costs, axis=0), np.arange(y.shape[1])]
        found.append((np.nanmin(likely, axis=0), best, np.nanmax(likely, axis=0)))
    *found, (_, beside_steps, _) = found
    walk, all_found = found[0][1], np.array(found)
    known = (np.max(all_found, axis=(0, 1)) <= FACTOR * walk) & (FACTOR * np.min(all_found, axis=(0, 1)) >= walk)
    known &= (temperature is not None) & (FACTOR * beside_steps >= walk)
    return np.where(known, walk, np.max(all_found, axis=(0, 1))), known


def _curves(t: Array, T: Array) -> Iterator[Array]:
    """Yield columns (K, q) of any smooth curve of the temperature and how it moves, then without that, orthonormal.

    Through the noise of the thermometer a steep curve looks like a walk, to each of the two in another size.
    """
    span = float(np.ptp(T))
    if span == 0:
        yield np.empty((len(t), 0))
        return
    slow = T.copy()
    for k in range(1, len(T)):
        slow[k] = slow[k - 1] + (T[k] - slow[k - 1]) * -np.expm1(-max(t[k] - t[k - 1], 0.0) / LAG)
    cubic = _cubic(T, BEND, COLUMNS)
    yield _orthonormal(np.column_stack([cubic, (T - slow) / span]))
    yield _orthonormal(cubic)


def _cubic(T: Array, bend: float, most: int) -> Array:
    """Return the cubic splines (K, q) of a temperature with knots `bend` K apart, or `most` intervals of them."""
    from scipy.interpolate import BSpline

    span = float(np.ptp(T))
    if span == 0:
        return np.empty((len(T), 0))
    knots = np.linspace(T.min(), T.max(), int(np.clip(span / bend, 1, most)) + 1)
    return np.asarray(BSpline.design_matrix(T, np.concatenate([knots[[0] * 3], knots, knots[[-1] * 3]]), 3).toarray())


def _orthonormal(columns: Array) -> Array:
    """Return orthonormal columns (K, r) of the same space, but for a constant; r is its dimension."""
    from scipy.linalg import orth

    return np.asarray(orth(columns - columns.mean(axis=0), DEPENDENT)) if columns.shape[1] else columns


def _quietest(t: Array, values: Array) -> slice | None:
    """Return the longest run of windows in which the values scatter little, within the longest run without a gap."""
    step = np.diff(t)
    good = np.all(np.isfinite(values), axis=1) & np.isfinite(t)
    usual = float(np.median(step[step > 0])) if np.any(step > 0) else 0.0
    broken = ~good[1:] | ~good[:-1] | (step > GAP * usual) | (step <= 0)
    begin, end = _longest(np.concatenate([[True], broken, [True]]))
    size = max(MIN_SAMPLES // 2, (end - begin) // WINDOWS)
    count = (end - begin) // size
    if count < 2:
        return None
    scatter = _scatter(values[begin : begin + count * size].reshape(count, size, -1))
    floor = np.min(scatter, axis=0)
    if not np.all(floor > 0):
        return None
    still = np.all(scatter <= STILL * floor, axis=1)
    first, last = _longest(np.concatenate([[True], ~(still[1:] & still[:-1]), [True]]))
    return slice(begin + first * size, begin + last * size)


def _scatter(windows: Array) -> Array:
    """Return the standard deviation of each window (count, d) about a straight line: a slow drift is no motion."""
    x = np.linspace(-1, 1, windows.shape[1])[None, :, None]
    level = np.mean(windows, axis=1, keepdims=True)
    slope = np.sum(x * (windows - level), axis=1, keepdims=True) / np.sum(x * x)
    return np.asarray(np.std(windows - level - slope * x, axis=1), dtype=np.float64)


def _longest(cuts: Array) -> tuple[int, int]:
    """Return first and end of the longest run of items between cuts."""
    places = np.flatnonzero(cuts)
    k = int(np.argmax(np.diff(places)))
    return int(places[k]), int(places[k + 1])
