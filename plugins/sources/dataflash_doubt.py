"""Records that nothing known follows: whole ones before a gap, or ones whose tail was overwritten.

::

    kept where every number lies between the least and the largest of the whole records, or `ROOM` of their span beyond

A tail of garbage or of zeros hardly ever passes: many fields (counts of errors, states of health, rates) do not change
over a log, and random bytes as a float are seldom of its size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_plugins.sources.dataflash_messages import Message
from fusion_plugins.sources.dataflash_scan import Bytes, Places

ROOM = 0.25  # of the span of a field
LEAST = 3  # whole records that say what a field can be


def credible(message: Message, data: Bytes, whole: Places, doubtful: Places) -> NDArray[np.bool_]:
    """Return which records in doubt (D,) show nothing that whole ones at `whole` (N,) do not."""
    good = np.full(len(doubtful), len(whole) >= LEAST)
    for label in message.numbers if np.any(good) else ():
        known, shown = (message.values(data, at, label) for at in (whole, doubtful))
        known = known[np.isfinite(known)]
        if len(known):
            low, high = float(np.min(known)), float(np.max(known))
            room = ROOM * (high - low)
            inside = (shown >= low - room) & (shown <= high + room)
            good &= inside if inside.ndim == 1 else np.all(inside, axis=1)
    return good
