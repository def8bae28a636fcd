"""Model of a unit before its soak: noise, walk, the kind of its map, perhaps the shape of its curve.

A simulated source has a unit that is known. Else noise and walk are the filter's, which may be tuned wider than the
unit's: a plan names the source of each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from driftlab.config import Config
from driftlab.filtering.setup import loaded_map
from driftlab.maps.fit import map_settings
from driftlab.noise.local_level import walk_of
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, Sensor, SimulatedSource, ThermalMap, Twin
from fusion_core.errors import ConfigError

Curve = Callable[[Array], Array]

BENDS = 4.0  # K, of a curve whose shape nobody knows: so close that a map is not smoothed for it
FILTERS = "the filter's"  # whose noise it is
LOUD = 300.0  # times the noise of a minute, so that it counts
SWING = 100.0  # times the noise of a minute: that of a curve that nobody knows


@dataclass(frozen=True)
class UnitModel:
    """A unit whose map is planned, of d axes."""

    channel: str  # whose bias it is
    axes: tuple[str, ...]  # names
    unit: BiasUnit  # of the bias
    map: ThermalMap  # the settings of the kind that will be fitted
    noise: Array  # (d,): density of the bias's white noise, SI
    walk: Array  # (d,): density of its random walk, SI
    noise_of: str  # where they are from
    shape: Curve | None  # the curve that is to be found, as far as it is known
    shape_of: str  # where it is from
    interval: float = 1.0  # duration of an epoch, s
    align: float = 60.0  # how long a unit is aligned, s
    curve_known: bool = True  # whether the shape is the unit's own, or one that is taken for want of it

    @property
    def d(self) -> int:
        """Number of axes."""
        return len(self.axes)

    @property
    def floor(self) -> Array:
        """Floor (d,) of the Allan deviation that noise and walk make, SI."""
        return np.asarray(np.sqrt(2 * self.noise * self.walk / np.sqrt(3)))

    def curve(self, T: Array) -> Array:
        """Return the bias (N, d) of the shape at T (N,)."""
        assert self.shape is not None, "a unit with a curve, as `with_curve` has it"
        return self.shape(T)

    def with_curve(self, low: float, high: float) -> UnitModel:
        """Return the unit with a curve: where the shape is not known, one that bends from `low` to `high` degC.

        It swings by SWING times the noise of a minute, with a slope that grows to three times what it was.
        """

        def bent(T: Array) -> Array:
            x = (T - (low + high) / 2) / ((high - low) / 2)
            return np.outer(x + x**2 / 4, SWING / 2 * self.noise / np.sqrt(60.0))

        return self if self.shape is not None else replace(self, shape=bent, curve_known=False)

    def drawn(self, T: Array, dt: float, seed: int) -> Array:
        """Return bias (N, d) as it may be measured at T (N,), a sample each dt in s: curve, walk and white noise.

        Where the curve is not known it bends up and down, so that no kind of map finds it smoother than it can be.
        """
        rng = np.random.default_rng(seed)
        white, steps = rng.normal(size=(2, len(T), self.d))
        walk = np.cumsum(steps * self.walk * np.sqrt(dt), axis=0)
        if self.shape is not None:
            curve = self.shape(T)
        else:
            size = LOUD * self.noise / np.sqrt(60) + LOUD * self.walk * np.sqrt(60)
            curve = np.outer(np.sin(2 * np.pi * T / BENDS), np.maximum(size, np.finfo(float).tiny))
        return np.asarray(curve + walk + white * self.noise / np.sqrt(dt))

    @classmethod
    def of(cls, config: Config, kind: str | None, walk: Array | None) -> UnitModel:
        """Return the unit of a config; `walk` (d,) or (1,), where given, is in place of its own.

        Raises
        ------
        ConfigError
            If the config names no map, or has nothing to tell the noise from.
        """
        sensor, twin = config.filter.tracked if config.filter else None, twin_of(config)
        if sensor is None and twin is None:
            raise ConfigError("filter: is missing, and no simulated unit says what its noise is; write noise and bias")
        axes = sensor.axes if sensor else ("x", "y", "z")
        if twin is not None and sensor is not None and (twin.channel, len(twin.noise)) != (sensor.channel, len(axes)):
            twin = None  # that of another sensor
        settings, unit = map_settings(config, kind), tracked_unit(config.filter)
        if twin is not None:
            channel, noise, own, whose = twin.channel, twin.noise, twin.walk, "the simulated unit's own"
        else:
            assert sensor is not None, "there is a filter or a twin"
            channel, noise, whose = sensor.channel, sensor.noise, FILTERS
            own = _walk_of(sensor) if walk is None else walk
        if walk is not None:
            if len(walk) not in (1, len(axes)):
                raise ConfigError(f"--walk: has {len(walk)} values for {len(axes)} axes; write one, or one an axis")
            own, whose = np.broadcast_to(walk, len(axes)), "the walk as --walk says"
        shape, shape_of = _shape(config, twin)
        interval, align = (config.filter.update_interval, config.filter.align) if config.filter else (1.0, 60.0)
        return cls(
            channel, tuple(axes), unit, settings, noise, own, whose, shape, shape_of, float(interval), float(align)
        )


def twin_of(config: Config) -> Twin | None:
    """Return the unit that the config's source simulates, if it does and knows it."""
    return config.source.twin if isinstance(config.source, SimulatedSource) else None


def _walk_of(sensor: Sensor) -> Array:
    """Return the density (d,) of the declared walk; raises ConfigError where there is none."""
    if (walk := walk_of(sensor)) is None:
        raise ConfigError(
            f"bias model {sensor.bias.kind} has no random walk to plan with; give --walk, as `driftlab allan` "
            "measures it"
        )
    return walk


def fitted_map(config: Config) -> FittedMap | None:
    """Return the first map of the tracked sensor whose file is there; raises MapError where it is of another one."""
    for settings in config.tracked_maps():
        if config.filter is not None and settings.path is not None and settings.path.is_file():
            return loaded_map(settings, config.filter.tracked)
    return None


def _shape(config: Config, twin: Twin | None) -> tuple[Curve | None, str]:
    """Return the curve to be fitted and where it is from; None where it is not known."""
    if twin is not None:
        return twin.curve, "the simulated unit's"
    fitted = fitted_map(config)
    if fitted is None:
        return None, "not known"
    straight = replace(fitted, outside="tangent")
    name = next((item.path.name for item in config.tracked_maps() if item.path is not None and item.path.is_file()), "")
    return straight.bias, f"that of {name}"
