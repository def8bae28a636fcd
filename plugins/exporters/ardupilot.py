"""ArduPilot's thermal parameters of an IMU, as the `.parm` file that MAVProxy and Mission Planner load.

A cubic about 35 degC without a constant, in 1e-6 rad/s (m/s^2) per power of a kelvin. The constant is the IMU's offset,
`INS_GYROFFS_*`, valid at the temperature `INS_GYR1_CALTEMP`: both are written for the gyro. The accelerometers' offset
is left as it is unless `accel_offsets` is set: six placements know it, one does not.

The frame is the sensor's, before `AHRS_ORIENTATION`. Source: ArduPilot, AP_InertialSensor_tempcal.cpp.

ArduPilot's names for an IMU's thermal parameters, and what a file of parameters says of it.

`INS_TCAL<n>_*` of the first three IMUs since firmware 4.1; the fourth and fifth have a group of their own, `INS4_*`.
Source: ArduPilot, AP_InertialSensor.cpp, AP_InertialSensor_Params.cpp, AP_InertialSensor_tempcal.cpp.

What ArduPilot makes of thermal parameters, to the bit: single precision, in the firmware's order of operations.

::

    p(t) = (c1 + (c2 + c3 t) t) t 1e-6
    v <- v - p(clip(T) - 35) + p(clip(T_cal) - 35) - offset

clip is to TMIN and TMAX; T_cal is the temperature at which the offset was taken (-300 where none was: that is clipped
to TMIN). So the parameters hold no constant: it is in the offset, together with its temperature.

Products and sums are rounded one by one, as C without contraction does; a compiler that fuses them differs in the last
bit. Source: ArduPilot, AP_InertialSensor_tempcal.cpp, AP_InertialSensor_Backend.cpp. (The simulator takes the middle of
the range in place of 35 degC, and does not clip: it proves nothing here.) N samples, d axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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

SWING = 10.0  # K that the firmware asks of a calibration
ROUNDED = 0.1  # K by which limits differ by rounding, and less


class Ardupilot(Cubic):
    """Thermal parameters of ArduPilot, for MAVProxy and Mission Planner."""

    suffix: ClassVar[str] = ".parm"

    kind: Literal["ardupilot"] = "ardupilot"
    imu: Annotated[int, Field(ge=1, le=5)] | None = None
    """Number of the IMU, from 1 as in INS_TCAL1. Without it, that of the log of which the map was made, else 1."""
    accel_offsets: bool = False
    """Whether the offsets of the accelerometers are written too."""

    def export(self, what: Export, path: Path) -> Loss:
        """Write the parameters of each sensor that has a map."""
        low, high = self._limits(what.mapped)
        imu = self._imu(what.mapped)
        begin = group(imu)
        rows = [(f"{begin}ENABLE", 1.0), (f"{begin}TMIN", float(low)), (f"{begin}TMAX", float(high))]
        losses: list[SensorLoss] = []
        left_out: list[str] = []
        notes = [f"parameters of {begin}* are there once {begin}ENABLE is 1: load it twice"]
        for sensor in what.mapped:
            kind = _kind(sensor)
            held, lost, lacking = self._fitted(sensor, low, high)
            rows += _coefficients(kind, imu, held)
            losses.append(lost)
            left_out += lacking
            rows += self._constant(sensor, kind, imu, held)
            notes += self._notes(sensor, kind, imu, low, high)
        loss = Loss(tuple(losses), tuple(left_out), tuple(notes))
        lines = [comment(line) for line in ("Thermal calibration of ArduPilot, by driftlab", *loss.lines())]
        lines += [f"{name} {single(value)}" for name, value in rows]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return loss

    def read(self, path: Path) -> list[ReadBack]:
        """Return the sensors of `imu` that a file's parameters correct."""
        return calibrations(path, self.imu or 1)

    def _imu(self, sensors: tuple[Calibrated, ...]) -> int:
        """Return the number that is set, else the one of the logs of which the maps were made."""
        known = {sensor.fitted.record.provenance.get("imu", "1") for sensor in sensors}
        if self.imu is not None:
            return self.imu
        if len(known) > 1:
            raise ConfigError(
                f"export ardupilot: the maps are of IMU {' and '.join(sorted(known))}, a file is for one; give "
                "--set imu=N, or the maps of one"
            )
        (number,) = known
        return int(number) if number in {"1", "2", "3", "4", "5"} else 1

    def _limits(self, sensors: tuple[Calibrated, ...]) -> tuple[np.float32, np.float32]:
        """Return TMIN and TMAX, which an IMU's sensors share, as the firmware's own tools round them."""
        low = round(max(sensor.fitted.domain[0] for sensor in sensors), 1)
        high = round(min(sensor.fitted.domain[1] for sensor in sensors), 1)
        if high - low < SWING:
            raise ConfigError(
                f"export ardupilot: the maps are for {low:g} to {high:g} °C, ArduPilot asks for {SWING:g} K and "
                "more; calibrate over a wider soak"
            )
        return np.float32(low), np.float32(high)

    def _fitted(
        self, sensor: Calibrated, low: np.float32, high: np.float32
    ) -> tuple[ArduPilotParameters, SensorLoss, tuple[str, ...]]:
        """Return what the firmware is to hold of a sensor, and what that loses."""
        at = places("ardupilot", sensor)
        reference, scale = float(T_REF), float(SCALE)
        flown = self.flown(sensor.fitted.domain)
        c = polynomial(sensor.fitted, 3, reference, flown)
        T_cal = np.clip(T_REF, low, high)  # where it can be 35 degC, nothing is added back
        stored, constant = np.zeros((3, 3), dtype=np.float32), np.zeros(3, dtype=np.float32)
        stored[:, at] = c[1:] / scale
        constant[at] = powers(np.array([T_cal], dtype=np.float64), reference, c)[0]
        held = ArduPilotParameters(stored, low, high, constant, T_cal)

        def exact(T: Array) -> Array:
            return powers(T, reference, c)

        def target(T: Array) -> Array:
            return held.bias(T)[:, at].astype(np.float64)

        def clipped(T: Array) -> Array:
            return exact(np.clip(T, low, high))

        def renewed(recording: Chunk) -> Array:
            return target(recording["temperature"])

        loss, beyond = measured(sensor, exact, clipped, target, renewed, flown)
        return held, loss, (*beyond, *uncorrected(sensor))

    def _constant(
        self, sensor: Calibrated, kind: ArduPilotSensor, imu: int, held: ArduPilotParameters
    ) -> list[tuple[str, float]]:
        if kind.short == "ACC" and not self.accel_offsets:
            return []
        rows = [(offset(kind, imu, axis), float(held.offset[axis])) for axis in places("ardupilot", sensor)]
        return [*rows, (taken_at(kind, imu), float(held.T_cal))]

    def _notes(
        self, sensor: Calibrated, kind: ArduPilotSensor, imu: int, low: np.float32, high: np.float32
    ) -> list[str]:
        at = taken_at(kind, imu)
        first, last = sensor.fitted.domain
        notes = []
        if low - first > ROUNDED or last - high > ROUNDED:
            notes.append(
                f"{sensor.channel}: gyro and accelerometer share {low:g} to {high:g} degC, less than the map's "
                f"{first:.4g} to {last:.4g}"
            )
        if kind.short == "GYR":
            return [
                *notes,
                f"{sensor.channel}: the offset and {at} are taken anew at each start while INS_GYR_CAL is 1, and the "
                "constant of the map with it; its shape is what counts then",
            ]
        if self.accel_offsets:
            return notes
        return [
            *notes,
            f"{sensor.channel}: its offset stays as it is, and is right where {at} is the temperature at which it was "
            "taken; with --set accel_offsets=true the map's constant replaces it",
        ]


