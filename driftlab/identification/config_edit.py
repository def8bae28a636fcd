"""The declared model: its map, its effects, and variants of its config."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from driftlab.config import Config, maps_of
from driftlab.units import BiasUnit
from fusion_core.contracts import BiasModel, Effect, ThermalBias, ThermalMap
from fusion_core.contracts.plugin import built_in
from fusion_core.errors import ConfigError
from fusion_core.host.registry import registry
from fusion_core.units import bias_unit


def the_map(config: Config) -> ThermalMap | None:
    """Return the one thermal map of the config; None where temperature is a channel like any other.

    Raises ConfigError if the bias model cannot hold effects.
    """
    host_of(_bias(config))
    maps = config.tracked_maps()
    return maps[0] if maps else None


def host_of(declared: BiasModel) -> ThermalBias:
    """Return the bias model that follows map and effects in place of the declared one: itself, where it does.

    Else the first that is installed, those that come with driftlab before others. Raises ConfigError if the declared
    model is neither such a one nor a random walk.
    """
    if isinstance(declared, ThermalBias):
        return declared
    hosts = [cls for cls in registry().classes(BiasModel).values() if issubclass(cls, ThermalBias)]
    hosts.sort(key=lambda cls: not built_in(cls))
    if declared.as_random_walk() is None or not hosts:
        known = ", ".join(kind for kind, cls in registry().classes(BiasModel).items() if cls in hosts)
        raise ConfigError(
            f"explain: bias model {declared.kind} takes no effects; declare {known or 'one that does'} or random_walk"
        )
    return hosts[0].from_random_walk(declared)


def with_map(config: Config, **update: Any) -> Config:
    """Return the config with some settings of its map replaced."""
    assert config.filter is not None
    tracked = config.filter.tracked
    if tracked.calibration is not None:
        return with_tracked(config, calibration=tracked.calibration.model_copy(update=update))
    bias = tracked.bias
    assert isinstance(bias, ThermalBias), "a config without a map"
    assert bias.map is not None, "a config without a map"
    return with_tracked(config, bias=bias.having(map=bias.map.model_copy(update=update)))


def calibrated(config: Config) -> Config:
    """Return the config with its effects at the coefficients that it gives, none of them estimated."""
    bias = _bias(config)
    if not isinstance(bias, ThermalBias) or not bias.effects:
        return config
    fixed = tuple(effect.model_copy(update={"estimate": False}) for effect in bias.effects)
    return with_tracked(config, bias=bias.having(effects=fixed))


def declared_effects(config: Config) -> tuple[Effect, ...]:
    """Return the effects that the config has already, to be fitted anew together with the others."""
    bias = _bias(config)
    effects = bias.effects if isinstance(bias, ThermalBias) else ()
    unknown = {"domain": None, "regressors": None}  # what is fitted anew has others
    return tuple(effect.model_copy(update=unknown) for effect in effects)


def with_host(config: Config, unit: BiasUnit, map_path: Path | None, **fields: Any) -> Config:
    """Return the config with its map in the bias model, from another file, and other `fields` of that model.

    Quantities among the fields are written in a unit of the bias.
    """
    declared = the_map(config)
    if declared is not None:
        fields["map"] = declared.model_copy(update={"path": map_path})
    with bias_unit(unit.si):
        return with_tracked(config, calibration=None, bias=host_of(_bias(config)).having(**fields))


def with_tracked(config: Config, **fields: Any) -> Config:
    """Return the config with other settings of its tracked sensor."""
    assert config.filter is not None
    return config.model_copy(update={"filter": config.filter.with_tracked(**fields)})


def clamped(config: Config) -> Config:
    """Return the config with maps that hold their value beyond their domain, those of all sensors."""
    model = config.filter
    if model is None:
        return config
    for sensor in model.sensors:
        if maps_of(sensor):
            with suppress(ConfigError):  # a model that cannot track it does not let its map be changed
                config = with_map(_tracking(config, sensor.channel), outside="clamp")
    return _tracking(config, model.tracked.channel)


def _tracking(config: Config, channel: str) -> Config:
    assert config.filter is not None
    return config.model_copy(update={"filter": config.filter.tracking(channel)})


def _bias(config: Config) -> BiasModel:
    assert config.filter is not None
    return config.filter.tracked.bias
