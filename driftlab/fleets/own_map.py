"""The own map of a unit: what `fit-map` finds on its soaks, held in memory by the config that the filter runs."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from driftlab.config import Config
from driftlab.jobs.fit_map import USUAL
from driftlab.loop.declared import host_of, with_tracked
from driftlab.maps.fit import Gathered, axes_of, fit_gathered, gather, map_settings
from driftlab.maps.verdict import Verdict, judge
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.faults import Faults
from fusion_core.units import bias_unit

IN_MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # a map waits for no disk to be read back


@dataclass(frozen=True, eq=False)
class Own:
    """The own map of a unit.

    Attributes
    ----------
    config : Config
        With the map in memory, where its filter can use it.
    settings : ThermalMap
        It was fitted with.
    found : Gathered
        The samples.
    verdict : Verdict
    """

    config: Config
    settings: ThermalMap
    found: Gathered
    verdict: Verdict

    @property
    def fitted(self) -> FittedMap:
        """The map itself."""
        return self.verdict.map

    @property
    def channel(self) -> str:
        """Whose bias it is."""
        return self.fitted.record.channel

    @property
    def axes(self) -> tuple[str, ...]:
        """What its axes are called."""
        return axes_of(self.fitted)

    @property
    def unit(self) -> BiasUnit:
        """In which its bias is shown."""
        return tracked_unit(self.config.filter)

    @property
    def file(self) -> str:
        """What its file is called in the folder of the unit."""
        return f"map{self.settings.suffix}"

    @property
    def lenient(self) -> Config:
        """The config for a recording that the map was not fitted on: what leaves the domain is predicted all the same.

        Its thermometer's noise alone takes a recording of the same chamber a few millikelvin beyond it.
        """
        if self.settings.outside != "refuse":
            return self.config
        return _holding(self.config, self.settings.model_copy(update={"outside": "clamp"}), self.fitted)

    def content(self) -> bytes:
        """Return its file."""
        with tempfile.TemporaryDirectory(prefix="driftlab-", dir=IN_MEMORY) as folder:
            path = Path(folder) / self.file
            self.fitted.save(path)
            return path.read_bytes()


def own_map(config: Config, soaks: Sequence[str], faults: Faults) -> Own:
    """Fit the map that a config names, or the usual one, on soaks; raises as `fit-map`."""
    named = bool(config.tracked_maps())
    if not named:
        faults.note(f"kind of map: {USUAL}, since the config names none; --compare tells which kind predicts best")
    settings = map_settings(config, None if named else USUAL)
    found = gather(config, soaks, faults, keep=True)
    fitted = fit_gathered(config, settings, found)
    verdict = judge(fitted, settings, found.brief(), axes_of(fitted), found.placements, found.used)
    return Own(_holding(config, settings, verdict.map), settings, found, verdict)


def _holding(config: Config, settings: ThermalMap, fitted: FittedMap) -> Config:
    """Return the config with the map in the place of the one that it names, or else in its bias model.

    Raises ConfigError where it names none and its bias model follows none.
    """
    if config.filter is None:
        return config
    held, tracked = settings.holding(fitted), config.filter.tracked
    if tracked.calibration is not None:
        return with_tracked(config, calibration=held)
    with bias_unit(tracked.unit):
        return with_tracked(config, bias=host_of(tracked.bias).model_copy(update={"map": held}))
