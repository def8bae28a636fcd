"""The sensors of a measurement model, their site, the alignment on a stretch at rest, and the detector of motion.

N epochs, d axes of a sensor, D of all.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.plugin import Memory, plugin_error
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
            raise plugin_error(bias, str(error)) from None

    @cached_property
    def factor(self) -> float:
        """Factor from the SI unit to the unit of tables and figures."""
        return 1.0 / float(convert(1.0, self.shown, self.unit))


def axis_of(channel: str) -> str:
    """Return the name of the one axis of a sensor that is no triad: its channel's, as far as possible."""
    plain = re.sub(r"[^A-Za-z0-9]", "", channel)[:16]
    return plain if plain[:1].isalpha() else "value"


class Site(NamedTuple):
    """Latitude of the sensors and heading of the x axis (from north, clockwise), rad; None: not known."""

    latitude: float | None = None
    heading: float | None = None


class Patience(NamedTuple):
    """False-alarm rate of the gate, and seconds of refusals at a new rest after which the filter begins anew."""

    false_alarm: float
    realign_after: float


@dataclass(frozen=True)
class Alignment:
    """The values that are frozen at the end of a stretch at rest.

    Attributes
    ----------
    t : float
        Time of the last epoch of the stretch, s.
    dt : float
        The usual duration of an epoch, s.
    inputs : dict of str to (d,) array
        What each ideal sensor shows at rest, in its unit.
    noise_ratio : dict of str to (d,) array
        Measured white noise over declared noise, for each sensor.
    unsure : (d,) array
        Deviation of the tracked sensor's input, in its unit: the Earth rate that a tilted vertical leaves.
    up : (3,) array or None
        Unit vector up in the axes of the unit, where that is known.
    levels : dict of str to (d,) array
        Mean reading less input over the stretch, a first look at the bias, where the model asks for it.
    notes : tuple of str
        What one should know of it, a sentence each.
    off : tuple of str
        What the readings show that the known inputs do not, a sentence each.
    """

    t: float
    dt: float
    inputs: dict[str, Array]
    noise_ratio: dict[str, Array]
    unsure: Array
    up: Array | None = None
    levels: dict[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    off: tuple[str, ...] = ()

    @cached_property
    def gate_scale(self) -> float:
        """Factor on the gate where the declared noise is too small."""
        worst = max((float(np.mean(ratio**2)) for ratio in self.noise_ratio.values()), default=1.0)
        return max(1.0, worst)


class Detector(ABC):
    """Tells from the sensors alone, without map, bias model and filter, where they are not at their known input."""

    axes: tuple[tuple[str, str], ...]  # channel and name of the D axes that it looks at

    @abstractmethod
    def start(self) -> Memory:
        """Return the memory before the first epoch."""

    @abstractmethod
    def look(self, chunk: Chunk, memory: Memory) -> tuple[Flags, Flags, Memory]:
        """Return the flags of still epochs (N,), of axes that stand out in each (N, D), and the memory."""


@dataclass(frozen=True)
class AlwaysStill(Detector):
    """The detector of sensors that cannot move."""

    axes: tuple[tuple[str, str], ...] = field(default=())

    def start(self) -> Memory:
        """Return nothing."""
        return None

    def look(self, chunk: Chunk, memory: Memory) -> tuple[Flags, Flags, Memory]:
        """Return the flags of epochs that are all still."""
        return np.ones(len(chunk), dtype=np.bool_), np.zeros((len(chunk), len(self.axes)), dtype=np.bool_), memory
