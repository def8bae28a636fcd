"""The first rest of a recording: epochs are collected until enough of them in a row stand still."""

from __future__ import annotations

import numpy as np

from driftlab.filtering.plan import Plan
from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import Alignment


class FirstRest:
    """What came so far, and the alignment once there is one."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.alignment: Alignment | None = None
        self._parts: list[Chunk] = []

    @property
    def chunk(self) -> Chunk | None:
        """The epochs that are still being looked at."""
        return concatenate(self._parts) if self._parts else None

    def take(self, chunk: Chunk) -> Chunk:
        """Look at more epochs; return those from the first rest on, if there is one, else all that may belong to it."""
        self._parts.append(chunk)
        length = self.plan.model.align * (1 - 1e-9)
        if chunk.t[-1] - self._parts[0].t[0] < length:
            return chunk  # joining them once, and not at every epoch of a live source
        waiting = concatenate(self._parts)
        t, start = waiting.t, 0
        while (stop := int(np.searchsorted(t, t[start] + length)) + 1) <= len(t):
            if self._is_rest(waiting.part(start, stop)):
                break
            start += max(1, (stop - start) // 4)
            if start >= len(t):
                break
        self._parts = [waiting.part(min(start, len(t) - 1), len(t))]
        return self._parts[0]

    def _is_rest(self, window: Chunk) -> bool:
        """Return whether the unit was at rest; then it is aligned."""
        model = self.plan.model
        measured = np.sum(window["tau"]) >= model.align / 2  # a gap is no rest
        if not (measured and len(window) > 2 and model.still(window)):
            return False
        model.check(window, self.plan.site)
        self.alignment = self.plan.aligned(window)
        return True
