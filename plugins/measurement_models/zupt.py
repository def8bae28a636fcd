"""An inertial unit at rest: gyros and accelerometers whose motion is known to be none (ZUPT).

The states are the errors of velocity and attitude, 3 each, then the blocks of the accelerometers' and gyros' biases;
the equations are in `zero_velocity`, what is frozen as the reference in `alignment`, and what counts as motion in
`rest_detector`. Source: Fontanella et al., Sensors 18 (2018) 1457, sec. 2.1.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core import contracts
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.thermal_bias import check_corrected_once
from fusion_core.errors import ConfigError
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Installed
from fusion_core.settings import Settings
from fusion_core.statespace import Block
from fusion_core.units import Quantity, Unit, along_axes, check_axes, check_triad
from fusion_plugins.earth import gravity, known_gravity
from fusion_plugins.measurement_models.alignment import align, at_rest, check_gravity
from fusion_plugins.measurement_models.zero_velocity import Triad, ZeroVelocity

PerAxis = float | tuple[float, ...]
MAX_DIGITS = 3e7  # prior deviation over that of one update; its square times the rounding of a double is 0.2
SHAKE = 0.03  # of the white noise of one update: the frozen reference where it is not declared


class _Corrected(Settings):
    """One triad: the map that is subtracted first (or none), and how its bias moves."""

    calibration: Annotated[contracts.ThermalMap, Installed()] | None = None
    """The map that is subtracted before the filter."""
    noise: PerAxis
    bias: contracts.BiasModel
    range: float | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        check_corrected_once(self.calibration, self.bias)
        check_triad(self.bias.axes)
        check_axes("noise", self.noise, len(self.bias.axes))
        return self


class Gyro(_Corrected):
    """The gyro triad: its noise, the map that is subtracted first (or none), and how its bias moves."""

    noise: Annotated[PerAxis, Unit("rad/s/sqrt(Hz)", positive=True, example="3.18 deg/h/sqrt(Hz)")]
    """Density of the white noise."""
    range: Annotated[float, Unit("rad/s", positive=True, example="300 deg/s")] | None = None
    """Range of the sensor, beyond which it is saturated."""
    bias: Annotated[contracts.BiasModel, Installed(bias="rad/s")]
    """Model of the bias."""


class Accel(_Corrected):
    """The accelerometer triad: its noise, the map that is subtracted first (or none), and how its bias moves."""

    noise: Annotated[PerAxis, Unit("m/s^2/sqrt(Hz)", positive=True, example="0.05 m/s/sqrt(h)")]
    """Density of the white noise."""
    range: Annotated[float, Unit("m/s^2", positive=True, example="10 g")] | None = None
    """Range of the sensor, beyond which it is saturated."""
    bias: Annotated[contracts.BiasModel, Installed(bias="m/s^2")]
    """Model of the bias."""


class Rest(Settings):
    """The scatter of a unit at rest, and the limits beyond which it moves."""

    attitude: Annotated[float, Unit("rad", positive=True, example="1e-6 rad")] | None = None
    """Deviation of the frozen attitude: shaking and quantisation; 3 % of an update's white noise by default."""
    velocity: Annotated[float, Unit("m/s", positive=True, example="1e-5 m/s")] | None = None
    """Deviation of the frozen velocity: shaking and quantisation; 3 % of an update's white noise by default."""
    false_alarm: Annotated[float, Field(gt=0, lt=0.1)] = 1e-7
    """Probability that a sample at rest is taken for motion."""
    realign_after: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """After how long a rest that is refused the filter begins anew."""


