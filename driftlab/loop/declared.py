"""The declared model: its map, its effects, and variants of its config."""

from __future__ import annotations

from typing import Any

from driftlab.config import Config
from fusion_core.contracts import Effect, ThermalMap
from fusion_core.errors import ConfigError


def the_map(config: Config) -> ThermalMap | None:
    """Return the one thermal map of the config; None where temperature is a channel like any other.

    Raises
    ------
    ConfigError
        If the bias model cannot hold effects.
    """
    assert config.filter is not None
    maps, bias = config.maps(), config.filter.tracked.bias
    if not hasattr(bias, "effects") and bias.kind != "random_walk":
        raise ConfigError(
            f"explain: bias model {bias.kind} takes no effects; declare thermal_derivative or random_walk"
        )
    return maps[0] if maps else None


def with_map(config: Config, **update: Any) -> Config:
    """Return the config with some settings of its map replaced."""
    assert config.filter is not None
    tracked = config.filter.tracked
    if tracked.calibration is not None:
        return with_tracked(config, calibration=tracked.calibration.model_copy(update=update))
    declared = getattr(tracked.bias, "map")  # noqa: B009
    return with_tracked(config, bias=tracked.bias.model_copy(update={"map": declared.model_copy(update=update)}))


def calibrated(config: Config) -> Config:
    """Return the config with its effects at the coefficients that it gives, none of them estimated."""
    assert config.filter is not None
    effects = declared_effects(config)
    if not effects:
        return config
    fixed = tuple(effect.model_copy(update={"estimate": False}) for effect in effects)
    return with_tracked(config, bias=config.filter.tracked.bias.model_copy(update={"effects": fixed}))


def declared_effects(config: Config) -> tuple[Effect, ...]:
    """Return the effects that the config has already, to be fitted anew together with the others."""
    assert config.filter is not None
    return tuple(getattr(config.filter.tracked.bias, "effects", ()))


def with_tracked(config: Config, **fields: Any) -> Config:
    """Return the config with other settings of its tracked sensor."""
    assert config.filter is not None
    return config.model_copy(update={"filter": config.filter.with_tracked(**fields)})


def clamped(config: Config) -> Config:
    """Return the config with maps that hold their value beyond their domain."""
    assert config.filter is not None
    return with_map(config, outside="clamp") if config.maps() else config
