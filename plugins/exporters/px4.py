"""PX4's thermal parameters, as the `.params` file that QGroundControl loads.

`TC_G<n>_*` of a gyro (rad/s), `TC_A<n>_*` of an accelerometer (m/s^2), `TC_M<n>_*` of a magnetometer (gauss), all
cubics on three axes, and `TC_B<n>_*` of a barometer (Pa), of fifth order. A sensor is corrected only where `TC_?<n>_ID`
is its device id: nothing says so in flight where it is not. X0 is subtracted *besides* the offset in
`CAL_GYRO<n>_?OFF`, which is therefore set to zero. Readings of an accelerometer less all this are multiplied by
`CAL_ACC<n>_?SCALE`, those of a gyro are not. The firmware computes in single precision, in this order of operations::

    d = clip(T, TMIN, TMAX) - TREF
    three axes:  X0 + X1 d + X2 d2 + X3 d3,    d2 = d d,  d3 = d2 d
    barometer:   the same to X5, the power multiplied up as it goes

The correction of the sensor is not this, but the one that was last *published*: a module looks once a second, and
publishes the corrections of all sensors when the temperature of one has moved by more than 1 K since that one last made
it publish. So the correction runs in stairs, which are finer the more sensors of different temperatures there are.

Products and sums are rounded one by one, as C without contraction does; a compiler that fuses them differs in the last
bit. Sources: PX4-Autopilot, src/modules/temperature_compensation: TemperatureCompensation.cpp,
TemperatureCompensationModule.cpp; src/lib/sensor_calibration/Gyroscope.hpp and Accelerometer.hpp; QGroundControl,
ParameterManager (the vehicle's system id must be that of each line). N samples, n coefficients, d axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Calibrated, ReadBack, warm_up
from fusion_core.errors import ConfigError
from fusion_core.hookspecs import hookimpl
from fusion_plugins.exporters import autopilot
from fusion_plugins.exporters.autopilot import Autopilot, Corrections, FirmwareSensor, Parameter, Single

INTEGER, REAL = 6, 9  # MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32
DeviceId = Annotated[int, Field(gt=0, lt=2**31)]
Number = Annotated[int, Field(ge=0, le=3)]  # in the parameters' names
INSTANCES = range(4)
PERIOD = 1.0  # s from one look to the next
STEP = np.float32(1.0)  # K that the temperature must have moved, and more
GAUSS = 1e-4  # T
ATMOSPHERE = 1e4  # Pa: a constant that is larger is no offset of a barometer
NEVER = np.float32(-100.0)  # degC: the temperature of what was published last, where nothing was


@dataclass(frozen=True)
class Px4Sensor(FirmwareSensor):
    """A kind of sensor that PX4 corrects for temperature."""

    topic: str = ""
    setting: str = "device_id"
    calibration: str = ""  # CAL_<calibration><n>_ID

    def coefficient(self, instance: int, power: int, axis: int) -> str:
        """Return the name of a coefficient's parameter."""
        return f"TC_{self.short}{instance}_X{power}" + (f"_{axis}" if len(self.axes) > 1 else "")


SENSORS = (
    Px4Sensor("G", "gyro", "rad/s", topic="sensor_gyro", calibration="GYRO"),
    Px4Sensor("A", "accel", "m/s^2", scaled=True, topic="sensor_accel", setting="accel_device_id", calibration="ACC"),
    Px4Sensor("M", "mag", "T", size=GAUSS, topic="sensor_mag", setting="mag_device_id", calibration="MAG"),
    Px4Sensor("B", "baro", "Pa", 5, ("",), topic="sensor_baro", setting="baro_device_id", calibration="BARO"),
)
CORRECTED = "PX4 corrects sensors in " + ", ".join(f"{kind.unit} ({kind.channel})" for kind in SENSORS)


