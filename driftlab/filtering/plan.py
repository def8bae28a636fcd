"""What a run does, the same from its first epoch to its last."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from driftlab.filtering.needs import corrected
from fusion_core.chunk import Chunk
from fusion_core.contracts import Alignment, FittedMap, MeasurementModel, Site

TURNED = 0.02  # rad, between two inputs: more is no bias


def turned(one: Alignment, other: Alignment, channel: str) -> bool:
    """Whether a unit lies in another way, by the input of a sensor."""
    a, b = one.inputs[channel], other.inputs[channel]
    return float(np.linalg.norm(a - b)) > TURNED * float(np.linalg.norm(a))


@dataclass(frozen=True)
class Plan:
    """What a run does.

    Attributes
    ----------
    model : MeasurementModel
        The filter section of the config.
    site : Site
        Where the sensors are.
    calibrations : dict of str to FittedMap
        The maps that are subtracted first, by channel.
    followed : dict of str to FittedMap
        The maps that bias models follow, by channel.
    gate : float
        The nis beyond which an epoch is not used.
    initial_error : float
        Added to every axis of the tracked bias at the end of the alignment, in SI; the filter is not told.
    keep_model : bool
        Whether the stretches keep the arrays that the filter was run on.
    """

    model: MeasurementModel
    site: Site
    calibrations: dict[str, FittedMap]
    followed: dict[str, FittedMap]
    gate: float
    initial_error: float
    keep_model: bool

    @property
    def fitted(self) -> FittedMap | None:
        """The map of the tracked sensor, whichever way it is used."""
        channel = self.model.tracked.channel
        return self.calibrations.get(channel) or self.followed.get(channel)

    def aligned_again(self, window: Chunk, before: Alignment) -> Alignment:
        """Return another alignment; a unit that lies as it did keeps an input of which only the length is known.

        What such a sensor shows there is its bias that has moved, and no tilt.
        """
        found, channel = self.aligned(window), self.model.tracked.channel
        if self.model.length_of_input(self.site) is None or turned(before, found, channel):
            return found
        return replace(found, inputs={**found.inputs, channel: before.inputs[channel]})

    def aligned(self, window: Chunk) -> Alignment:
        """Freeze the reference from a stretch at rest, as the filter sees it: calibrations subtracted."""
        return self.model.aligned(corrected(window, self.calibrations), self.site)
