"""PX4's thermal parameters, as the `.params` file that QGroundControl loads.

`TC_G<n>_*` of a gyro (rad/s), `TC_A<n>_*` of an accelerometer (m/s^2), both cubics on three axes, and `TC_B<n>_*` of a
barometer (Pa), of fifth order. A sensor is corrected only where `TC_?<n>_ID` is its device id: nothing says so in
flight where it is not. X0 is subtracted *besides* the offset in `CAL_GYRO<n>_?OFF`, which is therefore set to zero.

Sources: PX4-Autopilot, src/modules/temperature_compensation, src/lib/sensor_calibration/Gyroscope.hpp; QGroundControl,
ParameterManager (the vehicle's system id must be that of each line).

What a file of PX4's parameters says of thermal calibrations.

What PX4 makes of thermal parameters, to the bit: single precision, in the firmware's order of operations.

::

    d = clip(T, TMIN, TMAX) - TREF
    gyro, accelerometer:  X0 + X1 d + X2 d2 + X3 d3,    d2 = d d,  d3 = d2 d
    barometer:            the same to X5, the power multiplied up as it goes

What is subtracted from the sensor is not this, but what was last *published*: a module looks once a second, and
publishes when the temperature has moved by more than 1 K since it last did. So the correction runs in stairs. (When it
publishes another sensor's, this one's goes with it: with `TC_A_ENABLE` the stairs may be finer than here.)

Products and sums are rounded one by one, as C without contraction does; a compiler that fuses them differs in the last
bit. Source: PX4-Autopilot, src/modules/temperature_compensation: TemperatureCompensation.cpp,
TemperatureCompensationModule.cpp. N samples, n coefficients, d axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Calibrated, Export, Exporter, Loss, ReadBack, SensorLoss
from fusion_core.errors import ConfigError
from fusion_core.escaping import comment
from fusion_core.hookspecs import hookimpl
from fusion_core.units import same_dimension
from fusion_plugins.exporters.autopilot import (
    Cubic,
    integer,
    measured,
    missing,
    places,
    polynomial,
    powers,
    read_parameters,
    single,
    uncorrected,
)

INTEGER, REAL = 6, 9  # MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32
DeviceId = Annotated[int, Field(gt=0, lt=2**31)]


class Px4(Cubic):
    """Thermal parameters of PX4, for QGroundControl."""

    suffix: ClassVar[str] = ".params"

    kind: Literal["px4"] = "px4"
    device_id: DeviceId | None = None
    """`device_id` of the gyro, as in `sensor_gyro` of a log. Without it, that of the log of which the map was made."""
    accel_device_id: DeviceId | None = None
    """The same of the accelerometer."""
    baro_device_id: DeviceId | None = None
    """The same of the barometer."""
    instance: Annotated[int, Field(ge=0, le=3)] | None = None
    """Number in the parameters' names. Without it, that of the sensor in the log of which the map was made, else 0."""
    calibration: Annotated[int, Field(ge=0, le=3)] | None = None
    """The n of the CAL_GYROn_ID that is the gyro's. Without it, that of the log, else as `instance`."""
    system: Annotated[int, Field(ge=1, le=255)] = 1
    """The vehicle's MAV_SYS_ID."""

    def export(self, what: Export, path: Path) -> Loss:
        """Write the parameters of each sensor that has a map."""
        rows: list[tuple[str, float, int]] = []
        losses: list[SensorLoss] = []
        left_out: list[str] = []
        notes: list[str] = []
        for sensor in what.mapped:
            kind, number = _kind(sensor), self._device(sensor)
            calibration, lost, lacking = self._fitted(sensor, kind)
            rows += [
                (f"TC_{kind.letter}_ENABLE", 1, INTEGER),
                *_rows(kind, self._instance(sensor), number, calibration),
            ]
            losses.append(lost)
            left_out += lacking
            if kind.letter == "G":
                slot = self._slot(sensor)
                rows += [(f"CAL_GYRO{slot}_{axis.upper()}OFF", 0.0, REAL) for axis in sensor.axes]
            notes += self._notes(sensor, kind, number)
        loss = Loss(tuple(losses), tuple(left_out), tuple(notes))
        head = ["Thermal calibration of PX4, by driftlab", *loss.lines(), "Vehicle-Id Component-Id Name Value Type"]
        lines = [comment(line) for line in head]
        lines += [
            f"{self.system}\t1\t{name}\t{int(value) if type_ == INTEGER else single(value)}\t{type_}"
            for name, value, type_ in rows
        ]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return loss

    def read(self, path: Path) -> list[ReadBack]:
        """Return the sensors that a file's parameters correct: of `device_id` where it is given, else of `instance`."""
        wanted = {"G": self.device_id, "A": self.accel_device_id, "B": self.baro_device_id}
        return calibrations(path, self.instance or 0, wanted)

    def _instance(self, sensor: Calibrated) -> int:
        return _known(sensor, "instance", 0) if self.instance is None else self.instance

    def _slot(self, sensor: Calibrated) -> int:
        instance = self._instance(sensor)
        return _known(sensor, "calibration", instance) if self.calibration is None else self.calibration

    def _device(self, sensor: Calibrated) -> int:
        kind = _kind(sensor)
        given = {"G": self.device_id, "A": self.accel_device_id, "B": self.baro_device_id}[kind.letter]
        known = sensor.fitted.record.provenance.get("device_id", "")
        if given is not None:
            return given
        if known.isascii() and known.isdigit() and int(known) > 0:
            return int(known)
        raise ConfigError(
            f"export px4: the device id of the {sensor.channel} is not known, and PX4 would use nothing of the file "
            f"without it; give --set {kind.setting}=N with the device_id that {kind.topic} has in the vehicle's log"
        )

    def _fitted(self, sensor: Calibrated, kind: Px4Sensor) -> tuple[Px4Parameters, SensorLoss, tuple[str, ...]]:
        """Return what the firmware is to hold of a sensor, and what that loses."""
        if kind.axes == 1 and len(sensor.axes) != 1:
            raise ConfigError(
                f"export px4: {sensor.channel} has {len(sensor.axes)} axes, a barometer has one; give the map of one "
                "barometer"
            )
        at = places("px4", sensor) if kind.axes > 1 else [0]
        low, high = (np.float32(end) for end in sensor.fitted.domain)
        T_ref = np.float32((low + high) / 2)
        flown = self.flown(sensor.fitted.domain)
        c = polynomial(sensor.fitted, kind.order, float(T_ref), flown)
        X = np.zeros((kind.order + 1, kind.axes), dtype=np.float32)
        X[:, at] = c
        calibration = Px4Parameters(X, T_ref, low, high)

        def exact(T: Array) -> Array:
            return powers(T, float(T_ref), c)

        def target(T: Array) -> Array:
            return calibration.offset(T)[:, at].astype(np.float64)

        def renewed(recording: Chunk) -> Array:
            return target(published(recording.t, recording["temperature"]).astype(np.float64))

        loss, beyond = measured(sensor, exact, exact, target, renewed, flown)
        return calibration, loss, (*beyond, *(uncorrected(sensor) if kind.axes > 1 else ()))

    def _notes(self, sensor: Calibrated, kind: Px4Sensor, number: int) -> list[str]:
        notes = [f"{sensor.channel}: used for the device id {number} alone; reboot after loading"]
        if kind.letter == "G":
            slot = self._slot(sensor)
            zero = ", ".join(f"_{axis.upper()}OFF" for axis in sensor.axes)
            notes.append(
                f"{sensor.channel}: CAL_GYRO{slot}{zero} are set to 0, as X0 has the offset; where not "
                f"CAL_GYRO{slot}_ID but another CAL_GYROn_ID is {number}, give --set calibration=n"
            )
        elif kind.letter == "A":
            notes.append(
                f"{sensor.channel}: calibrate the accelerometers anew after the reboot, as X0 has the offset, and "
                "CAL_ACC would take it off again"
            )
        else:
            notes.append(f"{sensor.channel}: the CAL_BAROn_OFF of this device is taken off besides; set it to 0")
        return notes


