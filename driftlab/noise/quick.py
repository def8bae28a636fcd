"""Noise of a sensor by a part of its recording: white noise and walk of the quietest stretch.

::

    N = allan(tau) sqrt(tau) at the shortest averaging times     B = min allan(tau)     walk = sqrt(3)/2 B^2 / N

The walk is that whose Allan curve, with the white noise above it, has its minimum at B: as data sheets allow,
too (docs/explanation/noise.md). A short stretch has not seen the minimum: the walk is then at most that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftlab.noise.allan import curve
from fusion_core.chunk import Array

MIN_SAMPLES = 200  # of a stretch
WINDOWS = 20  # in which the rows are looked at
STILL = 2.0  # times the scatter of the quietest window: more is motion
GAP = 1.5  # usual steps


@dataclass(frozen=True)
class QuickNoise:
    """White noise and walk (d,) in the values' unit per sqrt(Hz) and per sqrt(s); of `seconds` from `start` on."""

    white: Array
    walk: Array
    start: float
    seconds: float


def noise_of(t: Array, values: Array) -> QuickNoise | None:
    """Return the noise of values (N, d) at times t (N,), s; None where there is too little, or nothing moves."""
    rows = _quietest(t, values)
    if rows is None:
        return None
    quiet = values[rows]
    dt = float(np.median(np.diff(t[rows])))
    white, walk = np.empty(values.shape[1]), np.empty(values.shape[1])
    for k in range(values.shape[1]):
        allan = curve(np.ascontiguousarray(quiet[:, k]), dt)
        early = allan.tau <= max(1.0, 4 * dt)
        white[k] = float(np.median(allan.allan[early] * np.sqrt(allan.tau[early])))
        walk[k] = np.sqrt(3) / 2 * float(np.min(allan.allan)) ** 2 / white[k] if white[k] > 0 else 0.0
    if not np.all(white > 0):
        return None
    return QuickNoise(white, walk, float(t[rows.start] - t[0]), len(quiet) * dt)


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
