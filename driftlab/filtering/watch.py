"""The look-out for motion, and for a rest at another place, where the filter begins anew."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftlab.filtering.plan import Plan
from driftlab.filtering.stretch import Journal, runs
from driftlab.units import axis_name
from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import Alignment
from fusion_core.model import Estimates, Flags


class Watch:
    """Notes where the unit moved, and where the filter refused it while it stood still."""

    def __init__(self, plan: Plan, journal: Journal) -> None:
        self.journal = journal
        self.detector = plan.model.detector(journal.alignments[0])
        self.memory: Any = self.detector.start()
        self.components = [axis_name(channel, axis) for channel, axis, _ in plan.model.components]

    def look(self, done: Chunk, found: Estimates) -> Flags:
        """Return where the unit stood still (N,)."""
        still, out, self.memory = self.detector.look(done, self.memory)
        self.journal.moving.note(done.t, ~still, out, [" ".join(axis) for axis in self.detector.axes])
        refused = still & ~found.used
        causes = np.zeros(found.white.shape, dtype=np.bool_)
        size = found.white[refused] ** 2
        causes[refused] = size >= np.max(size, axis=1, keepdims=True, initial=0.0) / 2
        self.journal.refused.note(done.t, refused, causes, self.components)
        return still


class Realigning:
    """Finds the rest, at another bias or attitude, in what is refused for long enough."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.patience = plan, plan.model.patience.realign_after
        self.refused: Chunk | None = None  # the epochs refused in a row, up to now

    def due(self, part: Chunk, used: Flags) -> int:
        """Return up to which epoch to go: the first by which enough are refused in a row, or all."""
        for start, stop in runs(~used):
            since = self.refused.t[0] if start == 0 and self.refused is not None else part.t[start]
            long_enough = part.t[start:stop] - since >= self.patience
            if np.any(long_enough):
                return start + int(np.argmax(long_enough)) + 1
        return len(part)

    def look(self, done: Chunk, used: Flags, before: Alignment) -> Alignment | None:
        """Return the new alignment where the unit has been still, at another bias or attitude, for long enough."""
        refused = runs(~used)
        if not refused or refused[-1][1] < len(done):
            self.refused = None
            return None
        tail = done.part(refused[-1][0], len(done))
        self.refused = tail if self.refused is None or len(tail) < len(done) else concatenate([self.refused, tail])
        if self.refused.t[-1] - self.refused.t[0] < self.patience:
            return None
        # the onset is no part of the rest
        still = self.refused.part(len(self.refused) // 4, len(self.refused))
        if not self.plan.model.still(still):
            self.refused = self.refused.part(len(self.refused) // 2, len(self.refused))
            return None
        self.refused = None
        return self.plan.aligned_again(still, before)
