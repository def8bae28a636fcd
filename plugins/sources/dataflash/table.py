"""The messages of an ArduPilot log as columns: the rows are those of one message, the others are joined to them.

Axes of inertial units come without what the autopilot corrected (`imu`), where `compensated` says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Block, Table
from fusion_core.errors import BadValue, MissingChannel, UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash.imu import ImuCorrections, Sensor
from fusion_plugins.sources.dataflash.log import DataFlashMessages, MessageStream
from fusion_plugins.sources.dataflash.scan import CLOCKS, DESCRIPTIONS, INERTIAL
from fusion_plugins.sources.joining import joined, taken_apart

AXES: dict[Sensor, list[str]] = {"Gyr": ["GyrX", "GyrY", "GyrZ"], "Acc": ["AccX", "AccY", "AccZ"]}
SENSORS: dict[str, Sensor] = {axis: sensor for sensor, axes in AXES.items() for axis in axes}
NAMES: dict[Sensor, str] = {"Gyr": "gyro", "Acc": "accelerometer"}
AT_FIRST = "at the first row"  # where faults of a whole log begin
Field = tuple[MessageStream, str]  # rows of a message, and one of its fields


class Messages(Table):
    """The messages of an open log, joined to the rows of one of them."""

    noun: ClassVar[str] = "message field"

    def __init__(self, log: DataFlashMessages, imu: int, compensated: str, faults: Faults, of_rows: str) -> None:
        self.log, self.imu, self.faults, self._of_rows = log, imu, faults, of_rows
        self.raw = RawSamples(log, compensated)
        self._streams: dict[tuple[str, int | None], MessageStream | None] = {}

    @property
    def names(self) -> Sequence[str]:
        """Every field that is a number, of messages with rows; those of inertial units first."""
        messages = sorted(self.log.messages.items(), key=lambda item: not item[0].startswith(INERTIAL))
        return [
            f"{name}.{label}"
            for name, message in messages
            if self.log.counts[message.type] and name not in DESCRIPTIONS
            for label in message.numbers
        ]

    def has(self, path: str) -> bool:
        """Return True if the log has this field; raises MissingChannel where it has not its message or unit."""
        return self._find(path) is not None

    def unit(self, path: str) -> str | None:
        """Return the unit by the log's FMTU, or by the field's name in logs that have none."""
        field = self._find(path)
        return None if field is None else field[0].message.units.get(field[1])

    def about(self, path: str) -> Mapping[str, str]:
        """Return the number of the inertial unit that a path is of, counted from 1 as in INS_TCAL1."""
        field = self._find(path)
        return {} if field is None or field[0].unit is None else {"imu": str(self.raw.unit(field[0]) + 1)}

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of `size` rows of the message that gives the time."""
        leading = self._find(self._of_rows)
        if leading is None:
            raise MissingChannel(f"{self.log.path}: has no message field '{self._of_rows}'; correct the path")
        clock = leading[1] if leading[1] in CLOCKS else None
        rows = self.log.sound(leading[0], self.faults, clock)
        fields = {path: self._field(path) for path in paths}
        self.raw.check(fields.values(), self.faults)
        self._note_units(leading[0])
        columns: dict[str, Array] = {}
        others = {id(stream): stream for stream, _ in fields.values() if stream is not leading[0]}
        t = rows.time(clock) if others else np.empty(0)
        for stream in others.values():
            columns |= self._joined(
                stream, {path: label for path, (s, label) in fields.items() if s is stream}, t, clock
            )
        for start in range(0, len(rows.at), size):
            part = replace(rows, at=rows.at[start : start + size])
            yield Block(len(part.at), partial(self._read, part, start, fields, columns))

    def _read(
        self, part: MessageStream, start: int, fields: Mapping[str, Field], columns: Mapping[str, Array], path: str
    ) -> Array:
        if path in columns:
            return columns[path][start : start + len(part.at)]
        return self.raw.values(part, fields[path][1])

    def _joined(
        self, stream: MessageStream, labels: Mapping[str, str], t: Array, clock: str | None
    ) -> dict[str, Array]:
        """Return fields of another message at the times of the rows."""
        stream = self.log.sound(stream, None, clock)
        times = stream.time(clock)
        falls = np.flatnonzero(np.diff(times) < 0)
        rises = slice(0, int(falls[0]) + 1 if len(falls) else len(times))  # what comes behind a restart is refused
        values = {path: self.raw.values(stream, label)[rises] for path, label in labels.items()}
        if wide := next((path for path, column in values.items() if column.ndim > 1), None):
            raise BadValue(f"{self.log.path}: '{wide}' has 32 values a row, and cannot be joined; name a number")
        return {path: joined(t, times[rises], column) for path, column in values.items()}

    def _field(self, path: str) -> Field:
        field = self._find(path)
        assert field is not None, "the source asked for it before"
        return field

    def _find(self, path: str) -> Field | None:
        """Return the rows and the field that a path names; None where the message has no such field."""
        parts = taken_apart(path)
        if parts is None:
            return None
        name, instance, label = parts
        if (name, instance) not in self._streams:
            self._streams[name, instance] = self._stream(name, instance)
        stream = self._streams[name, instance]
        if stream is None:
            raise self.log.missing(path)
        field = stream.message.label(label)
        if field is None and name in INERTIAL and label in ("T", "Temp"):
            raise MissingChannel(
                f"{self.log.path}: {stream.message.name} has no temperature, as in logs before Copter 3.3; set "
                "source.channels.temperature.path: BARO.Temp where the log has it, or temperature: null to go without"
            )
        return None if field is None else (stream, field)

    def _stream(self, name: str, instance: int | None) -> MessageStream | None:
        """Return the rows of a message, of the instance that is named or meant; None where the log has none."""
        instances = self.log.instances(name)
        if not instances:
            return None
        if instance is None and name not in INERTIAL:
            return instances[min(instances)]
        k = self.imu if instance is None else instance
        if k in instances:
            return instances[k]
        have = ", ".join(f"{name} {one} ({self._about(stream)})" for one, stream in instances.items())
        raise MissingChannel(
            f"{self.log.path}: has no {name} {k}, it has {have}; "
            + ("set imu under source" if instance is None else "correct the number in the path")
        )

    def _note_units(self, stream: MessageStream) -> None:
        """Note which of several inertial units is read."""
        if stream.unit is None or len(self.log.units) < 2:
            return
        unit = self.raw.unit(stream)
        parts = [f"IMU {k} ({self._about(self.log.units[k])})" for k in sorted(self.log.units, key=lambda k: k != unit)]
        self.faults.note(f"{self.log.path.name}: read is {parts[0]}; not read are {', '.join(parts[1:])}")

    def _about(self, stream: MessageStream) -> str:
        """Return rows, rate and range of temperature of a stream."""
        rows = self.log.sound(stream, None).at if stream.message.clock else np.empty(0, np.int64)
        ends = replace(stream, at=rows[[0, -1]]).time() if len(rows) > 1 else np.zeros(2)
        span = float(ends[1] - ends[0])
        text = f"{len(stream.at)} rows" + (f", {(len(rows) - 1) / span:.4g} Hz" if span > 0 else "")
        label = stream.message.label("T")
        low, high = stream.extremes(label) if label else (np.nan, np.nan)
        if np.isfinite(low) or np.isfinite(high):
            text += f", {low:.1f} to {high:.1f} °C"
        return text


