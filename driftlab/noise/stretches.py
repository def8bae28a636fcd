"""Where a recording can be used: stretches without a gap, at rest.

N samples, S stretches, n windows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.noise.curves import ORDER
from driftlab.samples.epochs import GAP, epochs
from fusion_core.chunk import Array, Chunk, concatenate

if TYPE_CHECKING:
    from fusion_core.contracts import MeasurementModel
    from fusion_core.model import Flags

Index = NDArray[np.int64]

LEAST = 100  # samples in all that an Allan deviation needs
SHORTEST = 30  # samples in the longest stretch; with fewer there is not a decade of averaging times
MOST = 0.5  # of the windows; where more of them move than that, the declared noise is wrong and not the bench


@dataclass(frozen=True)
class Rest:
    """Windows of `length` s that have samples, and whether the unit was at rest in each.

    `numbers` (n,) count windows from the time t_0, s; `still` (n,) says which were at rest.
    """

    t_0: float
    length: float
    numbers: Index
    still: Flags

    @property
    def doubtful(self) -> bool:
        """Whether so many windows look like motion that it is the noise that is not as declared."""
        return bool(np.mean(~self.still) > MOST)

    @property
    def moving(self) -> Array:
        """Begin of the windows in which the unit moved, s."""
        return np.asarray(self.t_0 + self.length * self.numbers[~self.still], dtype=np.float64)

    @property
    def longest(self) -> tuple[float, float] | None:
        """Begin and end of the longest rest, s; None where there is none."""
        cuts = np.concatenate([[-1], np.flatnonzero(~self.still), [len(self.still)]])
        k = int(np.argmax(np.diff(cuts)))
        if cuts[k + 1] - cuts[k] < 2:
            return None
        first, last = self.numbers[[cuts[k] + 1, cuts[k + 1] - 1]]
        return self.t_0 + self.length * float(first), self.t_0 + self.length * float(last + 1)

    def rows(self, t: Array) -> Flags:
        """Return which samples at times t (N,) lie in windows at rest; others go with a window beside them."""
        window = np.searchsorted(self.numbers, np.floor((t - self.t_0) / self.length), side="right") - 1
        return np.asarray(self.still[np.maximum(window, 0)], dtype=np.bool_)


def at_rest(settings: MeasurementModel, samples: Chunk) -> Rest:
    """Judge windows of the alignment's length by the filter's own measure of rest."""
    stream = concatenate(epochs([samples], settings.update_interval))
    t_0 = float(stream.t[0])
    # one of them at the end that is not whole says no more than that it is short
    whole = max(1, int((stream.t[-1] - t_0) / settings.align))
    number = np.minimum(np.floor((stream.t - t_0) / settings.align), whole - 1).astype(np.int64)
    numbers, first = np.unique(number, return_index=True)
    windows = (stream.part(a, b) for a, b in pairwise([*first.tolist(), len(stream)]))
    still = [len(window) < 3 or settings.still(window) for window in windows]
    return Rest(t_0, settings.align, numbers, np.array(still, dtype=np.bool_))


def runs(t: Array, usable: Flags | None = None) -> Index:
    """Return first row and end (S, 2) of the runs of usable samples without a step longer than GAP times the median.

    Runs that are too short for any averaging time are left out.
    """
    if len(t) < 2:
        return np.empty((0, 2), dtype=np.int64)
    step = np.diff(t)
    cut = step > GAP * np.median(step)
    if usable is not None:
        cut |= usable[1:] != usable[:-1]
    edges = np.concatenate([[0], np.flatnonzero(cut) + 1, [len(t)]])
    found = np.stack([edges[:-1], edges[1:]], axis=1)
    if usable is not None:
        found = found[usable[found[:, 0]]]
    return found[np.diff(found, axis=1)[:, 0] >= ORDER]


def enough(stretches: Index) -> bool:
    """Whether stretches (S, 2) have samples enough for an Allan deviation."""
    lengths = np.diff(stretches, axis=1)[:, 0]
    return bool(np.sum(lengths) >= LEAST and np.max(lengths) >= SHORTEST)


def limits(t: Array, stretches: Index) -> tuple[float, float]:
    """Return the shortest and the longest step within stretches (S, 2), s."""
    step = np.diff(t)
    inside: Index = np.ravel(stretches - [0, 1]).astype(np.int64)  # steps from the first row to the last one
    inside = inside[:-1] if inside[-1] == len(step) else inside
    low, high = (f.reduceat(step, inside.tolist())[::2] for f in (np.minimum, np.maximum))
    return float(low.min()), float(high.max())
