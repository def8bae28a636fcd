"""The `kalibr_imu_chain.yaml` of OpenVINS, or the four keys of VINS-Mono and VINS-Fusion.

OpenVINS takes densities in continuous time under `imu0`, and scale factor and misalignment at one temperature, as lower
triangular matrices and rotations; those of a map without them are one::

    I + M = Tw R_IMUtoGYRO    of the gyro,    I + M = Ta R_IMUtoACC    of the accelerometer

It takes (I + M)^-1 (reading - bias) for the input. Its reader is OpenCV's, so `%YAML:1.0` comes first. Source:
rpng/open_vins, config/euroc_mav/kalibr_imu_chain.yaml, ov_msckf/src/core/VioManagerOptions.h and
ov_msckf/src/state/Propagator.cpp.

VINS takes deviations of single samples and steps: over a step it adds to the variances of angle and bias

    dt^2 (gyr_n^2 + gyr_n^2) / 4    and    dt^2 gyr_w^2

where a density noise and a walk add noise^2 dt and walk^2 dt, so that::

    gyr_n = noise sqrt(2 rate),    gyr_w = walk sqrt(rate)

and `acc_n`, `acc_w` alike: 20 and 14 times the densities at 200 Hz. Source: HKUST-Aerial-Robotics/VINS-Fusion,
vins_estimator/src/factor/integration_base.h, `midPointIntegration`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, Export, Exporter
from fusion_core.contracts.calibration import TEMPERATURES
from fusion_core.errors import ConfigError
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Unit
from fusion_plugins.exporters.imu_noise import DIGITS, ImuNoise, SensorNoise
from fusion_plugins.exporters.kalibr import densities

FIRST = "%YAML:1.0"
ONE, NONE = ("[1.0, 0.0, 0.0]", "[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]"), ("[0.0, 0.0, 0.0]",) * 3
POSE = ("[1.0, 0.0, 0.0, 0.0]", "[0.0, 1.0, 0.0, 0.0]", "[0.0, 0.0, 1.0, 0.0]", "[0.0, 0.0, 0.0, 1.0]")
INTRINSICS = {"gyro": ("Tw", "R_IMUtoGYRO"), "accel": ("Ta", "R_IMUtoACC")}


class OpenVins(ImuNoise):
    """The kalibr_imu_chain.yaml of OpenVINS, or the keys of VINS."""

    kind: Literal["openvins"] = "openvins"
    form: Literal["openvins", "vins"] = "openvins"
    """Format: `vins` writes acc_n, acc_w, gyr_n and gyr_w, of single samples at `rate`."""
    at: Annotated[float, Unit("degC", example="25 degC")] | None = None
    """Temperature of scale factor and misalignment; without it the middle of the map's range."""

    @property
    def holds_matrix(self) -> bool:
        """True but for VINS, which has no place for them."""
        return self.form == "openvins"

    def notes(self, what: Export) -> Iterator[str]:
        """Yield the temperature of scale factor and misalignment, and how far they are off at others."""
        for channel in INTRINSICS if self.holds_matrix else ():
            sensor = what.sensor(channel)
            if sensor is not None and sensor.matrix is not None:
                at, (low, high) = self._temperature(sensor), sensor.fitted.domain
                change = sensor.matrix.at(np.linspace(low, high, TEMPERATURES)) - sensor.matrix.at(np.array([at]))
                yield (
                    f"{channel}: scale factor and misalignment are those of {at:.4g} degC; from {low:.4g} to "
                    f"{high:.4g} degC they lose {1e6 * np.max(np.abs(change).sum(axis=2)):.3g} ppm of the input at most"
                )

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

    def _intrinsics(self, what: Export) -> Iterator[str]:
        """Yield the lines of the matrices and rotations of both sensors."""
        for channel, names in INTRINSICS.items():
            sensor, both = what.sensor(channel), [ONE, ONE]
            if sensor is not None and sensor.matrix is not None:
                whole = np.eye(3) + sensor.matrix.at(np.array([self._temperature(sensor)]))[0]
                both = [_rows(part) for part in triangle_and_rotation(whole)]
            for name, rows in zip(names, both, strict=True):
                yield from _matrix(name, rows)
        yield from _matrix("Tg", NONE)

    def text(self, what: Export, rate: float, noise: dict[str, SensorNoise]) -> list[str]:
        """Return the keys that OpenVINS reads, or those of VINS."""
        if self.form == "vins":
            return [FIRST, "", f'imu_topic: "{self.topic}"', *_of_samples(rate, noise)]
        inner = [
            *_matrix("T_i_b", POSE),
            *densities(noise),
            f'rostopic: "{self.topic}"',
            "time_offset: 0.0",
            f"update_rate: {float(rate)!r}  # Hz",
            'model: "kalibr"',
            *self._intrinsics(what),
        ]
        return [FIRST, "", "imu0:", *(f"  {line}" for line in inner)]


def triangle_and_rotation(whole: Array) -> tuple[Array, Array]:
    """Return L, lower triangular with a positive diagonal, and the rotation R, (3, 3) each, whose product L R it is."""
    Q, U = np.linalg.qr(whole.T)
    signs = np.sign(np.diag(U))
    return np.asarray((signs[:, None] * U).T), np.asarray((Q * signs).T)


def _rows(matrix: Array) -> tuple[str, str, str]:
    x, y, z = (f"[{', '.join(f'{float(value):.9e}' for value in row)}]" for row in matrix)
    return x, y, z


def _matrix(name: str, rows: tuple[str, ...]) -> list[str]:
    return [f"{name}:", *(f"  - {row}" for row in rows)]


def _of_samples(rate: float, noise: dict[str, SensorNoise]) -> list[str]:
    """Return the deviations of single samples and steps."""
    sample, step = np.sqrt(2 * rate), np.sqrt(rate)
    lines = []
    for name, channel, unit in (("acc", "accel", "m/s^2"), ("gyr", "gyro", "rad/s")):
        white, walk = noise[channel].white.value, noise[channel].walk.value
        lines += [
            f"{name}_n: {white * sample:{DIGITS}}  # {unit}: {white:.4g} {unit}/sqrt(Hz) times sqrt(2 x {rate:g} Hz)",
            f"{name}_w: {walk * step:{DIGITS}}  # {unit}/s: {walk:.4g} {unit}/sqrt(s) times sqrt({rate:g} Hz)",
        ]
    return lines


@hookimpl
def exporters() -> list[type[Exporter]]:
    """Register the plugin."""
    return [OpenVins]
