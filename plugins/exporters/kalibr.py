"""The `imu.yaml` of Kalibr: densities in continuous time, one for the three axes of a sensor.

Our noise in rad/s/sqrt(Hz) is Kalibr's; our walk in rad/s/sqrt(s) is its random walk in rad/s^2/sqrt(Hz), the same
unit in other words. Source: ethz-asl/kalibr, wiki "IMU Noise Model" and "Yaml formats".
"""

from __future__ import annotations

from typing import Literal

from fusion_core.contracts import Export, Exporter
from fusion_core.hookspecs import hookimpl
from fusion_plugins.exporters.imu_noise import DIGITS, ImuNoise, SensorNoise

NAMES = (
    ("accelerometer_noise_density", "accel", "white", "m/s^2/sqrt(Hz)"),
    ("accelerometer_random_walk", "accel", "walk", "m/s^3/sqrt(Hz), which is m/s^2/sqrt(s)"),
    ("gyroscope_noise_density", "gyro", "white", "rad/s/sqrt(Hz)"),
    ("gyroscope_random_walk", "gyro", "walk", "rad/s^2/sqrt(Hz), which is rad/s/sqrt(s)"),
)


def densities(noise: dict[str, SensorNoise]) -> list[str]:
    """Return the four lines of the densities, with their units."""
    return [f"{name}: {getattr(noise[c], which).value:{DIGITS}}  # {unit}" for name, c, which, unit in NAMES]


class Kalibr(ImuNoise):
    """The imu.yaml of Kalibr."""

    kind: Literal["kalibr"] = "kalibr"

    def text(self, what: Export, rate: float, noise: dict[str, SensorNoise]) -> list[str]:
        """Return the six keys that Kalibr reads."""
        return [*densities(noise), f'rostopic: "{self.topic}"', f"update_rate: {float(rate)!r}  # Hz"]


@hookimpl
def exporters() -> list[type[Exporter]]:
    """Register the plugin."""
    return [Kalibr]
