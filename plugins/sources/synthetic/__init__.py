"""A twin of a chamber experiment: a unit at rest whose true bias is known.

::

    gyro  = omega_ie + b + N sqrt(rate) white,      b = curve(T) + hysteresis(T) + turn-on + walk
    accel = g up     + b_a + N sqrt(rate) white,    walk_k = walk_k-1 + K / sqrt(rate) white
    temperature = T + white                         then each is rounded to its resolution

Sample k has the time k / rate. Its noise is that of the mean over the interval that leads to it; what moves slowly
(T, b) has its value at the time itself. The true bias is the channel `bias_truth`, which no filter reads.

Random numbers are drawn in blocks of a fixed length, each from a generator of its own (seed, quantity, block): the
samples do not depend on the size of the chunks, and taking one error away leaves the others as they were.

The bias of an axis over temperature is a polynomial with local steps; a loop of hysteresis follows a play operator::

    b(T) = offset + linear x + quadratic x^2 + cubic x^3 + sum height / (1 + exp(-2 ln 9 (T - at) / width)),
           x = T - reference
    hysteresis:  gain (p - T),    p = play(T) = what follows T when pushed, within T +- width / 2

On a stretch where T is monotone and that begins with p_0, the play operator is p = clip(p_0, T - width/2, T + width/2).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import SimulatedSource, Site, Twin
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_core.recursions import LaggedLines, play
from fusion_core.settings import Settings
from fusion_core.units import Unit, along_axes, problem
from fusion_plugins.earth import earth_rate, gravity
from fusion_plugins.sources.synthetic.chamber import Profile, Reading, body_behind
from fusion_plugins.sources.synthetic.settings import (
    DIFFERENCE,
    ONE_AN_AXIS,
    PerAxis,
    d,
    default,
    round_to,
)


class SmoothStep(Settings):
    """A smooth step, as where two modes of a resonator cross."""

    at: Reading
    """Temperature of the middle."""
    height: Annotated[float, Unit("rad/s", example="0.02 deg/s")]
    """Change of the bias."""
    width: Annotated[float, Unit("delta_degC", positive=True, example="0.8 K"), DIFFERENCE]
    """Width from 10 % to 90 % of the height."""

    def bias(self, T: Array) -> Array:
        """Return (N,) in rad/s at T (N,) in degC."""
        return np.asarray(self.height / 2 * (1 + np.tanh(np.log(9) * (T - self.at) / self.width)))


class BiasCurve(Settings):
    """The bias of one axis over temperature."""

    reference: Annotated[Reading, default("25 degC")]
    """Temperature at which the polynomial is its offset."""
    offset: Annotated[float, Unit("rad/s", example="0.1 deg/s"), default("0 deg/s")]
    """Bias at the reference."""
    linear: Annotated[float, Unit("rad/s/K", example="2e-3 deg/s/K"), default("0 deg/s/K")]
    """First coefficient of the polynomial."""
    quadratic: Annotated[float, Unit("rad/s/K^2", example="3e-5 deg/s/K^2"), default("0 deg/s/K^2")]
    """Second coefficient of the polynomial."""
    cubic: Annotated[float, Unit("rad/s/K^3", example="6e-7 deg/s/K^3"), default("0 deg/s/K^3")]
    """Third coefficient of the polynomial."""
    steps: tuple[SmoothStep, ...] = ()
    """Smooth steps at some temperatures."""

    def bias(self, T: Array) -> Array:
        """Return (N,) in rad/s at T (N,) in degC."""
        x = T - self.reference
        smooth = self.offset + x * (self.linear + x * (self.quadratic + x * self.cubic))
        return np.asarray(smooth + sum(step.bias(T) for step in self.steps))


class SimulatedHysteresis(Settings):
    """A loop about the curve: at the same temperature, cooling less warming is gain times width."""

    width: Annotated[float, Unit("delta_degC", positive=True, example="4 K"), DIFFERENCE]
    """Width of the loop."""
    gain: Annotated[PerAxis, Unit("rad/s/delta_degC", example="5 deg/h/K"), ONE_AN_AXIS]
    """Bias a kelvin of the loop's position."""


