"""ArduPilot's thermal parameters of IMUs and a barometer, as the `.parm` file that MAVProxy and Mission Planner load.

A cubic about 35 degC without a constant, in 1e-6 rad/s (m/s^2) per power of a kelvin. The constant is the IMU's offset,
`INS_GYROFFS_*`, valid at the temperature `INS_GYR1_CALTEMP`: both are written for the gyro. The accelerometers' offset
is left as it is unless `accel_offsets` is set: six placements know it, one does not. The frame is the sensor's, before
`AHRS_ORIENTATION`. The firmware computes in single precision, in this order of operations::

    p(t) = (c1 + (c2 + c3 t) t) t 1e-6
    v <- v - p(clip(T) - 35) + p(clip(T_cal) - 35) - offset
    v <- v scale                                                  of accelerometers, `INS_ACCSCAL_*`

clip is to TMIN and TMAX; T_cal is the temperature at which the offset was taken (-300 where none was: that is clipped
to TMIN). So the parameters hold no constant: it is in the offset, together with its temperature.

Products and sums are rounded one by one, as C without contraction does; a compiler that fuses them differs in the last
bit. Source: ArduPilot, AP_InertialSensor_tempcal.cpp, AP_InertialSensor_Backend.cpp. (The simulator takes the middle of
the range in place of 35 degC, and does not clip: it proves nothing here.) Of a barometer: `ardupilot_barometer`; of
compasses it has none. N samples, d axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, ReadBack
from fusion_core.errors import ConfigError
from fusion_core.hookspecs import hookimpl
from fusion_core.units import same_dimension
from fusion_plugins.ardupilot_names import ParameterNames, of_axes, thermal_group
from fusion_plugins.exporters import ardupilot_barometer, autopilot
from fusion_plugins.exporters.autopilot import Autopilot, Corrections, FirmwareSensor, Parameter, Single

SWING = 10.0  # K that the firmware asks of a calibration
ROUNDED = 0.1  # K by which limits differ by rounding, and less
LEARNING = 2  # of INS_TCALn_ENABLE
SENSORS = (FirmwareSensor("GYR", "gyro", "rad/s"), FirmwareSensor("ACC", "accel", "m/s^2", scaled=True))
KINDS = (*SENSORS, ardupilot_barometer.KIND)
CORRECTED = "ArduPilot corrects gyros (rad/s), accelerometers (m/s^2) and its first barometer (Pa)"
T_REF = np.float32(35.0)  # degC
SCALE = np.float32(1e-6)  # of a stored coefficient
UNCALIBRATED = np.float32(-300.0)  # degC: T_cal before the first calibration


@dataclass(frozen=True)
class ArduPilotParameters(autopilot.Firmware):
    """One sensor's thermal parameters as the firmware holds them: coefficients c (3, d) in 1e-6 unit/K^i."""

    c: Single
    T_min: np.float32
    T_max: np.float32
    offset: Single  # (d,)
    T_cal: np.float32

    def corrected(self, value: ArrayLike, temperature: ArrayLike) -> Single:
        """Return sensor values (N, d) at temperatures (N,) in degC after the firmware's correction."""
        v, T = np.asarray(value, dtype=np.float32), np.asarray(temperature, dtype=np.float32)
        v = v - self._polynomial(self._clipped(T)[:, None] - T_REF)
        v = v + self._polynomial(self._clipped(self.T_cal) - T_REF)
        return np.asarray(v - self.offset, dtype=np.float32)

    def bias(self, temperature: ArrayLike) -> Single:
        """Return the whole correction of a sensor (N, d), as far as single precision can tell it at zero."""
        T = np.asarray(temperature, dtype=np.float32)
        return np.asarray(-self.corrected(np.zeros((len(T), len(self.offset)), dtype=np.float32), T), dtype=np.float32)

    def _polynomial(self, t: Single | np.float32) -> Single:
        c1, c2, c3 = self.c
        return np.asarray((c1 + (c2 + c3 * t) * t) * t * SCALE, dtype=np.float32)

    def _clipped(self, T: Single | np.float32) -> Single:
        return np.asarray(np.clip(T, self.T_min, self.T_max), dtype=np.float32)


