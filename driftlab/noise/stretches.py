"""Stretches of a recording that can be used: without a gap, at rest.

N samples, S stretches, n windows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.noise.allan import bridgeable
from driftlab.recordings.epochs import GAP, epochs
from fusion_core.chunk import Array, Chunk, concatenate

if TYPE_CHECKING:
    from fusion_core.contracts import MeasurementModel
    from fusion_core.model import Flags

Index = NDArray[np.int64]

MIN_SAMPLES = 100  # in all that an Allan deviation needs
MIN_STRETCH = 30  # samples in the longest stretch; with fewer there is not a decade of averaging times
NEAR = 10  # samples at each end of a gap that say when it begins and ends
NEVER = 10**15  # samples: so long a gap is not bridged
MAX_MOVING = 0.5  # of the windows; where more of them move than that, the declared noise is wrong and not the bench


@dataclass(frozen=True)
class RestWindows:
    """Windows of `length` s that have samples, and whether the unit was at rest in each.

    `numbers` (n,) count windows from the time t_0, s; `still` (n,) says which were at rest.
    """

    t_0: float
    length: float
    numbers: Index
    still: Flags

    @property
    def doubtful(self) -> bool:
        """True if so many windows look like motion that it is the noise that is not as declared."""
        return bool(np.mean(~self.still) > MAX_MOVING)

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
        """Return the samples at times t (N,) in windows at rest; those between windows go with one beside them."""
        window = np.searchsorted(self.numbers, np.floor((t - self.t_0) / self.length), side="right") - 1
        return np.asarray(self.still[np.maximum(window, 0)], dtype=np.bool_)


def at_rest(settings: MeasurementModel, samples: Chunk) -> RestWindows:
    """Judge windows of the alignment's length by the filter's own measure of rest."""
    stream = concatenate(epochs([samples], settings.update_interval))
    t_0 = float(stream.t[0])
    # one of them at the end that is not whole says no more than that it is short
    whole = max(1, int((stream.t[-1] - t_0) / settings.align))
    number = np.minimum(np.floor((stream.t - t_0) / settings.align), whole - 1).astype(np.int64)
    numbers, first = np.unique(number, return_index=True)
    windows = (stream.part(a, b) for a, b in pairwise([*first.tolist(), len(stream)]))
    still = [len(window) < 3 or settings.still(window) for window in windows]
    return RestWindows(t_0, settings.align, numbers, np.array(still, dtype=np.bool_))


@dataclass(frozen=True)
class Pieces:
    """The usable samples of a recording, cut at gaps and at rows that are not usable."""

    rows: Index  # (S, 2) first row and end of each piece, of one row too
    missing: Index  # (S - 1,) samples lost behind each piece but the last; NEVER: rows that are not usable lie between
    parts: Index  # (P, 2) first piece of each span whose gaps can be bridged, and the piece after its last
    places: Index  # (P,) samples that each span would have without a gap
    dt: float  # mean step of the spans, s

    @property
    def samples(self) -> int:
        """Number of rows of all spans."""
        total = np.concatenate([[0], np.cumsum(np.diff(self.rows, axis=1)[:, 0])])
        return int(np.sum(total[self.parts[:, 1]] - total[self.parts[:, 0]]))

    @property
    def enough(self) -> bool:
        """True if there are samples enough for an Allan deviation."""
        return self.samples >= MIN_SAMPLES and bool(np.max(self.places, initial=0) >= MIN_STRETCH)

    @property
    def spans(self) -> Index:
        """First row and end (P, 2) of each span."""
        return np.stack([self.rows[self.parts[:, 0], 0], self.rows[self.parts[:, 1] - 1, 1]], axis=1)


def pieces(t: Array, usable: Flags | None = None) -> Pieces:
    """Cut samples at times t (N,) at steps longer than GAP times the median; leave out spans too short for any average.

    The samples lost in a gap are counted from its own length, so a clock that drifts moves none. A gap's ends are those
    of a line through NEAR samples: one sample that is late makes a long step and a short one, and none is lost.
    """
    rows = _runs(t, usable)
    lengths, first, last = np.diff(rows, axis=1)[:, 0], rows[:, 0], rows[:, 1] - 1
    missing = np.full(max(0, len(rows) - 1), NEVER)
    if np.any(lengths > 1):
        dt = float(np.sum(t[last] - t[first]) / np.sum(lengths - 1))
        near = np.minimum(lengths, NEAR)
        total = np.concatenate([[0.0], np.cumsum(t - t[0])])
        begin = (total[first + near] - total[first]) / near - (near - 1) * dt / 2
        end = (total[last + 1] - total[last + 1 - near]) / near + (near - 1) * dt / 2
        lost = np.clip(np.rint((begin[1:] - end[:-1]) / dt) - 1, 0, NEVER).astype(np.int64)
        missing = np.where(first[1:] > rows[:-1, 1], NEVER, lost)
    parts, whole = bridgeable(lengths, missing) if len(rows) else (np.empty((0, 2), dtype=np.int64), lengths)
    cut = Pieces(rows, missing, parts, whole, 0.0)
    lasted = float(np.sum(t[cut.spans[:, 1] - 1] - t[cut.spans[:, 0]]))
    return replace(cut, dt=lasted / max(1, int(np.sum(cut.places - 1))))


def _runs(t: Array, usable: Flags | None) -> Index:
    if len(t) < 2:
        return np.empty((0, 2), dtype=np.int64)
    step = np.diff(t)
    cut = step > GAP * np.median(step)
    if usable is not None:
        cut |= usable[1:] != usable[:-1]
    edges = np.concatenate([[0], np.flatnonzero(cut) + 1, [len(t)]])
    stretches = np.stack([edges[:-1], edges[1:]], axis=1)
    return stretches if usable is None else stretches[usable[stretches[:, 0]]]


def limits(t: Array, stretches: Index) -> tuple[float, float]:
    """Return the shortest and the longest step within stretches (S, 2), s."""
    step = np.diff(t)
    stretches = stretches[np.diff(stretches, axis=1)[:, 0] > 1]
    inside: Index = np.ravel(stretches - [0, 1]).astype(np.int64)  # steps from the first row to the last one
    inside = inside[:-1] if inside[-1] == len(step) else inside
    low, high = (f.reduceat(step, inside.tolist())[::2] for f in (np.minimum, np.maximum))
    return float(low.min()), float(high.max())