def _coefficients(kind: ArduPilotSensor, imu: int, held: ArduPilotParameters) -> list[tuple[str, float]]:
    return [
        (coefficient(kind, imu, power, axis), float(value))
        for power, values in enumerate(held.c, 1)
        for axis, value in enumerate(values)
    ]


def _kind(sensor: Calibrated) -> ArduPilotSensor:
    for kind in SENSORS:
        if same_dimension(sensor.unit, kind.unit):
            return kind
    raise ConfigError(
        f"export ardupilot: the map of the {sensor.channel} is in {sensor.unit or 1}, ArduPilot corrects gyros (rad/s) "
        "and accelerometers (m/s^2); give the map of one of those"
    )


@hookimpl
def exporters() -> list[type[Exporter]]:
    """Register the plugin."""
    return [Ardupilot]


AXES = ("X", "Y", "Z")
LEARNING = 2  # of INS_TCALn_ENABLE


@dataclass(frozen=True)
class ArduPilotSensor:
    """A kind of sensor that ArduPilot corrects for temperature."""

    short: str  # in parameters' names
    channel: str
    unit: str


SENSORS = (ArduPilotSensor("GYR", "gyro", "rad/s"), ArduPilotSensor("ACC", "accel", "m/s^2"))


def group(imu: int) -> str:
    """Return how the names of an IMU's thermal parameters begin."""
    return f"INS_TCAL{imu}_" if imu <= 3 else f"INS{imu}_TCAL_"