class RawSamples:
    """The fields of a log's rows; axes of sensors as `compensated` says (`undo`, `refuse` or `keep`)."""

    def __init__(self, log: DataFlashMessages, compensated: str) -> None:
        self.log, self.compensated = log, compensated
        self._temperatures: dict[int, tuple[Array, Array]] = {}

    def values(self, stream: MessageStream, label: str) -> Array:
        """Return a field of rows (N,)."""
        sensor = SENSORS.get(label)
        if stream.unit is None or sensor is None or self.compensated == "keep":
            return stream.values(label)
        if label not in stream.samples:
            v = np.column_stack([stream.values(axis) for axis in AXES[sensor]])
            raw = self._corrections(stream, sensor).undo(v, self._temperature(stream), stream.at)
            stream.samples.update(zip(AXES[sensor], np.ascontiguousarray(raw.T), strict=True))
        return stream.samples[label]

    def check(self, fields: Iterable[Field], faults: Faults) -> None:
        """Report the corrections, and refuse those that cannot or shall not be undone.

        Raises
        ------
        UnreadableFile
            If the orientation is not known, the temperature of a polynomial is not logged, or a polynomial is refused.
        """
        sensors: dict[tuple[Sensor, int], MessageStream] = {}
        for stream, label in fields:
            if stream.unit is None:
                continue
            if label in ("T", "Temp"):
                _check_temperature(stream, label, faults)
            if (sensor := SENSORS.get(label)) is not None and (sensor, stream.unit) not in sensors:
                sensors[sensor, stream.unit] = stream
                self._check_corrections(stream, sensor, faults)

    def unit(self, stream: MessageStream) -> int:
        """Return the unit that rows are of: GYR and ACC behind the filters count on from the last one."""
        k, count = stream.unit or 0, len(self.log.units)
        return k - count if count and k >= count else k

    def _corrections(self, stream: MessageStream, sensor: Sensor) -> ImuCorrections:
        older = stream.message.clock == "TimeMS"
        return ImuCorrections(self.log.parameters, sensor, self.unit(stream), older)

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
        """Return times in s and temperatures in degC that IMU has for a unit, both (0,) where it has none."""
        stream = self.log.units.get(k)
        label = stream.message.label("T") if stream else None
        if stream is None or label is None:
            return np.empty(0), np.empty(0)
        stream = self.log.sound(stream, None)
        return stream.time(), stream.values(label)

    def _check_corrections(self, stream: MessageStream, sensor: Sensor, faults: Faults) -> None:
        corrections, n, kept = self._corrections(stream, sensor), len(stream.at), self.compensated == "keep"
        rows = f"rows of {NAMES[sensor]} {self.unit(stream)}"
        if not self.log.parameters:
            faults.add(f"{rows} in a log without parameters (PARM): what was corrected is not known", n, AT_FIRST)
            return
        unknown = corrections.unknown(stream.at)
        if unknown is not None and not kept:
            raise UnreadableFile(
                f"{self.log.path}: AHRS_ORIENTATION is {unknown}, a known orientation was expected; set "
                "compensated: keep under source to read the axes as they were logged"
            )
        applied = corrections.applied(stream.at)
        if corrections.polynomial(stream.at) and not kept:
            self._check_polynomial(stream)
        if applied:
            done = "kept" if kept else "undone"
            faults.add(f"{rows} with corrections of the autopilot {done}: {', '.join(applied)}", n, AT_FIRST)

    def _check_polynomial(self, stream: MessageStream) -> None:
        of = f"{self.log.path}: IMU {self.unit(stream)} was compensated by the autopilot (INS_TCAL)"
        if self.compensated == "refuse":
            raise UnreadableFile(
                f"{of}, raw data were expected; set compensated: undo under source, or log with INS_TCALn_ENABLE 0"
            )
        if not any(np.any(np.isfinite(self._temperature(part))) for part in stream.pieces()):
            raise UnreadableFile(
                f"{of} by a temperature that is not in the log, IMU.T was expected; add IMU to LOG_BITMASK, or set "
                "compensated: keep under source"
            )


def _check_temperature(stream: MessageStream, label: str, faults: Faults) -> None:
    T = float(replace(stream, at=stream.at[:1]).values(label)[0])
    if len(stream.at) > 1 and np.isfinite(T) and all(np.all(part.values(label) == T) for part in stream.pieces()):
        why = "it has no thermometer" if T == 0 else "its thermometer stands still"
        what = f"rows of IMU {stream.unit} that all show {T:.6g} °C ({why}; BARO.Temp may serve)"
        faults.add(what, len(stream.at), AT_FIRST)
