"""What a measurement model knows of a sensor, and of the place that it is at."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from fusion_core.chunk import Array
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.plugin import broken
from fusion_core.contracts.thermal_map import ThermalMap
from fusion_core.statespace import Block
from fusion_core.units import convert


@dataclass(frozen=True)
class Sensor:
    """One sensor of d axes as a measurement model knows it.

    Attributes
    ----------
    channel : str
        Of the recording.
    section : str
        Where the config describes it, e.g. `filter.gyro`.
    unit, shown : str
        SI unit of the channel, and the unit of tables and figures.
    noise : (d,) array
        White-noise density, unit/sqrt(Hz).
    range : float or None
        Beyond which it is saturated, in `unit`.
    bias : BiasModel
        How its bias moves.
    calibration : ThermalMap or None
        Subtracted before the filter.
    integral : (str, str) or None
        What the error of its bias adds up to over time, and the unit in which that is shown: heading in deg.
    optional : bool
        Whether the config can leave it out with `CHANNEL: null`.
    """

    channel: str
    section: str
    unit: str
    shown: str
    noise: Array
    range: float | None
    bias: BiasModel
    calibration: ThermalMap | None = None
    integral: tuple[str, str] | None = None
    optional: bool = False

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the d axes."""
        return self.bias.axes

    @cached_property
    def block(self) -> Block:
        """The states of its bias; raises PluginError where the bias model's labels and units do not go together."""
        name, bias = f"{self.channel}_bias", self.bias
        try:
            return Block(name, tuple(f"{name}_{label}" for label in bias.labels), tuple(bias.units(self.unit)))
        except ValueError as error:
            raise broken(bias, str(error)) from None

    @cached_property
    def factor(self) -> float:
        """How many of the unit that is shown are one SI unit."""
        return 1.0 / float(convert(1.0, self.shown, self.unit))


def axis_of(channel: str) -> str:
    """Return what the one axis of a sensor is called that is no triad: as its channel, as far as an axis can be."""
    plain = re.sub(r"[^A-Za-z0-9]", "", channel)[:16]
    return plain if plain[:1].isalpha() else "value"


class Site(NamedTuple):
    """Where the sensors are: latitude and heading of the x axis (from north, clockwise), rad; None: not known."""

    latitude: float | None = None
    heading: float | None = None
