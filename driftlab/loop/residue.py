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
SLOW = 300.0  # s: what is left over means of that length spoils a coast
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
    """Return the time scale at which what is left varies most beyond its noise, and at which some of it stands out.

    `error` (d,) is that of the model on left-out parts, rad/s.
    """
    from scipy.stats import chi2, norm

    columns, slices = found.columns, found.columns.evidence.slices
    left = [
        found.squares.residual(found.model, axis, found.squares.fit(found.model, axis, found.everything))
        for axis in range(len(columns.y))
    ]
    white = [
        np.stack([e[SETTLE:] for e in columns_of], axis=1)
        for columns_of in zip(*(
            [part / np.sqrt(noise.variance) for part in one_step([own[rows] for rows in slices], noise.gain)]
            for own, noise in zip(left, found.noises, strict=True)
        ), strict=True)
    ]  # fmt: skip
    scales = list(_sums(white))
    residual = np.stack(left, axis=1) * columns.scale[columns.y]
    if not _slow(columns.evidence.interval, [residual[rows] for rows in slices], error):
        return []
    limit = float(np.log(SIGNIFICANT / len(scales)))
    varying, outlying = [], []
    for W, z in scales:
        seconds = W * columns.evidence.interval
        p = float(chi2.logsf(float(np.sum(z**2)), z.size))
        text = f"over {span(seconds)} it varies {np.mean(z**2):.2f} times as much as its noise would"
        varying.append(Structure("time", seconds, text, min(-p, BEYOND), -limit))
        largest = float(np.max(np.abs(z)))
        p = float(norm.logsf(largest)) + float(np.log(2 * z.size))
        text = f"jumps within {span(seconds)}, the largest of {largest:.1f} deviations of the noise"
        outlying.append(Structure("time", seconds, text, min(-p, BEYOND), -limit))
    worst = [max(seen, key=lambda s: s.gain) for seen in (varying, outlying)]
    return [s for s in worst if s.gain > s.threshold]


def _slow(interval: float, parts: list[Array], error: Array) -> bool:
    """Return whether means of what is left (n, d) are a good part of the error (d,), on any axis."""
    W = max(1, round(SLOW / interval))
    means = np.concatenate([_windows(part, W).mean(axis=1) for part in parts])
    return bool(len(means) and np.any(np.sqrt(np.mean(means**2, axis=0)) > MATTERS * error))


def _windows(part: Array, W: int) -> Array:
    return part[: len(part) // W * W].reshape(-1, W, part.shape[1])


def _sums(parts: list[Array]) -> Iterator[tuple[int, Array]]:
    """Yield W and the normalised sums (k, d) of white parts (n, d) over windows of W rows, for W = 1, 2, 4, ..."""
    longest = max(map(len, parts))
    W = 1
    while W == 1 or longest >= W * 8:
        yield W, np.concatenate([_windows(part, W).sum(axis=1) / np.sqrt(W) for part in parts])
        W *= 2
