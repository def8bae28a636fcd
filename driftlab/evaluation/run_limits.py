"""The limits of a config, held against what a run has measured."""

from __future__ import annotations

from dataclasses import replace

from driftlab.config import Config
from driftlab.evaluation.limits import LimitResult, check_limits
from driftlab.evaluation.measurements import Averages, of_coast, of_map
from driftlab.evaluation.overview import Overview
from driftlab.units import tracked_unit
from fusion_core.contracts import Alignment, FittedMap, ThermalBias


def map_of(config: Config) -> FittedMap | None:
    """Return the map of the config's tracked sensor, from memory or its file; None where it has none."""
    settings = next((settings for settings in config.tracked_maps() if settings.has_map), None)
    return None if settings is None else settings.load()


def averages_of(config: Config, alignment: Alignment) -> Averages | None:
    """Return the averages that the limits of a config need of a run; None where none of them does.

    They are of the calibrated rate, or of the rate less the map's bias.
    """
    limits = config.limits
    if config.filter is None or limits is None or (limits.bias_instability is None and limits.noise is None):
        return None
    sensor = config.filter.tracked
    if sensor.calibration is not None:
        return Averages(alignment.dt, sensor.axes, lambda block: block["calibration"])
    fitted = map_of(config) if isinstance(sensor.bias, ThermalBias) else None
    if fitted is None:
        return Averages(alignment.dt, sensor.axes)
    clamped = replace(fitted, outside="clamp")  # the run has refused already what is to be refused
    return Averages(alignment.dt, sensor.axes, lambda block: clamped.bias(block["temperature"]))


def check_run_limits(
    config: Config, overview: Overview, alignment: Alignment, averages: Averages | None
) -> list[LimitResult]:
    """Judge a run by the limits of its config.

    The coast is that of the run; noise and bias instability are of `averages`, those of `averages_of`, which the
    survey has filled; residual, swing and hysteresis are of the map.
    """
    if config.limits is None or config.filter is None:
        return []
    align = config.filter.align
    fitted = map_of(config)
    measured = {"coast": of_coast(overview.yardsticks, overview.end - alignment.t, align)}
    if averages is not None and config.limits.noise is not None:
        measured["noise"] = averages.noise()
    if averages is not None and config.limits.bias_instability is not None:
        measured["bias_instability"] = averages.measured()
    if fitted is not None:
        measured |= of_map(fitted, tracked_unit(config.filter))
    return check_limits(config.limits, measured)
