"""What a config is understood to say, and whether its maps and its recording fit it: `driftlab check`."""

from __future__ import annotations

from dataclasses import dataclass

from driftlab.config import Config, maps_of
from driftlab.filtering.setup import check_channels, loaded_map, prior
from driftlab.maps.fit import map_lines
from driftlab.recordings.screening import head
from fusion_core.host.config import quantities
from fusion_core.units import Quantity


@dataclass(frozen=True)
class CheckResult:
    """A config that can be used: every quantity with its place, and what is to be known, a sentence each."""

    config: Config
    quantities: dict[str, Quantity]
    remarks: tuple[str, ...]


def check(config: Config) -> CheckResult:
    """Check a config, its maps and the head of its recording.

    Raises
    ------
    DataError, ConfigError
        If they cannot be used, or not together.
    """
    if config.filter is not None:
        prior(config.filter)  # says what is wrong with deviations
    first = head(config)
    if first is not None and config.filter is not None:
        check_channels(config.filter, first.chunk)
    remarks = [*_of_maps(config), *(() if first is None else first.lines)]
    return CheckResult(config, dict(quantities(config)), tuple(remarks))


def _of_maps(config: Config) -> list[str]:
    remarks = []
    for sensor in () if config.filter is None else reversed(config.filter.sensors):
        for settings in maps_of(sensor):
            if settings.path is None:
                remarks.append(f"map {settings.kind}: has no path; `run` needs one, `fit-map` and `explain` do not")
            elif not settings.path.exists():
                remarks.append(f"map {settings.path}: is not there yet; fit it with `driftlab fit-map`")
            else:
                remarks += map_lines(loaded_map(settings, sensor), sensor)
    return remarks