@dataclass(frozen=True)
class Px4Parameters(autopilot.Firmware):
    """One sensor's thermal parameters as the firmware holds them: coefficients X (n, d), lowest power first."""

    X: Single
    T_ref: np.float32
    T_min: np.float32
    T_max: np.float32

    def bias(self, temperature: ArrayLike) -> Single:
        """Return the thermal offset (N, d) at temperatures (N,) in degC, as if each were published."""
        T = np.asarray(temperature, dtype=np.float32)
        ends = self.T_max - self.T_ref, self.T_min - self.T_ref
        d = np.where(self.T_max < T, ends[0], np.where(self.T_min > T, ends[1], T - self.T_ref))[:, None]
        offset, power = self.X[0] + self.X[1] * d, d
        for X in self.X[2:]:
            power = power * d
            offset = offset + X * power
        return np.asarray(offset, dtype=np.float32)


@hookimpl
class Px4(Autopilot):
    """Thermal parameters of PX4, for QGroundControl."""

    suffix: ClassVar[str] = ".params"
    title: ClassVar[str] = "PX4"
    heading: ClassVar[tuple[str, ...]] = ("Vehicle-Id Component-Id Name Value Type",)

    kind: Literal["px4"] = "px4"
    device_id: DeviceId | None = None
    """`device_id` of the gyro, as in `sensor_gyro` of a log. Without it, that of the log of which the map was made."""
    accel_device_id: DeviceId | None = None
    """The same of the accelerometer."""
    mag_device_id: DeviceId | None = None
    """The same of the magnetometer."""
    baro_device_id: DeviceId | None = None
    """The same of the barometer."""
    instance: Number | None = None
    """Number in the parameters' names. Without it, that of the sensor in the log of which the map was made, else 0."""
    calibration: Number | None = None
    """The n of the CAL_GYROn_ID that is the gyro's. Without it, that of the log, else as `instance`."""
    accel_calibration: Number | None = None
    """The same of the CAL_ACCn_ID, for the scale factors of the accelerometer."""
    system: Annotated[int, Field(ge=1, le=255)] = 1
    """The vehicle's MAV_SYS_ID."""

    def corrections(self, sensor: Calibrated, sensors: tuple[Calibrated, ...]) -> Corrections:
        """Return the polynomial of a sensor, and of a gyro the constant offset that is zero beside it."""
        kind = autopilot.kind_of(SENSORS, sensor, self.kind, CORRECTED)
        device = self._device(sensor, kind)
        low, high = (np.float32(end) for end in sensor.fitted.domain)
        T_ref = np.float32((low + high) / 2)

        def hold(c: Array) -> Px4Parameters:
            return Px4Parameters(c.astype(np.float32), T_ref, low, high)

        def in_use(recording: Chunk) -> Array:
            others = [warm_up(one.fitted.domain)["temperature"] for one in sensors]
            return published(recording.t, recording["temperature"], others).astype(np.float64)

        held, loss, left_out = self.fit(sensor, kind, float(T_ref), hold, in_use=in_use)
        if kind.short == "B" and abs(held.X[0, 0]) > ATMOSPHERE:
            raise ConfigError(
                f"export px4: the map of the {sensor.channel} is {held.X[0, 0]:.6g} Pa at {T_ref:.4g} °C, the pressure "
                "of the air and no offset; fit it with `reference`, that of another barometer or a constant"
            )
        parameters, notes = self._parameters(sensor, kind, device, held)
        return Corrections(parameters, loss, left_out, notes)

    def _parameters(
        self, sensor: Calibrated, kind: Px4Sensor, device: int, held: Px4Parameters
    ) -> tuple[list[Parameter], list[str]]:
        """Return the parameters of a sensor, and notes on them."""
        instance = _log_number(sensor, "instance", 0) if self.instance is None else self.instance
        given = self.accel_calibration if kind.short == "A" else self.calibration
        slot = _log_number(sensor, "calibration", instance) if given is None else given
        begin = f"TC_{kind.short}{instance}"
        values = {f"{begin}_TMIN": held.T_min, f"{begin}_TMAX": held.T_max, f"{begin}_TREF": held.T_ref}
        values |= {kind.coefficient(instance, *at): value for at, value in np.ndenumerate(held.X)}
        if kind.short == "G":
            values |= {f"CAL_GYRO{slot}_{axis.upper()}OFF": np.float32(0.0) for axis in sensor.axes}
        if (scale := self.scale(sensor, kind)) is not None:
            begin_cal = f"CAL_{kind.calibration}{slot}"
            values |= {f"{begin_cal}_{axis.upper()}OFF": np.float32(0.0) for axis in kind.axes}
            values |= {f"{begin_cal}_{axis.upper()}SCALE": value for axis, value in zip(kind.axes, scale, strict=True)}
        parameters = [
            Parameter(f"TC_{kind.short}_ENABLE", 1, whole=True),
            Parameter(f"{begin}_ID", device, whole=True),
            *(Parameter(name, float(value)) for name, value in values.items()),
        ]
        return parameters, _notes(sensor, kind, device, slot)

    def written(self, parameter: Parameter) -> str:
        """Return the five columns of QGroundControl."""
        name, value, whole = parameter
        text, number = (str(int(value)), INTEGER) if whole else (autopilot.single(value), REAL)
        return f"{self.system}\t1\t{name}\t{text}\t{number}"

    def read(self, path: Path) -> list[ReadBack]:
        """Return the sensors that a file's parameters correct: of `device_id` where it is given, else of `instance`.

        Raises
        ------
        UnreadableFile
            If it is no parameter file.
        ConfigError
            If there is no calibration in use, or none of a device that is wanted.
        """
        values = autopilot.read_parameters(path)
        calibrations, why = [], []
        for kind in SENSORS:
            device = getattr(self, kind.setting)
            try:
                calibrations.append(_calibration(values, kind, self.instance or 0, device))
            except _UnusedSensor as error:
                if device is not None:
                    raise ConfigError(f"{path}: {error}; name a device of this vehicle") from None
                why.append(str(error))
        if not calibrations:
            raise ConfigError(
                f"{path}: corrects nothing for temperature ({', '.join(why)}); give all parameters of a vehicle that "
                "is calibrated, and its --set instance=N"
            )
        return calibrations

    def _device(self, sensor: Calibrated, kind: Px4Sensor) -> int:
        given: int | None = getattr(self, kind.setting)
        logged = sensor.fitted.record.provenance.get("device_id", "")
        if given is not None:
            return given
        if logged.isascii() and logged.isdigit() and int(logged) > 0:
            return int(logged)
        raise ConfigError(
            f"export px4: the device id of the {sensor.channel} is not known, and PX4 would use nothing of the file "
            f"without it; give --set {kind.setting}=N with the device_id that {kind.topic} has in the vehicle's log"
        )


