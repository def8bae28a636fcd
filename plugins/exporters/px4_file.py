"""What a file of PX4's parameters says of thermal calibrations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import ReadBack
from fusion_core.errors import ConfigError
from fusion_plugins.exporters.parameters import integer, missing, read_parameters
from fusion_plugins.exporters.px4_arithmetic import Calibration

INSTANCES = range(4)
AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class Kind:
    """A kind of sensor that PX4 corrects for temperature."""

    letter: str  # in parameters' names
    channel: str
    unit: str
    order: int
    axes: int
    topic: str
    setting: str
    offset: str  # of its calibration: CAL_<offset><n>_ID

    def coefficient(self, instance: int, power: int, axis: int) -> str:
        """Return the name of a coefficient's parameter."""
        return f"TC_{self.letter}{instance}_X{power}" + (f"_{axis}" if self.axes > 1 else "")


SENSORS = (
    Kind("G", "gyro", "rad/s", 3, 3, "sensor_gyro", "device_id", "GYRO"),
    Kind("A", "accel", "m/s^2", 3, 3, "sensor_accel", "accel_device_id", "ACC"),
    Kind("B", "baro", "Pa", 5, 1, "sensor_baro", "baro_device_id", "BARO"),
)


def calibrations(path: Path, instance: int, wanted: Mapping[str, int | None]) -> list[ReadBack]:
    """Return the thermal calibrations that are in use in the vehicle of a parameter file.

    Parameters
    ----------
    instance : int
        Number in the parameters' names, where no device id is wanted.
    wanted : mapping of str to int or None
        Device ids by the letter of a kind of sensor.

    Raises
    ------
    UnreadableFile
        If it is no parameter file.
    ConfigError
        If there is no calibration in use, or none of a device that is wanted.
    """
    values = read_parameters(path)
    found, why = [], []
    for kind in SENSORS:
        try:
            found.append(_calibration(values, kind, instance, wanted[kind.letter]))
        except _Unused as error:
            if wanted[kind.letter] is not None:
                raise ConfigError(f"{path}: {error}; name a device of this vehicle") from None
            why.append(str(error))
    if not found:
        raise ConfigError(
            f"{path}: corrects nothing for temperature ({', '.join(why)}); give all parameters of a vehicle that is "
            "calibrated, and its --set instance=N"
        )
    return found


class _Unused(Exception):
    """Why a kind of sensor is not corrected."""


def _calibration(values: Mapping[str, float], kind: Kind, instance: int, wanted: int | None) -> ReadBack:
    begin = f"TC_{kind.letter}"
    ids = {n: integer(values, f"{begin}{n}_ID") for n in INSTANCES if integer(values, f"{begin}{n}_ID")}
    named = ", ".join(f"{begin}{n}_ID {number}" for n, number in ids.items())
    if not integer(values, f"{begin}_ENABLE"):
        raise _Unused(f"{begin}_ENABLE is {'0' if f'{begin}_ENABLE' in values else 'missing'}")
    if wanted is not None:
        instance = next((n for n, number in ids.items() if number == wanted), -1)
    if instance not in ids:
        raise _Unused(f"{kind.channel} {wanted or instance} has no {begin}n_ID" + (f" beside {named}" if named else ""))
    names = [[kind.coefficient(instance, power, axis) for axis in range(kind.axes)] for power in range(kind.order + 1)]
    X = np.array([[values.get(name, 0.0) for name in row] for row in names], dtype=np.float32)
    T_ref, low, high = (np.float32(values.get(f"{begin}{instance}_{end}", np.nan)) for end in ("TREF", "TMIN", "TMAX"))
    if not np.any(X):
        raise _Unused(f"{begin}{instance}_X0 to _X{kind.order} are all 0 or missing")
    if not (low < high and np.isfinite(T_ref)):
        raise _Unused(f"{begin}{instance}_TMIN {low:g}, _TMAX {high:g}, _TREF {T_ref:g} are no range")
    held = Calibration(X, T_ref, low, high)
    offset, note = _offset(values, kind, ids[instance])

    def bias(T: Array) -> Array:
        return held.offset(T).astype(np.float64) + offset

    gone = missing(values, [name for row in names for name in row])
    notes = (f"{kind.channel}: device id {ids[instance]}, clamped below {low:g} and above {high:g} °C", *gone, *note)
    axes = ("x", "y", "z") if kind.axes > 1 else ("x",)
    return ReadBack(kind.channel, kind.unit, axes, (float(low), float(high)), bias, kind.order, notes)


def _offset(values: Mapping[str, float], kind: Kind, device: int) -> tuple[Array, tuple[str, ...]]:
    """Return what the constant calibration of the same device takes off besides (d,), and what to say of it."""
    slot = next((n for n in INSTANCES if integer(values, f"CAL_{kind.offset}{n}_ID") == device), None)
    names = (
        [f"CAL_{kind.offset}{slot}_{axis}OFF" for axis in AXES] if kind.axes > 1 else [f"CAL_{kind.offset}{slot}_OFF"]
    )
    offset = np.array([values.get(name, 0.0) for name in names])
    if not np.any(offset):
        return offset, ()
    return offset, (f"{kind.channel}: {', '.join(names)} are not 0, and taken off besides; so they are here",)
