"""The contract of measurement models: the sensors of the filter, and the measurement of their biases.

The states are those of the model itself (what it integrates, say, from zero exactly), and then one block for the bias
of each sensor, in the order of `sensors`::

    x = (own states, bias block of sensor 1, bias block of sensor 2, ...)

The bias models bring the steps of their blocks; the measurement model couples the blocks with its own states and says
what is measured at each epoch. An epoch is what a sensor showed on average over `tau` seconds. N epochs, n states,
m measured components, d axes.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np

from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.contracts.plugin import Plugin
from fusion_core.contracts.sensor import Alignment, AlwaysStill, Detector, Patience, Sensor, Site
from fusion_core.errors import ConfigError
from fusion_core.model import Measurement, Prior, State, Transition
from fusion_core.settings import did_you_mean
from fusion_core.statespace import Block, StateSpace
from fusion_core.thermal.rate_estimators import RateEstimator, Regression
from fusion_core.units import Quantity, Unit


class MeasurementModel(Plugin):
    """The sensors of the filter, its states and its measurements."""

    update_interval: Annotated[float, Unit("s", positive=True, example="0.1 s")] = Quantity(0.1, "0.1 s")
    """Duration of an epoch: samples in between are integrated first."""
    align: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """Least duration of the first stretch at rest."""
    temperature_rate: RateEstimator = Regression()
    """Estimator of the temperature's rate."""

    # what it is about

    # must: what every model writes

    @property
    @abstractmethod
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors that are integrated over an epoch, in the order of their blocks."""

    @property
    @abstractmethod
    def patience(self) -> Patience:
        """The limits at which a measurement is refused, and the filter aligned anew."""

    @abstractmethod
    def with_tracked(self, **fields: Any) -> Self:
        """Return the model with other settings (`bias`, `calibration`, `noise`) of the tracked sensor."""

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

    @abstractmethod
    def still(self, window: Chunk) -> bool:
        """Return True if the sensors are at their known input over the epochs of a window, all of it."""

    @abstractmethod
    def aligned(self, window: Chunk, site: Site) -> Alignment:
        """Freeze what is to be frozen from the epochs of a stretch at rest."""

    # may: its sensors

    @property
    def tracked(self) -> Sensor:
        """The sensor whose bias is looked for; by default the last."""
        return self.sensors[-1]

    def _tracking(self, channel: str) -> Self:
        """Return the model with another of its sensors tracked; by default it has but one that can be."""
        raise ConfigError(
            f"filter: kind {self.kind} tracks its {self.tracked.channel} alone, not its {channel}; "
            f"name {self.tracked.channel}, or use a filter that can track the other"
        )

    def only(self, channels: Collection[str]) -> Self:
        """Return the model without the optional sensors whose channels are not among these; by default all stay."""
        return self

    @property
    def requires(self) -> tuple[str, ...]:
        """Names of the channels that it reads beside those of its sensors and their bias models."""
        return ()

    def check_units(self, units: Mapping[str, str | None]) -> None:
        """Raise UnitError where a source's units are not those of the sensors; by default nothing is looked at.

        `units` are those that a config writes for the channels of a file, by channel; None: as the file says.
        """

    def check(self, window: Chunk, site: Site) -> None:
        """Raise DataError where what the sensors show at rest cannot be: a wrong unit, say. By default nothing is."""

    # may: its states and measurements

    @property
    def own(self) -> tuple[Block, ...]:
        """The blocks of its own states; none by default.

        One without a prior begins at zero exactly, and starts anew at a refused measurement: what is integrated.
        """
        return ()

    @cached_property
    def components(self) -> list[tuple[str, str, str]]:
        """Channel, axis and unit of the m measured components; by default each axis of each sensor, in its unit."""
        return [(sensor.channel, axis, sensor.unit) for sensor in self.sensors for axis in sensor.axes]

    def prior(self, blocks: Sequence[Prior], alignment: Alignment | None = None) -> State:
        """Put the priors of the blocks together, the own states at their own, or at zero.

        `blocks` are in the order of `sensors`, `alignment` is that of the stretch which the filter begins with,
        None where nothing has been measured yet.
        """
        return self.space.prior({s.block.name: prior for s, prior in zip(self.sensors, blocks, strict=True)})

    def white(self, chunk: Chunk) -> Array:
        """Return the part of Q that is the sensors' white noise: (n, n), or (N, n, n); by default all of it is in R."""
        return np.zeros((self.n, self.n))

    def known(self, chunk: Chunk, alignment: Alignment) -> Array:
        """Return the reading (d,) or (N, d) of an ideal tracked sensor; by default the alignment's input."""
        return alignment.inputs[self.tracked.channel]

    def length_of_input(self, site: Site) -> tuple[float, float] | None:
        """Return the length of the tracked sensor's input and its deviation, where its direction is not known.

        Such an input stays in the axes of the unit as long as that lies as it does, so that what the sensor shows is
        its bias up to a level of each placement, which is known along the input alone. None, the default: the input is
        `known`.
        """
        return None

    # may: rest

    def detector(self, alignment: Alignment) -> Detector:
        """Return the detector of motion during the run; by default nothing moves."""
        return AlwaysStill()

    def simulated(self, N: int, site: Site, rng: np.random.Generator) -> Mapping[str, Array]:
        """Return made-up channels of N epochs at rest, as the sensors would show them: their noise, by default."""
        scale = 1 / np.sqrt(float(self.update_interval))
        return {s.channel: rng.normal(size=(N, len(s.axes))) * s.noise * scale for s in self.sensors}

    # given: the same for every model

    def tracking(self, channel: str) -> Self:
        """Return the model with its sensor of a channel as the tracked one.

        Raises
        ------
        ConfigError
            If it has no such sensor, or cannot track it.
        """
        known = [sensor.channel for sensor in self.sensors]
        if channel not in known:
            advice = did_you_mean(channel, known, "name one of these", "'")
            raise ConfigError(
                f"filter: kind {self.kind} has no sensor '{channel}', it has {', '.join(known)}; {advice}"
            )
        return self if channel == self.tracked.channel else self._tracking(channel)

    @cached_property
    def space(self) -> StateSpace:
        """Its own blocks, and then one for the bias of each sensor."""
        return StateSpace([*self.own, *(sensor.block for sensor in self.sensors)])

    @cached_property
    def places(self) -> dict[str, slice]:
        """Place of the bias block of each channel among the n states."""
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

    @property
    def m(self) -> int:
        """Number of measured components."""
        return len(self.components)

    @cached_property
    def restarting(self) -> Flags:
        """Flags (n,) of the states that start anew at a refused measurement."""
        return self.space.flags(*(block.name for block in self.own if block.prior is None))
