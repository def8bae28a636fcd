"""The errors of a run for its figures: every spike of them, in a few points.

Rows that are picked evenly from a long run miss what lasts shorter than their distance. So each stretch of a run gives
its smallest and its largest error, at the time of its middle: a line through them reaches as far as the errors do.
N rows, d axes, K stretches.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fusion_core.chunk import Array

STRETCHES = 750  # two points each


class Envelope:
    """Smallest and largest error of the estimate and of the coast, block after block of N rows in all."""

    def __init__(self, N: int, d: int) -> None:
        self.N, self.at = N, 0
        K = min(STRETCHES, N)
        self.t = np.zeros((2, K))  # first and last
        self.extremes = {name: np.full((2, K, d), np.nan) for name in ("bias", "coast")}

    def add(self, block: Mapping[str, Array]) -> None:
        """Take the next block, with its `reference`; an error is not known where the reference is not."""
        N, K, rows = self.N, self.t.shape[1], len(block["t"])
        these = np.arange(self.at * K // N, (self.at + rows - 1) * K // N + 1)  # row r is of stretch r K // N
        starts = np.maximum(-(-these * N // K) - self.at, 0)
        stops = np.append(starts[1:], rows) - 1
        begun = int(self.at > 0 and these[0] == (self.at - 1) * K // N)  # by the block before
        self.t[0, these[begun:]] = block["t"][starts[begun:]]
        self.t[1, these] = block["t"][stops]
        for name, (low, high) in self.extremes.items():
            error = block[name] - block["reference"]
            low[these] = np.fmin(low[these], np.fmin.reduceat(error, starts))
            high[these] = np.fmax(high[these], np.fmax.reduceat(error, starts))
        self.at += rows

    def curves(self) -> dict[str, Array]:
        """Return `t` (2 K,) in s and the errors `bias` and `coast` (2 K, d) in SI, smallest and largest in turn."""
        (first, last), quarter = self.t, (self.t[1] - self.t[0]) / 4
        found = {name: _in_turn(low, high) for name, (low, high) in self.extremes.items()}
        return {"t": _in_turn(first + quarter, last - quarter), **found}


def _in_turn(first: Array, second: Array) -> Array:
    """Return rows of two arrays (K, ...) in turn, (2 K, ...)."""
    return np.stack([first, second], axis=1).reshape(2 * len(first), *first.shape[1:])