@dataclass(frozen=True)
class TrueBias:
    """The part of the bias that follows from temperature: curves (one an axis) and hysteresis, both of one body."""

    curves: tuple[BiasCurve, ...]
    hysteresis: SimulatedHysteresis | None
    body: LaggedLines

    def at(self, t: Array) -> Array:
        """Return the bias (N, d) in rad/s at t (N,) in s."""
        T = self.body.lagged(t)
        bias = np.stack([curve.bias(T) for curve in self.curves], axis=1)
        if self.hysteresis is None:
            return bias
        half = self.hysteresis.width / 2
        lag = np.clip(self._play[self.body.piece(t)] - T, -half, half)
        return np.asarray(bias + lag[:, None] * along_axes(self.hysteresis.gain, d))

    @cached_property
    def _play(self) -> Array:
        """The play operator (S,) in degC at the beginning of each monotone piece, from the middle of its play."""
        assert self.hysteresis is not None
        T = self.body.lagged(self.body.t)
        return np.asarray(play(T, self.hysteresis.width, T[0]))


BLOCK = 65_536  # samples drawn at a time; another number gives other samples
STREAMS = ("gyro", "gyro_walk", "turn_on", "accel", "accel_walk", "temperature")  # append only: the index is the key

# an invented MEMS triad: a bend and one abrupt change an axis
CURVES = [
    {"offset": "0.10 deg/s", "linear": "2e-3 deg/s/K", "quadratic": "-3e-5 deg/s/K^2", "cubic": "6e-7 deg/s/K^3",
     "steps": [{"at": "31 degC", "height": "0.03 deg/s", "width": "0.8 K"}]},
    {"offset": "-0.20 deg/s", "linear": "-1.2e-3 deg/s/K", "quadratic": "5e-5 deg/s/K^2",
     "steps": [{"at": "8 degC", "height": "-0.05 deg/s", "width": "1.5 K"}]},
    {"offset": "0.05 deg/s", "linear": "3e-3 deg/s/K", "quadratic": "2e-5 deg/s/K^2", "cubic": "-8e-7 deg/s/K^3",
     "steps": [{"at": "29.5 degC", "height": "-0.04 deg/s", "width": "1.2 K"}]},
]  # fmt: skip


class SimulatedThermometer(Settings):
    """The unit's thermometer."""

    at: Literal["body", "chamber"] = "body"
    """Temperature that the thermometer measures; with `chamber`, the gyros lag behind it."""
    noise: Annotated[float, Unit("delta_degC", least=0, example="0.02 K"), DIFFERENCE, default("0.02 K")]
    """Deviation of a reading."""
    resolution: Annotated[float, Unit("delta_degC", least=0, example="0.01 K"), DIFFERENCE, default("0.01 K")]
    """Step to which readings are rounded."""


