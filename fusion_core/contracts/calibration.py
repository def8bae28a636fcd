"""The calibration of one unit, which exporters are given: maps, effects and noise of its sensors.

With it go the factors on the noise of a sensor that the innovations of a run ask for.

d axes, K lags.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.effect import Effect
from fusion_core.errors import ConfigError
from fusion_core.thermal.fitted_map import FittedMap
from fusion_core.thermal.triad_matrix import TriadMatrix
from fusion_core.units import convert

TEMPERATURES = 2001  # over a domain, at which a map is looked at


@dataclass(frozen=True)
class Calibrated:
    """The calibration of one sensor of d axes.

    Attributes
    ----------
    channel : str
        Of recordings.
    unit, shown : str
        SI unit of the bias, and the unit in which people read it.
    axes : tuple of str
        Names of the d axes.
    map : FittedMap or None
        Its bias over temperature.
    effects : tuple of Effect
        What the bias follows besides, with coefficients.
    noise, walk : (d,) array or None
        White-noise density, unit/sqrt(Hz), and density of the random walk, unit/sqrt(s); None: not known.
    compensated, raw : Inflation or None
        What a run says that noise and walk must be multiplied with: of readings less what map and effects say, and
        of readings as they are; None: not measured.
    """

    channel: str
    unit: str
    shown: str
    axes: tuple[str, ...]
    map: FittedMap | None = None
    effects: tuple[Effect, ...] = ()
    noise: Array | None = None
    walk: Array | None = None
    compensated: Inflation | None = None
    raw: Inflation | None = None

    @cached_property
    def factor(self) -> float:
        """Factor from `unit` to the unit in which people read a bias."""
        return 1.0 / float(convert(1.0, self.shown, self.unit))

    @property
    def fitted(self) -> FittedMap:
        """The map; raises ConfigError where there is none."""
        if self.map is None:
            raise ConfigError(
                f"{self.channel}: has no thermal map; name one with its path in the config, or give a map's file"
            )
        return self.map

    @property
    def matrix(self) -> TriadMatrix | None:
        """Scale factor and misalignment over temperature; None where the map has none."""
        return None if self.map is None else self.map.record.matrix

    def without(self, *effects: Effect) -> Calibrated:
        """Return the same without some of its effects."""
        return replace(self, effects=tuple(effect for effect in self.effects if effect not in effects))

    def text(self, values: Array) -> str:
        """Return values (d,) in `unit` as a reader gets them, in `shown`, which the text does not name."""
        return "/".join(_said(float(value) * self.factor) for value in values)

    def bias(self, chunk: Chunk) -> Array:
        """Return the bias (N, d) that map and effects give over a whole recording, memories begun in equilibrium.

        Raises
        ------
        MissingChannel
            If the recording lacks what an effect reads.
        """
        at_map = chunk
        for effect in self.effects:
            if effect.acts_on_input:
                at_map = at_map.having(temperature=effect.input(at_map, None)[0])
        total = np.zeros((len(chunk), len(self.axes)))
        if self.map is not None:
            total = total + self.map.bias(at_map["temperature"], chunk.t)
        for effect in self.effects:
            if effect.coefficients is not None:
                signature, _ = effect.held(chunk, None)
                total = total + signature @ np.asarray(effect.coefficients)
        return total


@dataclass(frozen=True)
class Export:
    """The sensors of one unit, as far as they are known.

    Attributes
    ----------
    sensors : tuple of Calibrated
    rate : float or None
        Of the samples, Hz.
    serial : str
        Serial number of the unit; empty where it is not known.
    """

    sensors: tuple[Calibrated, ...]
    rate: float | None = None
    serial: str = ""

    def sensor(self, channel: str) -> Calibrated | None:
        """Return the calibration of the sensor of a channel, None where there is none."""
        return next((sensor for sensor in self.sensors if sensor.channel == channel), None)

    @property
    def mapped(self) -> tuple[Calibrated, ...]:
        """The sensors that have a map; raises ConfigError where none has, or one gives no number in its domain."""
        sensors = tuple(sensor for sensor in self.sensors if sensor.map is not None)
        if not sensors:
            have = " and ".join(sorted(sensor.channel for sensor in self.sensors))
            raise ConfigError(
                f"{have}: without a thermal map; name one with its path in the config, or give a map's file"
            )
        for sensor in sensors:
            T = np.linspace(*sensor.fitted.domain, TEMPERATURES)
            known = np.all(np.isfinite(sensor.fitted.bias(T)), axis=1)
            if not np.all(known):
                raise ConfigError(
                    f"{sensor.fitted.record.kind}: the map of the {sensor.channel} gives no number at "
                    f"{T[np.argmin(known)]:.6g} °C, and no target could hold it; refit it"
                )
        return sensors


def _said(value: float) -> str:
    """Return a number with three digits, or with one where it is too small to matter: 1010, 22.6, 3e-05."""
    if value and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.1g}" if abs(value) < 1 else f"{value:.3g}"
    return np.format_float_positional(value, precision=3, unique=False, fractional=False, trim="-")


@dataclass(frozen=True)
class Factor:
    """A factor on a deviation and its 95 % interval, each (d,)."""

    value: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Lag:
    """The differences of a bias between adjacent means over a time.

    Attributes
    ----------
    seconds : float
        The lag.
    ratio : (d,) array
        Rms of the differences over what noise and walk with their factors say.
    high : (d,) array
        What a right model exceeds with a probability of 0.1 %.
    walk : (d,) array
        Factor on the walk that would make the ratio one; 0 where white noise alone is more.
    count : int
        Differences.
    """

    seconds: float
    ratio: Array
    high: Array
    walk: Array
    count: int


@dataclass(frozen=True)
class Inflation:
    """Factors on white noise and walk with which innovations are as large as they are said to be.

    Attributes
    ----------
    noise, walk : (d,) arrays
        Densities that the factors are on, unit/sqrt(Hz) and unit/sqrt(s).
    of_noise, of_walk : Factor
        Those that make the innovations most likely.
    lags : tuple of Lag
        What they are worth over longer times than from one update to the next, as far as the run lasts.
    """

    noise: Array
    walk: Array
    of_noise: Factor
    of_walk: Factor
    lags: tuple[Lag, ...] = ()

    def of_walk_up_to(self, horizon: float) -> Array:
        """Return the factor (d,) on the walk with which no lag up to `horizon`, s, is more than it may be."""
        factor = self.of_walk.value
        for lag in self.lags:
            if lag.seconds <= horizon:
                factor = np.where(lag.ratio > lag.high, np.maximum(factor, lag.walk), factor)
        return np.asarray(factor)