def coefficient(kind: ArduPilotSensor, imu: int, power: int, axis: int) -> str:
    """Return the name of a coefficient's parameter."""
    return f"{group(imu)}{kind.short}{power}_{AXES[axis]}"


def offset(kind: ArduPilotSensor, imu: int, axis: int) -> str:
    """Return the name of the parameter of a constant offset."""
    number = imu if imu in (2, 3) else ""
    return f"INS{imu if imu > 3 else ''}_{kind.short}{number}OFFS_{AXES[axis]}"


def taken_at(kind: ArduPilotSensor, imu: int) -> str:
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


def _held(values: Mapping[str, float], kind: ArduPilotSensor, imu: int) -> Array:
    """Return the coefficients (3, 3) of an IMU's sensor, lowest power first."""
    return np.array([values.get(name, 0.0) for name in _file_coefficients(kind, imu)]).reshape(3, 3)


def _file_coefficients(kind: ArduPilotSensor, imu: int) -> list[str]:
    return [coefficient(kind, imu, power, axis) for power in (1, 2, 3) for axis in range(3)]


def _calibration(values: Mapping[str, float], kind: ArduPilotSensor, imu: int) -> ReadBack:
    low, high = (np.float32(values.get(f"{group(imu)}T{end}", usual)) for end, usual in (("MIN", 0.0), ("MAX", 70.0)))
    if not low < high:
        raise ConfigError(
            f"{group(imu)}TMIN {low:g} and TMAX {high:g}: expected a range; calibrate that vehicle before its "
            "parameters are read"
        )
    constant = np.array([values.get(offset(kind, imu, axis), 0.0) for axis in range(3)], dtype=np.float32)
    T_cal = np.float32(values.get(taken_at(kind, imu), UNCALIBRATED))
    held = ArduPilotParameters(_held(values, kind, imu).astype(np.float32), low, high, constant, T_cal)
    notes = [f"{kind.channel}: IMU {imu}, clamped below {low:g} and above {high:g} °C"]
    notes += missing(values, _file_coefficients(kind, imu))
    if T_cal <= UNCALIBRATED:
        notes.append(f"{kind.channel}: {taken_at(kind, imu)} is not set, the firmware takes TMIN in its place")

    def bias(T: Array) -> Array:
        return held.bias(T).astype(np.float64)

    return ReadBack(kind.channel, kind.unit, ("x", "y", "z"), (float(low), float(high)), bias, notes=tuple(notes))


Single = NDArray[np.float32]

T_REF = np.float32(35.0)  # degC
SCALE = np.float32(1e-6)  # of a stored coefficient
UNCALIBRATED = np.float32(-300.0)  # degC: T_cal before the first calibration


@dataclass(frozen=True)
class ArduPilotParameters:
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
        """Return what is taken off a sensor in all (N, d), as far as single precision can tell it at zero."""
        T = np.asarray(temperature, dtype=np.float32)
        return np.asarray(-self.corrected(np.zeros((len(T), len(self.offset)), dtype=np.float32), T), dtype=np.float32)

    def _polynomial(self, t: Single | np.float32) -> Single:
        c1, c2, c3 = self.c
        return np.asarray((c1 + (c2 + c3 * t) * t) * t * SCALE, dtype=np.float32)

    def _clipped(self, T: Single | np.float32) -> Single:
        return np.asarray(np.clip(T, self.T_min, self.T_max), dtype=np.float32)