@hookimpl
class Ardupilot(Autopilot):
    """Thermal parameters of ArduPilot, for MAVProxy and Mission Planner."""

    suffix: ClassVar[str] = ".parm"
    title: ClassVar[str] = "ArduPilot"

    kind: Literal["ardupilot"] = "ardupilot"
    imu: Annotated[int, Field(ge=1, le=5)] | None = None
    """Number of the IMU, from 1 as in INS_TCAL1. Without it, that of the log of which the map was made, else 1."""
    accel_offsets: bool = False
    """True if the offsets of the accelerometers are written too."""

    def shared(self, sensors: tuple[Calibrated, ...]) -> tuple[list[Parameter], list[str]]:
        """Return the switch and the limits of temperature of each IMU, which its sensors share."""
        parameters, notes = list[Parameter](), list[str]()
        sensors = tuple(one for one in sensors if not same_dimension(one.unit, ardupilot_barometer.KIND.unit))
        for imu in dict.fromkeys(map(self._imu, sensors)):
            low, high = _limits(self._of(imu, sensors))
            begin = thermal_group(imu)
            values = {"ENABLE": 1.0, "TMIN": float(low), "TMAX": float(high)}
            parameters += [Parameter(f"{begin}_{name}", value) for name, value in values.items()]
            notes.append(f"parameters of {begin}_* are there once {begin}_ENABLE is 1: load it twice")
        return parameters, notes

    def corrections(self, sensor: Calibrated, sensors: tuple[Calibrated, ...]) -> Corrections:
        """Return the coefficients of a sensor, and its offset with its temperature where they are to be written."""
        kind = autopilot.kind_of(KINDS, sensor, self.kind, CORRECTED)
        if kind is ardupilot_barometer.KIND:
            return ardupilot_barometer.corrections(sensor)
        imu = self._imu(sensor)
        low, high = _limits(self._of(imu, sensors))
        names = ParameterNames(kind.short, imu)
        T_cal = np.clip(T_REF, low, high)  # where it can be 35 degC, nothing is added back
        reference, scale = float(T_REF), float(SCALE)

        def hold(c: Array) -> ArduPilotParameters:
            stored = (c[1:] / scale).astype(np.float32)
            constant = autopilot.powers(np.array([T_cal], dtype=np.float64), reference, c)[0].astype(np.float32)
            return ArduPilotParameters(stored, low, high, constant, T_cal)

        held, loss, left_out = self.fit(sensor, kind, reference, hold, (low, high))
        values = dict(zip(_coefficients(names), held.c.ravel(), strict=True))
        if kind.short == "GYR" or self.accel_offsets:
            at = autopilot.places(self.kind, sensor)
            values |= {of_axes(names.offset)[axis]: held.offset[axis] for axis in at}
            values[names.caltemp] = held.T_cal
        if (factors := self.scale(sensor, kind)) is not None:
            values |= dict(zip(of_axes(names.scale), factors, strict=True))
        parameters = [Parameter(name, float(value)) for name, value in values.items()]
        return Corrections(parameters, loss, left_out, self._notes(sensor, names, low, high))

    def written(self, parameter: Parameter) -> str:
        """Return name and value."""
        return f"{parameter.name} {autopilot.single(parameter.value)}"

    def read(self, path: Path) -> list[ReadBack]:
        """Return the sensors of `imu`, and the barometer, that a file's parameters correct.

        Raises
        ------
        UnreadableFile
            If it is no parameter file.
        ConfigError
            If there is no calibration in use.
        """
        values, imu = autopilot.read_parameters(path), self.imu or 1
        begin = thermal_group(imu)
        enabled = autopilot.integer(values, f"{begin}_ENABLE")
        read = [_calibration(values, kind, imu) for kind in SENSORS] if enabled == 1 else []
        read.append(ardupilot_barometer.calibration(values))
        calibrations = [calibration for calibration in read if calibration is not None]
        if calibrations:
            return calibrations
        others = [n for n in range(1, 6) if n != imu and autopilot.integer(values, f"{thermal_group(n)}_ENABLE") == 1]
        why = f"{begin}_ENABLE is {enabled if f'{begin}_ENABLE' in values else 'missing'}"
        if enabled == 1:
            why = f"{begin}_GYR1 to 3 and ACC1 to 3 are all 0 or missing"
        elif enabled == LEARNING:
            why += ", it is being learned"
        beside = f", and IMU {', '.join(map(str, others))} is corrected" if others else ""
        raise ConfigError(
            f"{path}: IMU {imu} is not corrected for temperature ({why}{beside}); give all parameters of a vehicle "
            "that is calibrated, and its --set imu=N"
        )

    def _imu(self, sensor: Calibrated) -> int:
        """Return the number that is set, else the one of the log of which the map was made."""
        if self.imu is not None:
            return self.imu
        number = sensor.fitted.record.provenance.get("imu", "1")
        return int(number) if number in {"1", "2", "3", "4", "5"} else 1

    def _of(self, imu: int, sensors: tuple[Calibrated, ...]) -> tuple[Calibrated, ...]:
        """Return the sensors of an IMU."""
        ours = (sensor for sensor in sensors if not same_dimension(sensor.unit, ardupilot_barometer.KIND.unit))
        return tuple(sensor for sensor in ours if self._imu(sensor) == imu)

    def _notes(self, sensor: Calibrated, names: ParameterNames, low: np.float32, high: np.float32) -> list[str]:
        first, last = sensor.fitted.domain
        notes = []
        if low - first > ROUNDED or last - high > ROUNDED:
            notes.append(
                f"{sensor.channel}: gyro and accelerometer share {low:g} to {high:g} degC, less than the map's "
                f"{first:.4g} to {last:.4g}"
            )
        if names.part == "GYR":
            notes.append(
                f"{sensor.channel}: the offset and {names.caltemp} are taken anew at each start while INS_GYR_CAL is "
                "1, and the constant of the map with it; its shape is what counts then"
            )
        elif not self.accel_offsets:
            notes.append(
                f"{sensor.channel}: its offset stays as it is, and is right where {names.caltemp} is the temperature "
                "at which it was taken; with --set accel_offsets=true the map's constant replaces it"
            )
        if names.part == "ACC" and sensor.matrix is not None:
            notes.append(
                f"{sensor.channel}: {names.scale}_X to _Z hold its scale factors at one value; a calibration on six "
                "faces replaces them"
            )
        return notes


