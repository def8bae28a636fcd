"""Soaks of one unit that contradict one another: an axis that is negated, in another unit, or exchanged with another.

Of each recording the bias is averaged over cells of the temperature. Over the cells that two recordings have, their
levels taken off, one goes with the other by a factor b, which is 1 of one unit but for hysteresis and walk. N samples,
K cells, d axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import numpy as np

from driftlab.units import axis_name
from fusion_core.chunk import Array

CELLS, SHARED = 40, 8  # cells of temperature, and those that both must have
ALIKE = 0.9  # correlation of cells that go together
FACTOR = 2.0  # more than that, or less than its inverse, is another unit
EXCHANGED = 0.5  # correlation with the axis itself, at most, where another one's is ALIKE


def contradictions(
    T: Sequence[Array], bias: Sequence[Array], names: Sequence[str], channel: str, axes: Sequence[str]
) -> list[str]:
    """Return a sentence on what is wrong of recordings, T (N,) and bias (N, d) each, beside most of the others.

    Of two recordings it is the second that contradicts the first.
    """
    low, high = min(map(np.min, T)), max(map(np.max, T))
    means = [_cells((own - low) / max(high - low, 1e-9), each) for own, each in zip(T, bias, strict=True)]
    found = []
    for r in range(len(T) == 2, len(T)):
        wrong: dict[tuple[int, ...], list[float]] = {}
        for other in (*means[:r], *means[r + 1 :]):
            for axis, factor in _compared(means[r], other).items():
                wrong.setdefault(axis, []).append(factor)
        for which, factors in wrong.items():
            if 2 * len(factors) <= len(T) - 1:
                continue  # the others do not agree either
            named = " and ".join(axis_name(channel, axes[k]) for k in which)
            text = (
                f"goes with that of the other recordings by a factor of {median(factors):.2g}; correct sign and unit of"
            )
            text = text if len(which) == 1 else "are exchanged beside the other recordings; correct the order in"
            found.append(f"{names[r]}: {named} {text} source.channels.{channel}, or fit it alone")
    return found


def _cells(place: Array, bias: Array) -> Array:
    """Return the mean bias (CELLS, d) of samples in each cell, NaN without any; their places (N,) are from 0 to 1."""
    cell = np.minimum((place * CELLS).astype(np.int64), CELLS - 1)
    n = np.bincount(cell, minlength=CELLS)
    return np.stack([np.bincount(cell, column, CELLS) / np.where(n > 0, n, np.nan) for column in bias.T], axis=1)


def _compared(one: Array, other: Array) -> dict[tuple[int, ...], float]:
    """Return the axes of cells (K, d) that contradict others (K, d), with their factors; a pair is exchanged."""
    both = np.isfinite(one[:, 0]) & np.isfinite(other[:, 0])
    if np.sum(both) < SHARED:
        return {}
    one, other = (part[both] - part[both].mean(axis=0) for part in (one, other))
    square, tiny = np.sum(other**2, axis=0), np.finfo(float).tiny
    products = other.T @ one  # (d of the others, d of this one)
    r = products / np.maximum(np.sqrt(np.outer(square, np.sum(one**2, axis=0))), tiny)
    wrong: dict[tuple[int, ...], float] = {}
    for i, j in np.argwhere(np.triu(np.minimum(r, r.T), 1) > ALIKE).tolist():
        if max(r[i, i], r[j, j]) < EXCHANGED:
            wrong[i, j] = 1.0
    for k in set(range(len(r))) - {k for pair in wrong for k in pair}:
        factor = products[k, k] / max(square[k], tiny)
        if abs(r[k, k]) > ALIKE and not 1 / FACTOR < factor < FACTOR:
            wrong[k,] = float(factor)
    return wrong
