"""PX4's thermal parameters, as the `.params` file that QGroundControl loads.

`TC_G<n>_*` of a gyro (rad/s), `TC_A<n>_*` of an accelerometer (m/s^2), both cubics on three axes, and `TC_B<n>_*` of a
barometer (Pa), of fifth order. A sensor is corrected only where `TC_?<n>_ID` is its device id: nothing says so in
flight where it is not. X0 is subtracted *besides* the offset in `CAL_GYRO<n>_?OFF`, which is therefore set to zero.

Sources: PX4-Autopilot, src/modules/temperature_compensation, src/lib/sensor_calibration/Gyroscope.hpp; QGroundControl,
ParameterManager (the vehicle's system id must be that of each line).
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
from fusion_plugins.exporters.cubic import Cubic, measured, places, polynomial, powers, uncorrected
from fusion_plugins.exporters.parameters import single
from fusion_plugins.exporters.px4_arithmetic import Calibration, published
from fusion_plugins.exporters.px4_file import SENSORS, Kind, calibrations

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

    def _fitted(self, sensor: Calibrated, kind: Kind) -> tuple[Calibration, SensorLoss, tuple[str, ...]]:
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
        calibration = Calibration(X, T_ref, low, high)

        def exact(T: Array) -> Array:
            return powers(T, float(T_ref), c)

        def target(T: Array) -> Array:
            return calibration.offset(T)[:, at].astype(np.float64)

        def renewed(recording: Chunk) -> Array:
            return target(published(recording.t, recording["temperature"]).astype(np.float64))

        loss, beyond = measured(sensor, exact, exact, target, renewed, flown)
        return calibration, loss, (*beyond, *(uncorrected(sensor) if kind.axes > 1 else ()))

    def _notes(self, sensor: Calibrated, kind: Kind, number: int) -> list[str]:
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


def _kind(sensor: Calibrated) -> Kind:
    for kind in SENSORS:
        if same_dimension(sensor.unit, kind.unit):
            return kind
    known = ", ".join(f"{kind.unit} ({kind.channel})" for kind in SENSORS)
    raise ConfigError(
        f"export px4: the map of the {sensor.channel} is in {sensor.unit or 1}, PX4 corrects sensors in {known}; give "
        "the map of one of those"
    )


def _rows(kind: Kind, instance: int, number: int, held: Calibration) -> list[tuple[str, float, int]]:
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
