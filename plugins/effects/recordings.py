"""What the recordings of a search say about the grids of hyper-parameters that are worth trying on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion_core.chunk import Array, Chunk

_NOISE = 6.0  # deviations of the thermometer: noise of thousands of samples spans about that much


def longest_span(recordings: Sequence[Chunk]) -> float:
    """Return how long the longest recording lasts, in s."""
    return max(float(chunk.t[-1] - chunk.t[0]) for chunk in recordings)


def up_to(grid: Array, most: float) -> list[float]:
    """Return the values of a grid that are at most `most`."""
    return [float(value) for value in grid if value <= most]


def largest_reversal(x: Array) -> float:
    """Return the largest way back of x (N,) after a turn, either way; 0 where there is none beyond its ripple.

    A way back counts up to twice the way there: a play that starts in its middle is dragged after half its width, and
    what it is not dragged through, it does not answer to differently.
    """
    found = max(_largest_drop(x), _largest_drop(-x))
    steps = np.abs(np.diff(x))
    steps = steps[steps > 0]
    if len(steps) < 2:
        return 0.0
    noise = float(np.median(np.abs(np.diff(x, n=2)))) / 0.6745 / np.sqrt(6)
    return found if found > max(_NOISE * noise, 1.5 * float(np.min(steps))) else 0.0


def _largest_drop(x: Array) -> float:
    before = x - np.minimum.accumulate(x)
    after = x - np.minimum.accumulate(x[::-1])[::-1]
    return float(np.max(np.minimum(2 * before, after), initial=0.0))
