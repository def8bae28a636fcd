"""Which parts of a soak are left out in turn, when kinds of maps are compared.

Samples that follow one another are not independent: a bias that wanders over hours is the same in a sample and in its
neighbours, so a sample drawn at random is predicted by what it is to judge. Left out are, of a soak that passes its
temperatures more than once, contiguous parts of time: a map learns their temperatures from another time. What a bias
has wandered meanwhile is taken off as one constant a part: it is no temperature's. Of several recordings each is left
out as a whole. Of a soak that passes each temperature once, ranges of temperature are left out, and nothing is taken
off: there the walk of the bias and the shape of the map are the same.

K blocks (`blocks.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.samples.turning import Index, sweeps_of
from fusion_core.chunk import Array

PARTS = 10  # of time, about
SWEEPS = 6  # with that many, each is a part
TURN = 0.25  # of the range: a smaller way back is no turn
RANGES, FOLDS = 25, 5  # of temperature, where each is passed once
NEAR = 0.025  # of the range: what is further from any other sample is not scored
ENOUGH = 0.5  # share of the blocks to be scored


@dataclass(frozen=True, eq=False)
class Division:
    """What is left out together, and what is scored.

    Attributes
    ----------
    fold : (K,) array
        Which blocks are left out together; -1: never.
    part : (K,) array
        Whose errors stand for one another; where `levels`, each has a constant of its own.
    scored : (K,) array of bool
        Blocks whose temperature is also in what was not left out with them.
    levels : bool
        Whether a constant is taken off each level.
    level : (K,) array
        Which blocks share a constant.
    what : str
        The parts, in words.
    """

    fold: Index
    part: Index
    scored: NDArray[np.bool_]
    levels: bool
    level: Index
    what: str

    @property
    def share(self) -> float:
        """Share of the blocks that is scored."""
        return float(np.mean(self.scored))


def divide(recordings: Sequence[Array]) -> Division:
    """Return how to divide recordings, of which T (K_r,) are the blocks in the order of time."""
    T = np.concatenate(recordings)
    sizes = np.array([len(own) for own in recordings])
    recording = np.repeat(np.arange(len(sizes)), sizes)
    sweeps = _numbered([sweeps_of(own, TURN * np.ptp(T)) for own in recordings])
    pieces = _pieces(sweeps)
    if len(recordings) > 1:
        found = _division(T, recording, pieces, recording, f"each of {len(recordings)} recordings")
        if found.share >= ENOUGH:
            return found
    count = int(sweeps[-1]) + 1
    passes = f"{count} sweep" + "s" * (count > 1)
    what = f"each of {passes}" if count >= SWEEPS else f"{pieces[-1] + 1} parts of time of {passes}"
    found = _division(T, pieces, pieces, pieces, what)
    return found if found.share >= ENOUGH else _ranges(T)


def _pieces(sweeps: Index) -> Index:
    """Cut sweeps into about `PARTS` contiguous pieces of equal length, or leave them whole where there are many."""
    lengths = np.bincount(sweeps)
    if len(lengths) >= SWEEPS:
        return sweeps
    counts = np.maximum(np.rint(PARTS * lengths / len(sweeps)), 1).astype(np.int64)
    return _numbered([np.arange(n) * count // n for n, count in zip(lengths, counts, strict=True)])


def _ranges(T: Array) -> Division:
    """Leave out every `FOLDS`th range of temperature, but neither end."""
    cell = np.minimum(((T - T.min()) * (RANGES / np.ptp(T))).astype(np.int64), RANGES - 1)
    fold = np.where((cell == 0) | (cell == RANGES - 1), -1, cell % FOLDS)
    what = f"every {FOLDS}th of {RANGES} ranges of temperature"
    return _division(T, fold, cell, np.zeros_like(cell), what, levels=False)


def _division(T: Array, fold: Index, part: Index, level: Index, what: str, *, levels: bool = True) -> Division:
    scored = np.zeros(len(T), dtype=np.bool_)
    for k in range(int(fold.max()) + 1):
        out, others = fold == k, np.sort(T[fold != k])
        if not len(others):
            continue
        at = np.searchsorted(others, T[out])
        inside = (at > 0) & (at < len(others))
        near = np.minimum(
            np.abs(T[out] - others[np.maximum(at - 1, 0)]), np.abs(others[np.minimum(at, len(others) - 1)] - T[out])
        )
        scored[out] = (inside | (near == 0)) & (near <= NEAR * np.ptp(T))
    return Division(fold, part, scored, levels, level, what)


def _numbered(parts: Sequence[Index]) -> Index:
    """Join numbers that each begin at zero to numbers that go on."""
    joined: list[Index] = []
    for own in parts:
        joined.append(own + (joined[-1][-1] + 1 if joined else 0))
    return np.concatenate(joined)
