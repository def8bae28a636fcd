"""What is left when no effect pays any more, and whether it is noise.

The innovations are white with unit variance where the model is right. Over windows of W blocks their sums, over the
square root of W, are then independent with unit variance again, at every time scale; and none stands out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from driftlab.loop.probe import span
from driftlab.loop.regression import Fit, Regression
from fusion_core.chunk import Array

SIGNIFICANT = 1e-5  # probability that noise alone shows so much at any of the time scales
_SETTLE = 3  # blocks after an alignment that are not looked at


@dataclass(frozen=True)
class Structure:
    """Something significant that is left: on which channel, at which time scale (s), and how sure (nats)."""

    channel: str
    time_scale: float
    description: str
    gain: float
    threshold: float


def dispersion(regression: Regression, fit: Fit) -> float:
    """Return how much more the innovations vary, or the largest stands out, than chance allows at the worst time scale.

    At least 1.

    Gains in likelihood are to be divided by it: where the noise is not the one of the model, they promise too much.
    P. McCullagh and J. A. Nelder, Generalized Linear Models (1989), section 4.5 (overdispersion).
    """
    from scipy.stats import chi2, norm

    sums = [z for _, z in _sums(regression, fit)]
    chance = 0.01 / (2 * len(sums))  # 1 % in all: two looks at each time scale
    worst = 1.0
    for z in sums:
        varying = float(np.sum(z**2) / chi2.isf(chance, z.size))
        outlying = float((np.max(np.abs(z)) / norm.isf(chance / (2 * z.size))) ** 2)
        worst = max(worst, varying, outlying)
    return worst


def structures(regression: Regression, fit: Fit) -> list[Structure]:
    """Return the time scale at which the innovations vary most beyond chance, and at which one of them stands out."""
    from scipy.stats import chi2, norm

    scales = list(_sums(regression, fit))
    limit = float(np.log(SIGNIFICANT / len(scales)))
    varying, outlying = [], []
    for W, z in scales:
        seconds = W * regression.evidence.interval
        p = float(chi2.logsf(float(np.sum(z**2)), z.size))
        text = f"over {span(seconds)} the innovations vary {np.mean(z**2):.2f} times as much as noise would"
        varying.append(Structure("time", seconds, text, -p, -limit))
        largest = float(np.max(np.abs(z)))
        p = float(norm.logsf(largest)) + float(np.log(2 * z.size))
        text = f"jumps within {span(seconds)}, the largest of {largest:.1f} deviations of the noise"
        outlying.append(Structure("time", seconds, text, -p, -limit))
    worst = [max(found, key=lambda s: s.gain) for found in (varying, outlying)]
    return [s for s in worst if s.gain > s.threshold]


def _sums(regression: Regression, fit: Fit) -> Iterator[tuple[int, Array]]:
    """Yield W and the normalised sums of the innovations over windows of W blocks, for W = 1, 2, 4, ..."""
    evidence = regression.evidence
    white = np.stack([regression.innovations(fit, axis)[0] for axis in range(len(evidence.axes))], axis=1)
    parts = []
    for record, part in zip(evidence.records, evidence.split(white), strict=True):
        last = np.maximum.accumulate(np.where(record.fresh, np.arange(len(record)), 0))
        parts.append(part[np.arange(len(record)) - last >= _SETTLE])
    longest = max(map(len, parts))
    W = 1
    while W == 1 or longest >= W * 8:
        sums = [part[: len(part) // W * W].reshape(-1, W, part.shape[1]).sum(axis=1) / np.sqrt(W) for part in parts]
        yield W, np.concatenate(sums)
        W *= 2
