"""The `imu.yaml` of Kalibr: densities in continuous time, one for the three axes of a sensor.

Of maps with scale factor and misalignment it has those at one temperature, as Kalibr's own results of
`--imu-models scale-misalignment` have them, M lower triangular and i the frame of the accelerometer's M::

    accelerometer:  reading = M a_i + bias        gyroscope:  reading = M C_gyro_i omega_i + A a_i + bias

Our noise in rad/s/sqrt(Hz) is Kalibr's; our walk in rad/s/sqrt(s) is its random walk in rad/s^2/sqrt(Hz), the same
unit in other words. Source: ethz-asl/kalibr, wiki "IMU Noise Model" and "Yaml formats";
aslam_offline_calibration/kalibr/python/kalibr_imu_camera_calibration/IccSensors.py, `IccScaledMisalignedImu`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from fusion_core.contracts import Export
from fusion_core.hookspecs import hookimpl
from fusion_plugins.exporters.imu_noise import DIGITS, ImuNoise, SensorNoise, matrix_lines

CHANNELS = ("accel", "gyro")
NAMES = (
    ("accelerometer_noise_density", "accel", "white", "m/s^2/sqrt(Hz)"),
    ("accelerometer_random_walk", "accel", "walk", "m/s^3/sqrt(Hz), which is m/s^2/sqrt(s)"),
    ("gyroscope_noise_density", "gyro", "white", "rad/s/sqrt(Hz)"),
    ("gyroscope_random_walk", "gyro", "walk", "rad/s^2/sqrt(Hz), which is rad/s/sqrt(s)"),
)


def densities(noise: dict[str, SensorNoise]) -> list[str]:
    """Return the four lines of the densities, with their units."""
    return [f"{name}: {getattr(noise[c], which).value:{DIGITS}}  # {unit}" for name, c, which, unit in NAMES]


@hookimpl
class Kalibr(ImuNoise):
    """The imu.yaml of Kalibr."""

    kind: Literal["kalibr"] = "kalibr"

    def text(self, what: Export, rate: float, noise: dict[str, SensorNoise]) -> list[str]:
        """Return the six keys that Kalibr reads, and of maps with scale factor and misalignment the model with them."""
        lines = [*densities(noise), f'rostopic: "{self.topic}"', f"update_rate: {float(rate)!r}  # Hz"]
        if not list(self.matrices(what)):
            return lines
        (of_accel, to_accel), (of_gyro, to_gyro) = (self.triangle_and_rotation(what, name) for name in CHANNELS)
        parts = {"M": of_gyro, "C_gyro_i": to_gyro @ to_accel.T, "A": np.zeros((3, 3))}
        gyro = (f"  {line}" for name, part in parts.items() for line in matrix_lines(name, part))
        accel = (f"  {line}" for line in matrix_lines("M", of_accel))
        return [*lines, "model: scale-misalignment", "accelerometers:", *accel, "gyroscopes:", *gyro]

    def notes(self, what: Export) -> Iterator[str]:
        """Yield the notes on scale factor and misalignment, and what C_gyro_i stands on."""
        yield from super().notes(what)
        if len(list(self.matrices(what))) == len(CHANNELS):
            yield "C_gyro_i: is right where both maps are in one frame, as a gyro's by placements of this accelerometer"
