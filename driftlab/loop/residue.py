"""What is left when nothing is added any more, and whether it is noise.

The errors of predicting each row from those before (`driftlab.loop.noise`) are white with unit variance, once divided
by their deviation, where the fast part of what is left says all of it. Over windows of W rows their sums, over the
square root of W, are then independent with unit variance again, at every time scale; and none stands out. What is
significant is told only where it matters to one who coasts: where what is left is slow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from driftlab.loop.noise import one_step
from driftlab.loop.probe import span
from driftlab.loop.state import Search
from fusion_core.chunk import Array

SIGNIFICANT = 1e-5  # probability that noise alone shows so much at any of the time scales
SLOW = 120.0  # s: what is left over means of that length spoils a coast
MATTERS = 0.5  # of the error on left-out parts
BEYOND = 700.0  # nats: exp of minus that is nearly the least number of a computer
SETTLE = 3  # rows of a recording whose average is not yet of many


@dataclass(frozen=True)
class Structure:
    """Something significant that is left: on which channel, at which time scale (s), and how sure (nats)."""

    channel: str
    time_scale: float
    description: str
    gain: float
    threshold: float


def structures(found: Search, error: Array) -> list[Structure]:
    """Return whether what is left varies beyond its noise, and the time scale at which some of it stands out.

    `error` (d,) is that of the model on left-out parts, SI.
    """
    from scipy.stats import chi2, norm

    columns, slices = found.columns, found.columns.evidence.slices
    interval, d = columns.evidence.interval, len(columns.y)
    fits = [found.squares.fit(found.model, axis, found.everything) for axis in range(d)]
    left = np.stack([found.squares.residual(axis, fit) for axis, fit in enumerate(fits)], axis=1)
    parts = [left[rows] * columns.scale[columns.y] for rows in slices]
    if not _slow(interval, parts, error):
        return []
    scales = list(_sums(_white(found, [left[rows] for rows in slices])))
    limit = -float(np.log(SIGNIFICANT / len(scales)))
    unit = columns.evidence.unit
    size, stays = float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) * unit.factor, _stays(interval, parts)
    wanders = f"what is left, {size:.3g} {unit.shown} rms, stays for about {span(stays)}, and not as noise does"
    varying, outlying = [], []
    for W, z in scales:
        p = float(chi2.logsf(float(np.sum(z**2)), z.size))
        varying.append(Structure("time", stays, wanders, min(-p, BEYOND), limit))
        largest = float(np.max(np.abs(z)))
        p = float(norm.logsf(largest)) + float(np.log(2 * z.size))
        text = f"what is left jumps within {span(W * interval)}, at most by {largest:.1f} deviations of its noise"
        outlying.append(Structure("time", W * interval, text, min(-p, BEYOND), limit))
    worst = [max(seen, key=lambda s: s.gain) for seen in (varying, outlying)]
    return [s for s in worst if s.gain > s.threshold]


def _white(found: Search, parts: list[Array]) -> list[Array]:
    """Return the one-step errors (n', d) of what is left (n, d) of each recording, in their deviation."""
    axes = [
        [e[SETTLE:] / np.sqrt(noise.variance) for e in one_step([part[:, axis] for part in parts], noise.gain)]
        for axis, noise in enumerate(found.noises)
    ]
    return [np.stack(errors, axis=1) for errors in zip(*axes, strict=True)]


def _slow(interval: float, parts: list[Array], error: Array) -> bool:
    """Return whether means of what is left (n, d) are a good part of the error (d,), on any axis."""
    W = max(1, round(SLOW / interval))
    means = np.concatenate([_windows(part, W).mean(axis=1) for part in parts])
    return bool(len(means) and np.any(np.sqrt(np.mean(means**2, axis=0)) > MATTERS * error))


def _stays(interval: float, parts: list[Array]) -> float:
    """Return the time (s) after which what is left (n, d) is half forgotten, white noise apart."""
    lags = np.unique(np.geomspace(1, max(max(map(len, parts)) // 2, 1), 60).astype(int))
    forgotten = lags[-1]
    covariance = [
        np.sum([np.sum(part[k:] * part[: len(part) - k]) for part in parts if len(part) > k])
        / sum(len(part) - k for part in parts if len(part) > k)
        for k in lags
    ]
    for k, value in zip(lags, covariance, strict=True):
        if value < covariance[0] / 2:
            forgotten = k
            break
    return float(interval * forgotten)


def _windows(part: Array, W: int) -> Array:
    return part[: len(part) // W * W].reshape(-1, W, part.shape[1])


def _sums(parts: list[Array]) -> Iterator[tuple[int, Array]]:
    """Yield W and the normalised sums (k, d) of white parts (n, d) over windows of W rows, for W = 1, 2, 4, ..."""
    longest = max(map(len, parts))
    W = 1
    while W == 1 or longest >= W * 8:
        yield W, np.concatenate([_windows(part, W).sum(axis=1) / np.sqrt(W) for part in parts])
        W *= 2
