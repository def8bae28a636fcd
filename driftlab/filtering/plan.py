"""What a run does, the same from its first epoch to its last."""

from __future__ import annotations

from dataclasses import dataclass

from fusion_core.contracts import FittedMap, MeasurementModel, Site


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
    followed : FittedMap or None
        The map that the bias model of the tracked sensor follows.
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
    followed: FittedMap | None
    gate: float
    initial_error: float
    keep_model: bool

    @property
    def fitted(self) -> FittedMap | None:
        """The map of the tracked sensor, whichever way it is used."""
        return self.calibrations.get(self.model.tracked.channel) or self.followed
