"""Noise of an inertial unit as visual-inertial programs take it: one density for the three axes of a sensor.

A program that integrates readings which nobody has compensated sees the bias move with the temperature, and its walk
has to cover that; one that is given compensated readings does with less.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, Export, Exporter, Factor, Inflation, Loss, TriadMatrix, warm_up
from fusion_core.contracts.calibration import TEMPERATURES
from fusion_core.contracts.exporter import MatrixLoss
from fusion_core.errors import ConfigError
from fusion_core.escaping import comment
from fusion_core.units import Quantity, Unit

TOPIC = r"^~?/?[A-Za-z]\w*(/[A-Za-z]\w*)*$"  # names of ROS
SENSORS = {"gyro": "rad/s", "accel": "m/s^2"}
DIGITS = ".8e"  # with a point: without one, YAML 1.1 takes 5e-06 for a text


class Density(NamedTuple):
    """A density of one sensor in SI, and its origin in words."""

    value: float
    text: str


class SensorNoise(NamedTuple):
    """White noise and walk of one sensor, unit/sqrt(Hz) and unit/sqrt(s), and notes about them."""

    white: Density
    walk: Density
    notes: tuple[str, ...]


class ImuNoise(Exporter):
    """The base of exporters of noise."""

    suffix: ClassVar[str] = ".yaml"

    topic: Annotated[str, Field(pattern=TOPIC)] = "/imu0"
    """The topic of the messages."""
    rate: Annotated[float, Unit("Hz", positive=True, example="200 Hz")] | None = None
    """Rate of the messages; the config's where it has one."""
    compensated: bool = False
    """True if the program gets readings from which map and effects have been taken."""
    horizon: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """Time over which the program goes by a bias before it sees it anew: the walk covers what the bias does in it."""

    at: Annotated[float, Unit("degC", example="25 degC")] | None = None
    """Temperature of scale factor and misalignment; without it the middle of the map's range."""

    @abstractmethod
    def text(self, what: Export, rate: float, noise: dict[str, SensorNoise]) -> list[str]:
        """Return the lines of the file, but for the comments, from the noise of `gyro` and `accel`."""

    @property
    def intrinsic(self) -> bool:
        """True where the file has scale factor and misalignment too."""
        return True

    def matrices(self, what: Export) -> Iterator[tuple[Calibrated, TriadMatrix]]:
        """Yield the sensors that have scale factor and misalignment, with them."""
        for channel in SENSORS:
            sensor = what.sensor(channel)
            if sensor is not None and sensor.matrix is not None:
                yield sensor, sensor.matrix

    def notes(self, what: Export) -> Iterator[str]:
        """Yield the temperature of scale factor and misalignment, and how far they are off at others."""
        for sensor, matrix in self.matrices(what) if self.intrinsic else ():
            at, (low, high) = self._temperature(sensor), sensor.fitted.domain
            change = matrix.at(np.linspace(low, high, TEMPERATURES)) - matrix.at(np.array([at]))
            yield (
                f"{sensor.channel}: scale factor and misalignment are those of {at:.4g} degC; from {low:.4g} to "
                f"{high:.4g} degC they lose {1e6 * np.max(np.abs(change).sum(axis=2)):.3g} ppm of the input at most"
            )

    def triangle_and_rotation(self, what: Export, channel: str) -> tuple[Array, Array]:
        """Return L, lower triangular with a positive diagonal, and the rotation R, (3, 3) each, with L R = I + M."""
        whole = np.eye(3)
        for sensor, matrix in self.matrices(what):
            if sensor.channel == channel:
                whole = whole + matrix.at(np.array([self._temperature(sensor)]))[0]
        Q, U = np.linalg.qr(whole.T)
        signs = np.sign(np.diag(U))
        return np.asarray((signs[:, None] * U).T), np.asarray((Q * signs).T)

    def _temperature(self, sensor: Calibrated) -> float:
        """Return the temperature for the matrix of a sensor, degC."""
        low, high = sensor.fitted.domain
        at = (low + high) / 2 if self.at is None else float(self.at)
        if not low <= at <= high:
            raise ConfigError(
                f"export {self.kind}: at {at:.4g} degC is beyond the map of {sensor.channel}, {low:.4g} to {high:.4g} "
                "degC; give one within"
            )
        return at

    def export(self, what: Export, path: Path) -> Loss:
        """Write the largest density of each sensor's axes."""
        rate = self.rate or what.rate
        if rate is None:
            raise ConfigError(f"export {self.kind}: the rate of the messages is not known; add --set 'rate=200 Hz'")
        noise = {channel: self._noise(what, channel) for channel in SENSORS}
        maps = [sensor for sensor in what.sensors if sensor.map is not None]
        left_out = [f"the {sensor.channel}'s thermal map and effects" for sensor in maps]
        if not self.intrinsic:
            lost = ((sensor, MatrixLoss.measured(sensor)) for sensor, _ in self.matrices(what))
            left_out += [f"{sensor.channel}: {loss} at most" for sensor, loss in lost]
        notes = (note for sensor in noise.values() for note in sensor.notes)
        loss = Loss((), tuple(left_out), (*notes, *self.notes(what)))
        lines = self.text(what, rate, noise)
        begin = int(lines[0].startswith("%"))  # a directive stands before all else
        lines[begin:begin] = [comment(line) for line in self._comments(what, noise, loss)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return loss

    def _comments(self, what: Export, noise: dict[str, SensorNoise], loss: Loss) -> Iterator[str]:
        if what.serial:
            yield f"serial number {what.serial}"
        yield "one value for three axes: the largest; densities are those of continuous time"
        for channel, sensor in noise.items():
            yield f"{channel} noise: {sensor.white.text}"
            yield f"{channel} walk: {sensor.walk.text}"
        yield from loss.lines()

    def _noise(self, what: Export, channel: str) -> SensorNoise:
        sensor = what.sensor(channel)
        if sensor is None or sensor.noise is None or sensor.walk is None or sensor.unit != SENSORS[channel]:
            missing = "sensor" if sensor is None else "white noise" if sensor.noise is None else "random walk"
            raise ConfigError(
                f"export {self.kind}: no {missing} of {channel} in {SENSORS[channel]} is known; give a config whose "
                f"filter.{channel} has noise, and bias: {{kind: random_walk, walk: ...}}"
            )
        measured = sensor.compensated if self.compensated else sensor.raw
        if measured is None:
            white = _largest(sensor, sensor.noise, None, "sqrt(Hz)")
            walk = _largest(sensor, sensor.walk, None, "sqrt(s)")
            notes = [f"{channel}: no inflation was measured: noise and walk are as declared; add --run DIR"]
        else:
            white = _largest(sensor, measured.noise, measured.of_noise, "sqrt(Hz)")
            covering = measured.of_walk_up_to(float(self.horizon))
            walk = _largest(sensor, measured.walk, measured.of_walk, "sqrt(s)", covering)
            notes = [
                f"{channel}: measured at rest; what motion adds (scale factor, vibration, time stamps) is not in it",
                *_over_lags(channel, measured),
            ]
        if walk.value <= 0:
            raise ConfigError(f"export {self.kind}: the walk of {channel} is zero; declare one, no bias is constant")
        return SensorNoise(white, walk, (*notes, *self._of_temperature(sensor, measured)))

    def _of_temperature(self, sensor: Calibrated, measured: Inflation | None) -> Iterator[str]:
        """Yield the notes on the part of temperature in a walk."""
        if sensor.map is None:
            return
        channel = sensor.channel
        if self.compensated:
            yield f"{channel}: for readings from which map and effects have been taken; others need compensated=false"
            return
        if measured is not None:
            yield f"{channel}: the walk covers what temperature did in the run, and no faster warm-up"
        moved = _warming(sensor, float(self.horizon))
        yield (
            f"{channel}: over a warm-up of an hour through the map's range temperature alone moves the bias like a "
            f"walk of {moved:.3g} {sensor.unit}/sqrt(s) over {float(self.horizon):g} s, at most"
        )


def matrix_lines(name: str, matrix: Array) -> list[str]:
    """Return the lines of a matrix (n, n) in YAML."""
    return [f"{name}:", *(f"  - [{', '.join(_exact(float(value)) for value in row)}]" for row in matrix)]


def _exact(value: float) -> str:
    return f"{abs(value):.1f}" if value in (0.0, 1.0) else f"{value:.9e}"


def _largest(
    sensor: Calibrated, declared: Array, factor: Factor | None, per: str, covering: Array | None = None
) -> Density:
    """Return the largest of densities (d,) with their factors."""
    one = np.ones(len(declared))
    used = one if factor is None else factor.value if covering is None else covering
    k = int(np.argmax(declared * used))
    value = float(declared[k] * used[k])
    text = f"{value:.4g} {sensor.unit}/{per}, {value * sensor.factor:.4g} {sensor.shown}/{per} (axis {sensor.axes[k]})"
    if factor is not None:
        text += (
            f", {used[k]:.3g} times the declared {declared[k]:.4g}: innovations say {factor.value[k]:.3g} "
            f"({factor.low[k]:.3g} to {factor.high[k]:.3g} at 95 %)"
        )
    return Density(value, text)


def _over_lags(channel: str, measured: Inflation) -> Iterator[str]:
    """Yield the scatter of the bias over times longer than a step."""
    lags = []
    for lag in measured.lags:
        ratios = "/".join(f"{ratio:.3g}" for ratio in lag.ratio)
        lags.append(f"{ratios} over {lag.seconds:g} s (up to {np.max(lag.high):.3g} is chance)")
    if lags:
        yield (
            f"{channel}: a mean over a time differs from the next by so many times what noise and walk of the "
            f"innovations say: {', '.join(lags)}"
        )


def _warming(sensor: Calibrated, horizon: float) -> float:
    """Return the walk that moves the bias as far in `horizon` seconds as the map does in a warm-up, at most."""
    bias = sensor.fitted.bias(warm_up(sensor.fitted.domain)["temperature"])
    steps = int(np.clip(round(horizon), 1, len(bias) - 1))
    return float(np.max(np.abs(bias[steps:] - bias[:-steps])) / np.sqrt(steps))
