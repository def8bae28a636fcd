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
from typing import Literal

import numpy as np

from fusion_core.contracts import Export
from fusion_core.hookspecs import hookimpl
from fusion_plugins.exporters.imu_noise import DIGITS, ImuNoise, SensorNoise, matrix_lines
from fusion_plugins.exporters.kalibr import densities

FIRST = "%YAML:1.0"
INTRINSICS = {"gyro": ("Tw", "R_IMUtoGYRO"), "accel": ("Ta", "R_IMUtoACC")}


@hookimpl
class OpenVins(ImuNoise):
    """The kalibr_imu_chain.yaml of OpenVINS, or the keys of VINS."""

    kind: Literal["openvins"] = "openvins"
    form: Literal["openvins", "vins"] = "openvins"
    """Format: `vins` writes acc_n, acc_w, gyr_n and gyr_w, of single samples at `rate`."""

    @property
    def intrinsic(self) -> bool:
        """True but for VINS, which has no place for scale factor and misalignment."""
        return self.form == "openvins"

    def _intrinsics(self, what: Export) -> Iterator[str]:
        """Yield the lines of the matrices and rotations of both sensors."""
        for channel, names in INTRINSICS.items():
            for name, part in zip(names, self.triangle_and_rotation(what, channel), strict=True):
                yield from matrix_lines(name, part)
        yield from matrix_lines("Tg", np.zeros((3, 3)))

    def text(self, what: Export, rate: float, noise: dict[str, SensorNoise]) -> list[str]:
        """Return the keys that OpenVINS reads, or those of VINS."""
        if self.form == "vins":
            return [FIRST, "", f'imu_topic: "{self.topic}"', *_of_samples(rate, noise)]
        inner = [
            *matrix_lines("T_i_b", np.eye(4)),
            *densities(noise),
            f'rostopic: "{self.topic}"',
            "time_offset: 0.0",
            f"update_rate: {float(rate)!r}  # Hz",
            'model: "kalibr"',
            *self._intrinsics(what),
        ]
        return [FIRST, "", "imu0:", *(f"  {line}" for line in inner)]


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