def _notes(sensor: Calibrated, kind: Px4Sensor, device: int, slot: int) -> list[str]:
    zero = ", ".join(f"_{axis.upper()}OFF" for axis in sensor.axes)
    besides = {
        "G": f"CAL_GYRO{slot}{zero} are set to 0, as X0 has the offset; where not CAL_GYRO{slot}_ID but another "
        f"CAL_GYROn_ID is {device}, give --set calibration=n",
        "A": f"CAL_ACC{slot}{zero} are set to 0, as X0 has the offset, and _XSCALE to _ZSCALE hold its scale factors "
        f"at one value; where not CAL_ACC{slot}_ID but another CAL_ACCn_ID is {device}, give --set accel_calibration=n"
        if sensor.matrix is not None
        else "calibrate the accelerometers anew after the reboot, as X0 has the offset, and CAL_ACC would take it off "
        "again",
        "M": "calibrate the compass anew after the reboot; firmware that has no TC_M_ENABLE ignores these",
        "B": "the CAL_BAROn_OFF of this device is taken off besides; set it to 0",
    }
    used = f"used for the device id {device} alone; reboot after loading"
    return [f"{sensor.channel}: {note}" for note in (used, besides[kind.short])]


def _log_number(sensor: Calibrated, name: str, default: int) -> int:
    """Return a number from 0 to 3 from the log of which the map was made."""
    logged = sensor.fitted.record.provenance.get(name, "")
    return int(logged) if logged in {"0", "1", "2", "3"} else default


class _UnusedSensor(Exception):
    """The reason why a kind of sensor is not corrected."""


