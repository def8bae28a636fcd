"""ArduPilot's names for an IMU's thermal parameters, and what a file of parameters says of it.

`INS_TCAL<n>_*` of the first three IMUs since firmware 4.1; the fourth and fifth have a group of their own, `INS4_*`.
Source: ArduPilot, AP_InertialSensor.cpp, AP_InertialSensor_Params.cpp, AP_InertialSensor_tempcal.cpp.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import ReadBack
from fusion_core.errors import ConfigError
from fusion_plugins.exporters.ardupilot_arithmetic import UNCALIBRATED, Calibration
from fusion_plugins.exporters.parameters import integer, missing, read_parameters

AXES = ("X", "Y", "Z")
LEARNING = 2  # of INS_TCALn_ENABLE


@dataclass(frozen=True)
class Kind:
    """A kind of sensor that ArduPilot corrects for temperature."""

    short: str  # in parameters' names
    channel: str
    unit: str


SENSORS = (Kind("GYR", "gyro", "rad/s"), Kind("ACC", "accel", "m/s^2"))


def group(imu: int) -> str:
    """Return how the names of an IMU's thermal parameters begin."""
    return f"INS_TCAL{imu}_" if imu <= 3 else f"INS{imu}_TCAL_"


def coefficient(kind: Kind, imu: int, power: int, axis: int) -> str:
    """Return the name of a coefficient's parameter."""
    return f"{group(imu)}{kind.short}{power}_{AXES[axis]}"


def offset(kind: Kind, imu: int, axis: int) -> str:
    """Return the name of the parameter of a constant offset."""
    number = imu if imu in (2, 3) else ""
    return f"INS{imu if imu > 3 else ''}_{kind.short}{number}OFFS_{AXES[axis]}"


def taken_at(kind: Kind, imu: int) -> str:
    """Return the name of the parameter with the temperature at which the offset was taken."""
    return f"INS{imu}_{kind.short}_CALTEMP" if imu > 3 else f"INS_{kind.short}{imu}_CALTEMP"


def calibrations(path: Path, imu: int) -> list[ReadBack]:
    """Return the thermal calibrations of an IMU that are in use in the vehicle of a parameter file.

    Raises
    ------
    UnreadableFile
        If it is no parameter file.
    ConfigError
        If there is no calibration in use.
    """
    values = read_parameters(path)
    begin = group(imu)
    enabled = integer(values, f"{begin}ENABLE")
    found = [_calibration(values, kind, imu) for kind in SENSORS if enabled == 1 and _held(values, kind, imu).any()]
    if found:
        return found
    others = [other for other in range(1, 6) if other != imu and integer(values, f"{group(other)}ENABLE") == 1]
    why = f"{begin}ENABLE is {enabled if f'{begin}ENABLE' in values else 'missing'}"
    if enabled == 1:
        why = f"{begin}GYR1 to 3 and ACC1 to 3 are all 0 or missing"
    elif enabled == LEARNING:
        why += ", it is being learned"
    beside = f", and IMU {', '.join(map(str, others))} is corrected" if others else ""
    raise ConfigError(
        f"{path}: IMU {imu} is not corrected for temperature ({why}{beside}); give all parameters of a vehicle that is "
        "calibrated, and its --set imu=N"
    )


def _held(values: Mapping[str, float], kind: Kind, imu: int) -> Array:
    """Return the coefficients (3, 3) of an IMU's sensor, lowest power first."""
    return np.array([values.get(name, 0.0) for name in _coefficients(kind, imu)]).reshape(3, 3)


def _coefficients(kind: Kind, imu: int) -> list[str]:
    return [coefficient(kind, imu, power, axis) for power in (1, 2, 3) for axis in range(3)]


def _calibration(values: Mapping[str, float], kind: Kind, imu: int) -> ReadBack:
    low, high = (np.float32(values.get(f"{group(imu)}T{end}", usual)) for end, usual in (("MIN", 0.0), ("MAX", 70.0)))
    if not low < high:
        raise ConfigError(
            f"{group(imu)}TMIN {low:g} and TMAX {high:g}: expected a range; calibrate that vehicle before its "
            "parameters are read"
        )
    constant = np.array([values.get(offset(kind, imu, axis), 0.0) for axis in range(3)], dtype=np.float32)
    T_cal = np.float32(values.get(taken_at(kind, imu), UNCALIBRATED))
    held = Calibration(_held(values, kind, imu).astype(np.float32), low, high, constant, T_cal)
    notes = [f"{kind.channel}: IMU {imu}, clamped below {low:g} and above {high:g} °C"]
    notes += missing(values, _coefficients(kind, imu))
    if T_cal <= UNCALIBRATED:
        notes.append(f"{kind.channel}: {taken_at(kind, imu)} is not set, the firmware takes TMIN in its place")

    def bias(T: Array) -> Array:
        return held.bias(T).astype(np.float64)

    return ReadBack(kind.channel, kind.unit, ("x", "y", "z"), (float(low), float(high)), bias, notes=tuple(notes))
