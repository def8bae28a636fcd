"""The `kalibr_imu_chain.yaml` of OpenVINS, or the four keys of VINS-Mono and VINS-Fusion.

OpenVINS takes densities in continuous time under `imu0`, and the unit's scale and misalignment, which are those of no
error here: driftlab does not estimate them. Its reader is OpenCV's, so `%YAML:1.0` comes first. Source: rpng/open_vins,
config/euroc_mav/kalibr_imu_chain.yaml, ov_msckf/src/core/VioManagerOptions.h.

VINS takes deviations of single samples and steps: over a step it adds to the variances of angle and bias

    dt^2 (gyr_n^2 + gyr_n^2) / 4    and    dt^2 gyr_w^2

where a density noise and a walk add noise^2 dt and walk^2 dt, so that::

    gyr_n = noise sqrt(2 rate),    gyr_w = walk sqrt(rate)

and `acc_n`, `acc_w` alike: 20 and 14 times the densities at 200 Hz. Source: HKUST-Aerial-Robotics/VINS-Fusion,
vins_estimator/src/factor/integration_base.h, `midPointIntegration`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fusion_core.contracts import Exporter
from fusion_core.hookspecs import hookimpl
from fusion_plugins.exporters.imu_noise import DIGITS, ImuNoise, SensorNoise
from fusion_plugins.exporters.kalibr import densities

FIRST = "%YAML:1.0"
ONE, NONE = ("[1.0, 0.0, 0.0]", "[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]"), ("[0.0, 0.0, 0.0]",) * 3
POSE = ("[1.0, 0.0, 0.0, 0.0]", "[0.0, 1.0, 0.0, 0.0]", "[0.0, 0.0, 1.0, 0.0]", "[0.0, 0.0, 0.0, 1.0]")
INTRINSICS = {"Tw": ONE, "R_IMUtoGYRO": ONE, "Ta": ONE, "R_IMUtoACC": ONE, "Tg": NONE}


class OpenVins(ImuNoise):
    """The kalibr_imu_chain.yaml of OpenVINS, or the keys of VINS."""

    kind: Literal["openvins"] = "openvins"
    form: Literal["openvins", "vins"] = "openvins"
    """Format: `vins` writes acc_n, acc_w, gyr_n and gyr_w, of single samples at `rate`."""

    def text(self, rate: float, noise: dict[str, SensorNoise]) -> list[str]:
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
            *(line for name, rows in INTRINSICS.items() for line in _matrix(name, rows)),
        ]
        return [FIRST, "", "imu0:", *(f"  {line}" for line in inner)]


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