def _calibration(values: Mapping[str, float], kind: Px4Sensor, instance: int, wanted: int | None) -> ReadBack:
    begin = f"TC_{kind.short}"
    ids = {n: device for n in INSTANCES if (device := autopilot.integer(values, f"{begin}{n}_ID"))}
    named = ", ".join(f"{begin}{n}_ID {device}" for n, device in ids.items())
    if not autopilot.integer(values, f"{begin}_ENABLE"):
        raise _UnusedSensor(f"{begin}_ENABLE is {'0' if f'{begin}_ENABLE' in values else 'missing'}")
    if wanted is not None:
        instance = next((n for n, device in ids.items() if device == wanted), -1)
    if instance not in ids:
        beside = f" beside {named}" if named else ""
        raise _UnusedSensor(f"{kind.channel} {wanted or instance} has no {begin}n_ID{beside}")
    shape = (kind.order + 1, len(kind.axes))
    names = [kind.coefficient(instance, *at) for at in np.ndindex(shape)]
    X = np.array([values.get(name, 0.0) for name in names], dtype=np.float32).reshape(shape)
    T_ref, low, high = (np.float32(values.get(f"{begin}{instance}_{end}", np.nan)) for end in ("TREF", "TMIN", "TMAX"))
    if not np.any(X):
        raise _UnusedSensor(f"{begin}{instance}_X0 to _X{kind.order} are all 0 or missing")
    if not (low < high and np.isfinite(T_ref)):
        raise _UnusedSensor(f"{begin}{instance}_TMIN {low:g}, _TMAX {high:g}, _TREF {T_ref:g} are no range")
    offset, scale, note = _calibrated(values, kind, ids[instance])
    notes = [*autopilot.missing(values, names), *note]
    whose, slot = f"device id {ids[instance]}", _slot(values, kind, ids[instance])
    about = {"device_id": str(ids[instance]), "instance": str(instance)}
    about |= {} if slot is None else {"calibration": str(slot)}
    return autopilot.read_back(kind, Px4Parameters(X, T_ref, low, high), whose, notes, about, offset, scale)


def _slot(values: Mapping[str, float], kind: Px4Sensor, device: int) -> int | None:
    """Return the n of the CAL_GYROn_ID that is the device's."""
    slots = (n for n in INSTANCES if autopilot.integer(values, f"CAL_{kind.calibration}{n}_ID") == device)
    return next(slots, None)


def _calibrated(values: Mapping[str, float], kind: Px4Sensor, device: int) -> tuple[Array, Array | None, list[str]]:
    """Return the constant calibration of the same device: offset (d,), scale (d,) where it has one, and a note."""
    begin = f"CAL_{kind.calibration}{_slot(values, kind, device)}"
    names = [f"{begin}_{axis.upper()}OFF" for axis in kind.axes]
    offset = np.array([values.get(name, 0.0) for name in names])
    text = f"{kind.channel}: {', '.join(names)} are not 0, and taken off besides; so they are here"
    scales = (values.get(f"{begin}_{axis.upper()}SCALE", 1.0) for axis in kind.axes)
    return offset, np.array(list(scales)) if kind.scaled else None, [text] if np.any(offset) else []


def published(t: ArrayLike, temperature: ArrayLike, others: Sequence[ArrayLike] = ()) -> Single:
    """Return the temperature (N,) whose offset is in use at times t (N,) in s, from a start at the first of them.

    Before anything is published nothing is subtracted; that is before the first look only, and left out here.
    `others` are the temperatures (N,) of all sensors that are corrected, with which this one's is published.
    """
    times, T = np.asarray(t, dtype=np.float64), np.asarray(temperature, dtype=np.float32)
    of_all = np.stack([T, *(np.asarray(other, dtype=np.float32) for other in others)])
    count = int((times[-1] - times[0]) / PERIOD + 1e-9) + 1
    looks = np.searchsorted(times, times[0] + PERIOD * np.arange(count) + 1e-9, side="right") - 1
    used, own, last = np.empty_like(T), NEVER, np.full(len(of_all), NEVER)
    for look, after in pairwise([*looks.tolist(), len(T)]):
        moved = np.abs(of_all[:, look] - last) > STEP
        last[moved] = of_all[moved, look]
        own = T[look] if np.any(moved) else own
        used[look:after] = own
    return used