@hookimpl
class Zupt(contracts.MeasurementModel):
    """An inertial unit at rest (zero-velocity update)."""

    kind: Literal["zupt"] = "zupt"
    gyro: Gyro
    """The gyro triad."""
    accel: Accel | None = None
    """The accelerometer triad; without it the vertical is not known."""
    track: Literal["gyro", "accel"] = "gyro"
    """The triad whose bias is looked for: that of maps, tables and figures."""
    rest: Rest = Rest()
    """Detection of motion, by the scatter and the level of the sensors."""

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return gyros alone, with accelerometers, and with these tracked."""
        walk = {"kind": "random_walk", "walk": 1e-6}
        gyro, accel = {"noise": 1e-4, "bias": walk}, {"noise": 1e-3, "bias": walk}
        both = {"gyro": gyro, "accel": accel}
        return tuple(map(cls.model_validate, ({"gyro": gyro}, both, {**both, "track": "accel"})))

    @model_validator(mode="after")
    def _tracks_what_it_has(self) -> Self:
        if self.track == "accel" and self.accel is None:
            raise ValueError("track is accel and there are no accelerometers; describe them under accel")
        return self

    @cached_property
    def sensors(self) -> tuple[contracts.Sensor, ...]:
        """The accelerometers, where there are any, and the gyros."""
        return (self._gyro,) if self._accel is None else (self._accel, self._gyro)

    @cached_property
    def _gyro(self) -> contracts.Sensor:
        return _sensor(self.gyro, "gyro", "rad/s", "deg/h", integral=("heading", "deg"))

    @cached_property
    def _accel(self) -> contracts.Sensor | None:
        optional = self.track != "accel"
        return None if self.accel is None else _sensor(self.accel, "accel", "m/s^2", "mg", optional=optional)

    @cached_property
    def _triads(self) -> tuple[Triad, ...]:
        named = {"gyro": ("attitude_error", "rad", self.rest.attitude)}
        named["accel"] = ("velocity_error", "m/s", self.rest.velocity)
        triads = []
        for sensor in self.sensors:
            integral, unit, rest = named[sensor.channel]
            white = sensor.noise * np.sqrt(self.update_interval)
            shake = SHAKE * white if rest is None else np.full_like(white, rest)
            triads.append(Triad(sensor, integral, unit, shake))
        return tuple(triads)

    @cached_property
    def _motion(self) -> ZeroVelocity:
        return ZeroVelocity(self._triads, self.space)

    @cached_property
    def tracked(self) -> contracts.Sensor:
        """The triad that `track` says."""
        return next(sensor for sensor in self.sensors if sensor.channel == self.track)

    def _tracking(self, channel: str) -> Self:
        return self.model_copy(update={"track": channel})

    def with_tracked(self, **fields: Any) -> Self:
        """Return the model with other settings of the tracked triad."""
        triad = self.gyro if self.track == "gyro" else self.accel
        assert triad is not None, "the tracked triad is described"
        return self.model_copy(update={self.track: triad.model_copy(update=fields)})

    def only(self, channels: Collection[str]) -> Self:
        """Return the model without accelerometers, where they have no channel and are not those that are tracked."""
        spare = "accel" not in channels and self.track != "accel"
        return self.model_copy(update={"accel": None}) if spare else self

    @property
    def patience(self) -> contracts.Patience:
        """The gate of the innovations, and the time after which a unit that was turned over is aligned anew."""
        return contracts.Patience(self.rest.false_alarm, float(self.rest.realign_after))

    @cached_property
    def own(self) -> tuple[Block, ...]:
        """The errors of velocity and attitude."""
        return tuple(
            Block(t.integral, tuple(f"{t.integral}_{axis}" for axis in t.sensor.axes), t.unit) for t in self._triads
        )

    @cached_property
    def components(self) -> list[tuple[str, str, str]]:
        """Each axis of each triad, in the unit of its integral."""
        return [(t.sensor.channel, axis, t.unit) for t in self._triads for axis in t.sensor.axes]

    def prior(self, blocks: Sequence[contracts.Prior], alignment: contracts.Alignment | None = None) -> contracts.State:
        """Put the priors together; raises ConfigError where one is so wide that an update is lost in its rounding."""
        for triad, block in zip(self._triads, blocks, strict=True):
            self._check_digits(triad, float(np.sqrt(np.max(np.diag(block.P)))))
        return super().prior(blocks, alignment)

    def _check_digits(self, triad: Triad, sigma_0: float) -> None:
        tau, section = float(self.update_interval), triad.sensor.section
        most = MAX_DIGITS * float(np.sqrt(np.min(triad.sensor.noise**2 / tau + (triad.shake / tau) ** 2)))
        if sigma_0 > most:
            raise ConfigError(
                f"{section}.bias: the deviation before the first sample is {sigma_0:.3g} in SI, beyond "
                f"{most:.3g} the digits of a computer do not suffice beside {section}.noise; "
                "set sigma_0 (or sigma of an estimated effect) lower"
            )

    def equations(
        self, chunk: Chunk, steps: Sequence[contracts.Transition], alignment: contracts.Alignment
    ) -> tuple[contracts.Transition, contracts.Measurement]:
        """Integrate what the sensors show less what they should, and measure that nothing moved."""
        return self._motion.transition(chunk, steps, alignment), self._motion.measurement(len(chunk))

    def white(self, chunk: Chunk) -> Array:
        """Return the part of Q that is the triads' white noise: (n, n), or (N, n, n) where tau is not constant."""
        return self._motion.white(chunk)

    def still(self, window: Chunk) -> bool:
        """Return True if no epoch stands out, and the scatter is not far beyond the declared noise."""
        return at_rest(window, self.sensors[::-1])

    def check(self, window: Chunk, site: contracts.Site) -> None:
        """Raise BadValue where the accelerometers do not show gravity."""
        if self._accel is not None:
            check_gravity(window, site)

    def aligned(self, window: Chunk, site: contracts.Site) -> contracts.Alignment:
        """Freeze attitude and velocity."""
        return align(window, site, self._gyro, self._accel, self.track)

    def length_of_input(self, site: contracts.Site) -> tuple[float, float] | None:
        """Return gravity for the accelerometers: which way it points, only they could say."""
        return known_gravity(site.latitude) if self.track == "accel" else None

    def detector(self, alignment: contracts.Alignment) -> contracts.Detector:
        """Return the detector of motion."""
        from fusion_plugins.measurement_models.rest_detector import RestDetector

        return RestDetector.of(self.sensors[::-1], alignment, self.patience.realign_after)

    def simulated(self, N: int, site: contracts.Site, rng: np.random.Generator) -> Mapping[str, Array]:
        """Return noise, and gravity along the last axis."""
        channels = dict(super().simulated(N, site, rng))
        if self._accel is not None:
            channels["accel"][:, -1] += gravity(site.latitude)
        return channels


def _sensor(triad: _Corrected, channel: str, unit: str, shown: str, **others: Any) -> contracts.Sensor:
    noise = along_axes(triad.noise, len(triad.bias.axes))
    section = f"filter.{channel}"
    return contracts.Sensor(channel, section, unit, shown, noise, triad.range, triad.bias, triad.calibration, **others)
