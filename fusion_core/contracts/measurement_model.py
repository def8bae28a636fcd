"""The contract of measurement models: which sensors the filter is given, and what is measured of their biases.

The states are those of the model itself (what it integrates, say), which begin at zero exactly, and then one block for
the bias of each sensor, in the order of `sensors`::

    x = (own states, bias block of sensor 1, bias block of sensor 2, ...)

The bias models bring the steps of their blocks; the measurement model couples the blocks with its own states and says
what is measured at each epoch. An epoch is what a sensor showed on average over `tau` seconds. N epochs, n states,
m measured components, d axes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, NamedTuple, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.plugin import Memory, Plugin
from fusion_core.contracts.thermal_map import ThermalMap
from fusion_core.errors import PluginError
from fusion_core.model import Flags, Measurement, Prior, State, Transition
from fusion_core.rate_estimators import RateEstimator, Regression
from fusion_core.statespace import Block, StateSpace
from fusion_core.units import Quantity, Unit, convert


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
            raise PluginError(f"{bias.kind}: {error}") from None

    @cached_property
    def factor(self) -> float:
        """How many of the unit that is shown are one SI unit."""
        return 1.0 / float(convert(1.0, self.shown, self.unit))


class Site(NamedTuple):
    """Where the sensors are: latitude and heading of the x axis (from north, clockwise), rad; None: not known."""

    latitude: float | None = None
    heading: float | None = None


class Patience(NamedTuple):
    """When a measurement is refused, and after how many seconds of refusals at a new rest the filter begins anew."""

    false_alarm: float
    realign_after: float


@dataclass(frozen=True)
class Alignment:
    """What is frozen at the end of a stretch at rest.

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
    """

    t: float
    dt: float
    inputs: dict[str, Array]
    noise_ratio: dict[str, Array]
    unsure: Array
    up: Array | None = None

    @cached_property
    def gate_scale(self) -> float:
        """How much larger the innovations may be because the declared noise is too small."""
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
        """Return which epochs are still (N,), which axes stand out in each (N, D), and the memory."""


@dataclass(frozen=True)
class AlwaysStill(Detector):
    """The detector of sensors that cannot move."""

    axes: tuple[tuple[str, str], ...] = field(default=())

    def start(self) -> Memory:
        """Return nothing."""
        return None

    def look(self, chunk: Chunk, memory: Memory) -> tuple[Flags, Flags, Memory]:
        """Return that every epoch is still."""
        return np.ones(len(chunk), dtype=np.bool_), np.zeros((len(chunk), len(self.axes)), dtype=np.bool_), memory


class MeasurementModel(Plugin):
    """What the filter is given, and what it measures."""

    update_interval: Annotated[float, Unit("s", positive=True, example="0.1 s")] = Quantity(0.1, "0.1 s")
    align: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    temperature_rate: RateEstimator = Regression()

    # what it is about

    @property
    @abstractmethod
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors that are integrated over an epoch, in the order of their blocks."""

    @property
    def tracked(self) -> Sensor:
        """The sensor whose bias is looked for; by default the last."""
        return self.sensors[-1]

    @abstractmethod
    def with_tracked(self, **fields: Any) -> Self:
        """Return the model with other settings (`bias`, `calibration`, `noise`) of the tracked sensor."""

    def only(self, channels: Collection[str]) -> Self:
        """Return the model without the optional sensors whose channels are not among these; by default all stay."""
        return self

    @property
    def requires(self) -> tuple[str, ...]:
        """Names of the channels that it reads beside those of its sensors and their bias models."""
        return ()

    @property
    @abstractmethod
    def patience(self) -> Patience:
        """When a measurement is refused, and how long."""

    # its states

    @property
    def own(self) -> tuple[Block, ...]:
        """The blocks of its own states, which begin at zero exactly; none by default.

        They start anew at a refused measurement.
        """
        return ()

    @cached_property
    def space(self) -> StateSpace:
        """Its own blocks, and then one for the bias of each sensor."""
        return StateSpace([*self.own, *(sensor.block for sensor in self.sensors)])

    @cached_property
    def places(self) -> dict[str, slice]:
        """Where the bias block of each channel is among the n states."""
        return {sensor.channel: self.space.places[sensor.block.name] for sensor in self.sensors}

    @property
    def labels(self) -> list[str]:
        """Names of the n states."""
        return self.space.labels

    @property
    def units(self) -> list[str]:
        """Units of the n states."""
        return self.space.units

    @property
    def n(self) -> int:
        """Number of states."""
        return self.space.n

    @cached_property
    def components(self) -> list[tuple[str, str, str]]:
        """Channel, axis and unit of the m measured components; by default each axis of each sensor, in its unit."""
        return [(sensor.channel, axis, sensor.unit) for sensor in self.sensors for axis in sensor.axes]

    @property
    def m(self) -> int:
        """Number of measured components."""
        return len(self.components)

    @cached_property
    def restarting(self) -> Flags:
        """Which of the n states start anew at a refused measurement."""
        return self.space.flags(*(block.name for block in self.own))

    def prior(self, blocks: Sequence[Prior], alignment: Alignment | None = None) -> State:
        """Put the priors of the blocks together, the own states at zero.

        `blocks` are in the order of `sensors`, `alignment` is that of the stretch which the filter begins with,
        None where nothing has been measured yet.
        """
        return self.space.prior({s.block.name: prior for s, prior in zip(self.sensors, blocks, strict=True)})

    # its steps and measurements

    @abstractmethod
    def equations(
        self, chunk: Chunk, steps: Sequence[Transition], alignment: Alignment
    ) -> tuple[Transition, Measurement]:
        """Return the steps of all n states and the measurement of each epoch.

        Parameters
        ----------
        chunk : Chunk
            N epochs with `tau`, and each sensor's channel (N, d), its calibration subtracted.
        steps : sequence of Transition
            Of the bias blocks, in the order of `sensors`.
        alignment : Alignment
            The last one.
        """

    def white(self, chunk: Chunk) -> Array:
        """Return the part of Q that is the sensors' white noise: (n, n), or (N, n, n); by default all of it is in R."""
        return np.zeros((self.n, self.n))

    def known(self, chunk: Chunk, alignment: Alignment) -> Array:
        """Return what an ideal tracked sensor shows, (d,) or (N, d); by default the alignment's input."""
        return alignment.inputs[self.tracked.channel]

    # rest

    @abstractmethod
    def still(self, window: Chunk) -> bool:
        """Whether the sensors are at their known input over the epochs of a window, all of it."""

    @abstractmethod
    def aligned(self, window: Chunk, site: Site) -> Alignment:
        """Freeze what is to be frozen from the epochs of a stretch at rest."""

    def check(self, window: Chunk, site: Site) -> None:
        """Raise DataError where what the sensors show at rest cannot be: a wrong unit, say. By default nothing is."""

    def detector(self, alignment: Alignment) -> Detector:
        """Return what watches for motion during the run; by default nothing moves."""
        return AlwaysStill()

    def rehearsal(self, N: int, site: Site, rng: np.random.Generator) -> Mapping[str, Array]:
        """Return made-up channels of N epochs at rest, as the sensors would show them: their noise, by default."""
        scale = 1 / np.sqrt(float(self.update_interval))
        return {s.channel: rng.normal(size=(N, len(s.axes))) * s.noise * scale for s in self.sensors}
