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
    maps, bias = config.maps(), config.filter.gyro.bias
    if not hasattr(bias, "effects") and bias.kind != "random_walk":
        raise ConfigError(
            f"explain: bias model {bias.kind} takes no effects; declare thermal_derivative or random_walk"
        )
    return maps[0] if maps else None


def with_map(config: Config, **update: Any) -> Config:
    """Return the config with some settings of its map replaced."""
    assert config.filter is not None
    gyro = config.filter.gyro
    if gyro.calibration is not None:
        gyro = gyro.model_copy(update={"calibration": gyro.calibration.model_copy(update=update)})
    else:
        declared = getattr(gyro.bias, "map")  # noqa: B009
        gyro = gyro.model_copy(
            update={"bias": gyro.bias.model_copy(update={"map": declared.model_copy(update=update)})}
        )
    return with_gyro(config, gyro)


def calibrated(config: Config) -> Config:
    """Return the config with its effects at the coefficients that it gives, none of them estimated."""
    assert config.filter is not None
    gyro = config.filter.gyro
    effects = declared_effects(config)
    if not effects:
        return config
    fixed = tuple(effect.model_copy(update={"estimate": False}) for effect in effects)
    return with_gyro(config, gyro.model_copy(update={"bias": gyro.bias.model_copy(update={"effects": fixed})}))


def declared_effects(config: Config) -> tuple[Effect, ...]:
    """Return the effects that the config has already, to be fitted anew together with the others."""
    assert config.filter is not None
    return tuple(getattr(config.filter.gyro.bias, "effects", ()))


def with_gyro(config: Config, gyro: Any) -> Config:
    """Return the config with another gyro section."""
    assert config.filter is not None
    return config.model_copy(update={"filter": config.filter.model_copy(update={"gyro": gyro})})


def clamped(config: Config) -> Config:
    """Return the config with maps that hold their value beyond their domain."""
    assert config.filter is not None
    return with_map(config, outside="clamp") if config.maps() else config