class SimulatedGyro(Settings):
    """The gyro triad.

    The default walk is the one whose Allan deviation, with the default noise, has its floor sqrt(2 N K / sqrt(3)) at
    1.5e-4 deg/s (Fontanella et al. 2018, table 1, read as a floor).
    """

    noise: Annotated[
        PerAxis, Unit("rad/s/sqrt(Hz)", least=0, example="3.18 deg/h/sqrt(Hz)"), ONE_AN_AXIS,
        default("3.18 deg/h/sqrt(Hz)"),
    ]  # fmt: skip
    """Density of the white noise."""
    walk: Annotated[
        PerAxis, Unit("rad/s/sqrt(s)", least=0, example="2.2e-5 deg/s/sqrt(s)"), ONE_AN_AXIS,
        default("2.2e-5 deg/s/sqrt(s)"),
    ]  # fmt: skip
    """Density of the bias's random walk."""
    turn_on: Annotated[PerAxis, Unit("rad/s", least=0, example="20 deg/h"), ONE_AN_AXIS, default("0 deg/h")]
    """Deviation of the constant that is drawn at each start, that is for each seed."""
    curve: Annotated[tuple[BiasCurve, ...], default(CURVES)]
    """Bias over temperature, a curve for each axis."""
    hysteresis: SimulatedHysteresis | None = None
    """Loop about the curves."""
    resolution: Annotated[PerAxis, Unit("rad/s", least=0, example="0.01 deg/s"), ONE_AN_AXIS, default("0 deg/s")]
    """Step to which the output is rounded."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.curve) != d:
            raise problem(f"{len(self.curve)} curves are given for {d} axes; write a list of {d}, one an axis")
        return self


class SimulatedAccel(Settings):
    """The accelerometer triad."""

    noise: Annotated[
        PerAxis, Unit("m/s^2/sqrt(Hz)", least=0, example="0.05 m/s/sqrt(h)"), ONE_AN_AXIS,
        default("0.05 m/s/sqrt(h)"),
    ]  # fmt: skip
    """Density of the white noise."""
    walk: Annotated[
        PerAxis, Unit("m/s^2/sqrt(s)", least=0, example="1 ug/sqrt(s)"), ONE_AN_AXIS, default("1 ug/sqrt(s)")
    ]
    """Density of the bias's random walk."""
    bias: Annotated[PerAxis, Unit("m/s^2", example="2 mg"), ONE_AN_AXIS, default("0 mg")]
    """Constant bias."""
    resolution: Annotated[PerAxis, Unit("m/s^2", least=0, example="1 mg"), ONE_AN_AXIS, default("0 mg")]
    """Step to which the output is rounded."""


