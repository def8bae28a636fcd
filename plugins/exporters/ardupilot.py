"""ArduPilot's thermal parameters of an IMU, as the `.parm` file that MAVProxy and Mission Planner load.

A cubic about 35 degC without a constant, in 1e-6 rad/s (m/s^2) per power of a kelvin. The constant is the IMU's offset,
`INS_GYROFFS_*`, valid at the temperature `INS_GYR1_CALTEMP`: both are written for the gyro. The accelerometers' offset
is left as it is unless `accel_offsets` is set: six placements know it, one does not.

The frame is the sensor's, before `AHRS_ORIENTATION`. Source: ArduPilot, AP_InertialSensor_tempcal.cpp.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Calibrated, Export, Exporter, Loss, ReadBack, SensorLoss
from fusion_core.errors import ConfigError
from fusion_core.escaping import comment
from fusion_core.hookspecs import hookimpl
from fusion_core.units import same_dimension
from fusion_plugins.exporters.ardupilot_arithmetic import SCALE, T_REF, Calibration
from fusion_plugins.exporters.ardupilot_file import SENSORS, Kind, calibrations, coefficient, group, offset, taken_at
from fusion_plugins.exporters.cubic import Cubic, measured, places, polynomial, powers, uncorrected
from fusion_plugins.exporters.parameters import single

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
    ) -> tuple[Calibration, SensorLoss, tuple[str, ...]]:
        """Return what the firmware is to hold of a sensor, and what that loses."""
        at = places("ardupilot", sensor)
        reference, scale = float(T_REF), float(SCALE)
        flown = self.flown(sensor.fitted.domain)
        c = polynomial(sensor.fitted, 3, reference, flown)
        T_cal = np.clip(T_REF, low, high)  # where it can be 35 degC, nothing is added back
        stored, constant = np.zeros((3, 3), dtype=np.float32), np.zeros(3, dtype=np.float32)
        stored[:, at] = c[1:] / scale
        constant[at] = powers(np.array([T_cal], dtype=np.float64), reference, c)[0]
        held = Calibration(stored, low, high, constant, T_cal)

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

    def _constant(self, sensor: Calibrated, kind: Kind, imu: int, held: Calibration) -> list[tuple[str, float]]:
        if kind.short == "ACC" and not self.accel_offsets:
            return []
        rows = [(offset(kind, imu, axis), float(held.offset[axis])) for axis in places("ardupilot", sensor)]
        return [*rows, (taken_at(kind, imu), float(held.T_cal))]

    def _notes(self, sensor: Calibrated, kind: Kind, imu: int, low: np.float32, high: np.float32) -> list[str]:
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


def _coefficients(kind: Kind, imu: int, held: Calibration) -> list[tuple[str, float]]:
    return [
        (coefficient(kind, imu, power, axis), float(value))
        for power, values in enumerate(held.c, 1)
        for axis, value in enumerate(values)
    ]


def _kind(sensor: Calibrated) -> Kind:
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