def _limits(sensors: tuple[Calibrated, ...]) -> tuple[np.float32, np.float32]:
    """Return TMIN and TMAX of an IMU's sensors, as the firmware's own tools round them."""
    low = round(max(sensor.fitted.domain[0] for sensor in sensors), 1)
    high = round(min(sensor.fitted.domain[1] for sensor in sensors), 1)
    if high - low < SWING:
        raise ConfigError(
            f"export ardupilot: the maps are for {low:g} to {high:g} °C, ArduPilot asks for {SWING:g} K and "
            "more; calibrate over a wider soak"
        )
    return np.float32(low), np.float32(high)


def _coefficients(names: ParameterNames) -> list[str]:
    return [name for vector in names.coefficients for name in of_axes(vector)]


def _calibration(values: Mapping[str, float], kind: FirmwareSensor, imu: int) -> ReadBack | None:
    """Return the calibration of an IMU's sensor, None where its coefficients are all 0 or missing."""
    names = ParameterNames(kind.short, imu)
    c = np.array([values.get(name, 0.0) for name in _coefficients(names)]).reshape(3, 3)
    if not c.any():
        return None
    low, high = (np.float32(values.get(f"{names.group}_T{end}", v)) for end, v in (("MIN", 0.0), ("MAX", 70.0)))
    if not low < high:
        raise ConfigError(
            f"{names.group}_TMIN {low:g} and TMAX {high:g}: expected a range; calibrate that vehicle before its "
            "parameters are read"
        )
    constant = np.array([values.get(name, 0.0) for name in of_axes(names.offset)], dtype=np.float32)
    T_cal = np.float32(values.get(names.caltemp, UNCALIBRATED))
    held = ArduPilotParameters(c.astype(np.float32), low, high, constant, T_cal)
    notes = [*autopilot.missing(values, _coefficients(names))]
    if T_cal <= UNCALIBRATED:
        notes.append(f"{kind.channel}: {names.caltemp} is not set, the firmware takes TMIN in its place")
    scale = np.array([values.get(name, 1.0) for name in of_axes(names.scale)]) if kind.scaled else None
    return autopilot.read_back(kind, held, f"IMU {imu}", notes, {"imu": str(imu)}, scale=scale)