def _known(sensor: Calibrated, name: str, usual: int) -> int:
    """Return a number from 0 to 3 that the log of the map has said."""
    said = sensor.fitted.record.provenance.get(name, "")
    return int(said) if said in {"0", "1", "2", "3"} else usual


def _kind(sensor: Calibrated) -> Px4Sensor:
    for kind in SENSORS:
        if same_dimension(sensor.unit, kind.unit):
            return kind
    known = ", ".join(f"{kind.unit} ({kind.channel})" for kind in SENSORS)
    raise ConfigError(
        f"export px4: the map of the {sensor.channel} is in {sensor.unit or 1}, PX4 corrects sensors in {known}; give "
        "the map of one of those"
    )


def _rows(kind: Px4Sensor, instance: int, number: int, held: Px4Parameters) -> list[tuple[str, float, int]]:
    """Return name, value and type of a sensor's parameters."""
    begin = f"TC_{kind.letter}{instance}"
    ends = (("TMIN", held.T_min), ("TMAX", held.T_max), ("TREF", held.T_ref))
    rows = [(f"{begin}_ID", number, INTEGER), *((f"{begin}_{name}", float(value), REAL) for name, value in ends)]
    return rows + [
        (kind.coefficient(instance, power, axis), float(value), REAL)
        for power, values in enumerate(held.X)
        for axis, value in enumerate(values)
    ]


