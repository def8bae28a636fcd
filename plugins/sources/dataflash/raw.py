"""Samples of a log's inertial units without what the autopilot corrected, and what there is to say of it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fusion_core.chunk import Array
from fusion_core.errors import UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash.imu import Corrections, Sensor
from fusion_plugins.sources.dataflash.log import DataFlashMessages, MessageStream

AXES: dict[Sensor, list[str]] = {"Gyr": ["GyrX", "GyrY", "GyrZ"], "Acc": ["AccX", "AccY", "AccZ"]}
NAMES: dict[Sensor, str] = {"Gyr": "gyro", "Acc": "accelerometer"}

ALL = "at the first row"
"""Where what holds for a whole log begins."""


class Raw:
    """The fields of a log's rows; axes of sensors as `compensated` says (`undo`, `refuse` or `keep`)."""

    def __init__(self, log: DataFlashMessages, compensated: str) -> None:
        self.log, self.compensated = log, compensated
        self._temperatures: dict[int, tuple[Array, Array]] = {}

    def values(self, stream: MessageStream, label: str, known: dict[str, Array]) -> Array:
        """Return a field of rows (N,); `known` keeps what was computed for all axes of these rows."""
        sensor = _sensor(label)
        if stream.unit is None or sensor is None or self.compensated == "keep":
            return stream.values(label)
        if label not in known:
            v = np.column_stack([stream.values(axis) for axis in AXES[sensor]])
            raw = self._corrections(stream, sensor).undo(v, self._temperature(stream), stream.at)
            known.update(zip(AXES[sensor], np.ascontiguousarray(raw.T), strict=True))
        return known[label]

    def check(self, fields: Iterable[tuple[MessageStream, str]], faults: Faults) -> None:
        """Say what was corrected, and refuse what cannot or shall not be undone.

        Raises
        ------
        UnreadableFile
            If the orientation is not known, the temperature of a polynomial is not logged, or a polynomial is refused.
        """
        said = set()
        for stream, label in fields:
            if stream.unit is None:
                continue
            if label in ("T", "Temp"):
                _check_temperature(stream, label, faults)
            sensor = _sensor(label)
            if sensor is not None and (sensor, stream.unit) not in said:
                said.add((sensor, stream.unit))
                self._check_corrections(stream, sensor, faults)

    def _corrections(self, stream: MessageStream, sensor: Sensor) -> Corrections:
        older = stream.message.clock == "TimeMS"
        return Corrections(self.log.parameters, sensor, self.unit(stream), older)

    def unit(self, stream: MessageStream) -> int:
        """Return the unit that rows are of: GYR and ACC behind the filters count on from the last one."""
        k, count = stream.unit or 0, len(self.log.units)
        return k - count if count and k >= count else k

    def _temperature(self, stream: MessageStream) -> Array:
        """Return the temperature (N,) in degC that the autopilot had for the rows; NaN where it logged none."""
        label = stream.message.label("T")
        if label:
            return stream.values(label)
        k = self.unit(stream)
        if k not in self._temperatures:
            self._temperatures[k] = self._logged(k)
        t, T = self._temperatures[k]
        return np.interp(stream.time(), t, T) if len(t) else np.full(len(stream.at), np.nan)

    def _logged(self, k: int) -> tuple[Array, Array]:
        """Return times in s and temperatures in degC that IMU shows for a unit, both (0,) where it shows none."""
        stream = self.log.units.get(k)
        label = stream.message.label("T") if stream else None
        if stream is None or label is None:
            return np.empty(0), np.empty(0)
        stream = self.log.sound(stream, None)
        return stream.time(), stream.values(label)

    def _check_corrections(self, stream: MessageStream, sensor: Sensor, faults: Faults) -> None:
        corrections, n = self._corrections(stream, sensor), len(stream.at)
        of = f"rows of {NAMES[sensor]} {self.unit(stream)}"
        if not self.log.parameters:
            faults.add(f"{of} in a log without parameters (PARM): what was corrected is not known", n, ALL)
            return
        unknown = corrections.unknown(stream.at)
        if unknown is not None and self.compensated != "keep":
            raise UnreadableFile(
                f"{self.log.path}: AHRS_ORIENTATION is {unknown}, a known orientation was expected; set "
                "compensated: keep under source to read the axes as they were logged"
            )
        applied, polynomial = corrections.applied(stream.at), corrections.polynomial(stream.at)
        if polynomial and self.compensated != "keep":
            self._check_polynomial(stream)
        if applied:
            done = "kept" if self.compensated == "keep" else "undone"
            faults.add(f"{of} with corrections of the autopilot {done}: {', '.join(applied)}", n, ALL)

    def _check_polynomial(self, stream: MessageStream) -> None:
        of = f"{self.log.path}: IMU {self.unit(stream)} was compensated by the autopilot (INS_TCAL)"
        if self.compensated == "refuse":
            raise UnreadableFile(
                f"{of}, raw data were expected; set compensated: undo under source, or log with INS_TCALn_ENABLE 0"
            )
        if not np.any(np.isfinite(self._temperature(stream))):
            raise UnreadableFile(
                f"{of} by a temperature that is not in the log, IMU.T was expected; add IMU to LOG_BITMASK, or set "
                "compensated: keep under source"
            )


def _sensor(label: str) -> Sensor | None:
    return next((sensor for sensor, axes in AXES.items() if label in axes), None)


def _check_temperature(stream: MessageStream, label: str, faults: Faults) -> None:
    T = stream.values(label)
    if len(T) > 1 and np.ptp(T) == 0:
        why = "it has no thermometer" if T[0] == 0 else "its thermometer stands still"
        what = f"rows of IMU {stream.unit} that all show {T[0]:.6g} °C ({why}; BARO.Temp may serve)"
        faults.add(what, len(T), ALL)