@hookimpl
class Synthetic(SimulatedSource):
    """A simulated unit at rest in a climatic chamber."""

    kind: Literal["synthetic"] = "synthetic"
    rate: Annotated[float, Unit("Hz", positive=True, example="100 Hz"), default("100 Hz")]
    """Samples a second."""
    profile: Annotated[Profile, Field(default={"kind": "ramp"}, validate_default=True, discriminator="kind")]
    """Temperature of the chamber over time."""
    lag: Annotated[float, Unit("s", least=0, example="60 s"), default("0 s")]
    """Time constant with which the unit's body follows the chamber."""
    temperature: Annotated[SimulatedThermometer, default({})]
    """The unit's thermometer."""
    gyro: Annotated[SimulatedGyro, default({})]
    """The gyro triad."""
    accel: Annotated[SimulatedAccel, default({})]
    """The accelerometer triad."""
    latitude: Annotated[float, Unit("rad", example="40.9 deg")] | None = None
    """Latitude of the site; without it the Earth stands still."""
    heading: Annotated[float, Unit("rad", example="0 deg"), default("0 deg")]
    """Heading of the x axis, from north, clockwise."""
    pitch: Annotated[float, Unit("rad", example="0 deg"), default("0 deg")]
    """Pitch of the x axis, upwards."""
    roll: Annotated[float, Unit("rad", example="0 deg"), default("0 deg")]
    """Roll about the x axis; lifts the y axis."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.samples < 1:
            raise problem(
                f"{self._length:g} s at {self.rate:g} Hz have no sample; write a longer duration, or a higher rate"
            )
        return self

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return a few seconds of a unit somewhere on Earth."""
        return (
            cls.model_validate({"duration": 5.0, "latitude": 0.7}),
            cls.model_validate({"duration": 3.0, "seed": 1}),
        )

    @property
    def name(self) -> str:
        """The kind with its seed."""
        return f"{self.kind} (seed {self.seed})"

    @property
    def site(self) -> Site:
        """Latitude and heading."""
        return Site(self.latitude, self.heading)

    @property
    def twin(self) -> Twin:
        """The gyros, and the chamber's profile; no loop of hysteresis."""
        noise, walk = along_axes(self.gyro.noise, d), along_axes(self.gyro.walk, d)

        def curve(T: Array) -> Array:
            return np.stack([axis.bias(T) for axis in self.gyro.curve], axis=1)

        return Twin("gyro", noise, walk, curve, *self.profile.knots(), self.lag)

    @property
    def samples(self) -> int:
        """Number of samples of the recording."""
        return round(self._length * self.rate)

    @property
    def _length(self) -> float:
        return self.profile.duration if self.duration is None else self.duration

    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the recording in chunks of at most `size` samples: gyro, accel, temperature, bias_truth."""
        for block in self._blocks():
            for start in range(0, len(block), size):
                stop = min(start + size, len(block))
                yield Chunk(block.t[start:stop], {name: v[start:stop] for name, v in block.channels.items()})

    def _blocks(self) -> Iterator[Chunk]:
        """Yield the recording in the blocks in which its random numbers are drawn."""
        body = body_behind(self.profile, self.lag)
        thermal = TrueBias(self.gyro.curve, self.gyro.hysteresis, body)
        omega_ie, g = self._surroundings()
        b_g = self._draw("turn_on", 0, 1, along_axes(self.gyro.turn_on, d))[0]  # (d,), at the end of the block before
        b_a = along_axes(self.accel.bias, d)
        for block in range(-(-self.samples // BLOCK)):
            first = block * BLOCK
            t = np.arange(first, min(first + BLOCK, self.samples)) / self.rate
            walk_g = b_g + self._walk("gyro_walk", block, len(t), self.gyro.walk)
            walk_a = b_a + self._walk("accel_walk", block, len(t), self.accel.walk)
            b_g, b_a = walk_g[-1], walk_a[-1]
            truth = thermal.at(t) + walk_g
            gyro = omega_ie + truth + self._white("gyro", block, len(t), self.gyro.noise)
            accel = g + walk_a + self._white("accel", block, len(t), self.accel.noise)
            T = body.lagged(t) if self.temperature.at == "body" else body.line(t)
            T = T + self._draw("temperature", block, len(t), np.array([self.temperature.noise]))[:, 0]
            channels = {
                "gyro": round_to(gyro, along_axes(self.gyro.resolution, d)),
                "accel": round_to(accel, along_axes(self.accel.resolution, d)),
                "temperature": round_to(T, self.temperature.resolution),
                "bias_truth": truth,
            }
            yield Chunk(t, channels)

    def _draw(self, stream: str, block: int, n: int, sigma: Array) -> Array:
        """Return normal numbers (n, m) of deviation sigma (m,): the n first ones of a block."""
        if not np.any(sigma):
            return np.zeros((n, len(sigma)))
        key = np.random.SeedSequence(self.seed, spawn_key=(STREAMS.index(stream), block))
        drawn = np.random.Generator(np.random.SFC64(key)).standard_normal((n, len(sigma)))
        drawn *= sigma
        return drawn

    def _white(self, stream: str, block: int, n: int, density: PerAxis) -> Array:
        """Return the mean of white noise over each interval: N sqrt(rate)."""
        return self._draw(stream, block, n, np.sqrt(self.rate) * along_axes(density, d))

    def _walk(self, stream: str, block: int, n: int, density: PerAxis) -> Array:
        """Return a random walk from the sample before the block, with steps K / sqrt(rate); it begins at zero."""
        steps = self._draw(stream, block, n, along_axes(density, d) / np.sqrt(self.rate))
        if block == 0:
            steps[0] = 0.0
        return np.cumsum(steps, axis=0)

    def _surroundings(self) -> tuple[Array, Array]:
        """Return Earth rate (d,) in rad/s and the specific force of rest (d,) in m/s^2, in the axes of the unit.

        Without a latitude, no rate and standard gravity.
        """
        up = np.array([
            np.sin(self.pitch), np.cos(self.pitch) * np.sin(self.roll), np.cos(self.pitch) * np.cos(self.roll),
        ])  # fmt: skip
        g = gravity(self.latitude) * up
        if self.latitude is None:
            return np.zeros(d), g
        x_level = np.array([np.cos(self.pitch), -np.sin(self.pitch) * np.sin(self.roll),
                            -np.sin(self.pitch) * np.cos(self.roll)])  # fmt: skip
        return earth_rate(up, self.latitude, self.heading, x_level), g