@hookimpl
def exporters() -> list[type[Exporter]]:
    """Register the plugin."""
    return [Px4]


INSTANCES = range(4)
AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class Px4Sensor:
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
    Px4Sensor("G", "gyro", "rad/s", 3, 3, "sensor_gyro", "device_id", "GYRO"),
    Px4Sensor("A", "accel", "m/s^2", 3, 3, "sensor_accel", "accel_device_id", "ACC"),
    Px4Sensor("B", "baro", "Pa", 5, 1, "sensor_baro", "baro_device_id", "BARO"),
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


def _calibration(values: Mapping[str, float], kind: Px4Sensor, instance: int, wanted: int | None) -> ReadBack:
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
    held = Px4Parameters(X, T_ref, low, high)
    offset, note = _offset(values, kind, ids[instance])

    def bias(T: Array) -> Array:
        return held.offset(T).astype(np.float64) + offset

    gone = missing(values, [name for row in names for name in row])
    notes = (f"{kind.channel}: device id {ids[instance]}, clamped below {low:g} and above {high:g} °C", *gone, *note)
    axes = ("x", "y", "z") if kind.axes > 1 else ("x",)
    return ReadBack(kind.channel, kind.unit, axes, (float(low), float(high)), bias, kind.order, notes)


def _offset(values: Mapping[str, float], kind: Px4Sensor, device: int) -> tuple[Array, tuple[str, ...]]:
    """Return what the constant calibration of the same device takes off besides (d,), and what to say of it."""
    slot = next((n for n in INSTANCES if integer(values, f"CAL_{kind.offset}{n}_ID") == device), None)
    names = (
        [f"CAL_{kind.offset}{slot}_{axis}OFF" for axis in AXES] if kind.axes > 1 else [f"CAL_{kind.offset}{slot}_OFF"]
    )
    offset = np.array([values.get(name, 0.0) for name in names])
    if not np.any(offset):
        return offset, ()
    return offset, (f"{kind.channel}: {', '.join(names)} are not 0, and taken off besides; so they are here",)


Single = NDArray[np.float32]

PERIOD = 1.0  # s from one look to the next
STEP = np.float32(1.0)  # K that the temperature must have moved, and more
NEVER = np.float32(-100.0)  # degC: the temperature of what was published last, where nothing was


@dataclass(frozen=True)
class Px4Parameters:
    """One sensor's thermal parameters as the firmware holds them: coefficients X (n, d), lowest power first."""

    X: Single
    T_ref: np.float32
    T_min: np.float32
    T_max: np.float32

    def offset(self, temperature: ArrayLike) -> Single:
        """Return the thermal offset (N, d) at temperatures (N,) in degC, as if each were published."""
        T = np.asarray(temperature, dtype=np.float32)
        ends = self.T_max - self.T_ref, self.T_min - self.T_ref
        d = np.where(self.T_max < T, ends[0], np.where(self.T_min > T, ends[1], T - self.T_ref))[:, None]
        found, power = self.X[0] + self.X[1] * d, d
        for X in self.X[2:]:
            power = power * d
            found = found + X * power
        return np.asarray(found, dtype=np.float32)


def published(t: ArrayLike, temperature: ArrayLike) -> Single:
    """Return the temperature (N,) whose offset is in use at times t (N,) in s, from a start at the first of them.

    Before anything is published nothing is subtracted; that is before the first look only, and left out here.
    """
    times, T = np.asarray(t, dtype=np.float64), np.asarray(temperature, dtype=np.float32)
    count = int((times[-1] - times[0]) / PERIOD + 1e-9) + 1
    looks = np.searchsorted(times, times[0] + PERIOD * np.arange(count) + 1e-9, side="right") - 1
    used, last = np.empty_like(T), NEVER
    for look, after in pairwise([*looks.tolist(), len(T)]):
        if abs(T[look] - last) > STEP:
            last = T[look]
        used[look:after] = last
    return used
