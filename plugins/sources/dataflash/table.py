"""The messages of an ArduPilot log as columns: the rows are those of one message, the others are joined to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import ClassVar

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Block, Table
from fusion_core.errors import BadValue, MissingChannel
from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash.log import DataFlashMessages, MessageStream
from fusion_plugins.sources.dataflash.raw import Raw
from fusion_plugins.sources.dataflash.scan import CLOCKS, DESCRIPTIONS, INERTIAL
from fusion_plugins.sources.joining import joined


class Messages(Table):
    """The messages of an open log, joined to the rows of one of them."""

    noun: ClassVar[str] = "message field"

    def __init__(self, log: DataFlashMessages, imu: int, raw: Raw, faults: Faults, of_rows: str) -> None:
        self.log, self.imu, self.faults, self._of_rows = log, imu, faults, of_rows
        self._raw = raw
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
        """Whether the log has this field; raises MissingChannel where it has not its message or unit."""
        return self._find(path) is not None

    def unit(self, path: str) -> str | None:
        """Return the unit by the log's FMTU, or by the field's name in logs that have none."""
        found = self._find(path)
        return None if found is None else found[0].message.units.get(found[1])

    def about(self, path: str) -> Mapping[str, str]:
        """Return the number of the inertial unit that a path is of, counted from 1 as in INS_TCAL1."""
        found = self._find(path)
        return {} if found is None or found[0].unit is None else {"imu": str(self._raw.unit(found[0]) + 1)}

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of `size` rows of the message that gives the time."""
        found = self._find(self._of_rows)
        if found is None:
            raise MissingChannel(f"{self.log.path}: has no message field '{self._of_rows}'; correct the path")
        clock = found[1] if found[1] in CLOCKS else None
        rows = self.log.sound(found[0], self.faults, clock)
        self._raw.check([self._found(path) for path in paths], self.faults)
        self._note_units(found[0])
        t = None
        columns: dict[str, Array] = {}
        known: dict[int, dict[str, Array]] = {}
        for path in paths:
            stream, label = self._found(path)
            if stream is found[0]:
                continue
            if (stream.message.values(self.log.data, stream.at[:1], label)).ndim > 1:
                raise BadValue(f"{self.log.path}: '{path}' has 32 values a row, and cannot be joined; name a number")
            t = rows.time(clock) if t is None else t
            sensors = known.setdefault(id(stream), {})
            columns[path] = self._joined(stream, label, t, clock, sensors)
        for start in range(0, len(rows.at), size):
            part = MessageStream(rows.message, rows.at[start : start + size], self.log.data, rows.unit)
            yield Block(len(part.at), partial(self._read, part=part, start=start, columns=columns, known={}))

    def _read(
        self, path: str, part: MessageStream, start: int, columns: dict[str, Array], known: dict[str, Array]
    ) -> Array:
        if path in columns:
            return columns[path][start : start + len(part.at)]
        return self._raw.values(part, self._found(path)[1], known)

    def _joined(self, stream: MessageStream, label: str, t: Array, clock: str | None, known: dict[str, Array]) -> Array:
        stream = self.log.sound(stream, None, clock)
        own = stream.time(clock)
        falls = np.flatnonzero(np.diff(own) < 0)
        rises = slice(0, int(falls[0]) + 1 if len(falls) else len(own))  # what comes behind a restart is refused
        return joined(t, own[rises], self._raw.values(stream, label, known)[rises])

    def _found(self, path: str) -> tuple[MessageStream, str]:
        found = self._find(path)
        assert found is not None, "the source asked for it before"
        return found

    def _find(self, path: str) -> tuple[MessageStream, str] | None:
        """Return the rows and the field that a path names; None where the message has no such field."""
        parts = self.log.split(path)
        if parts is None:
            return None
        name, instance, label = parts
        key = (name, instance)
        if key not in self._streams:
            self._streams[key] = self._stream(name, instance)
        stream = self._streams[key]
        if stream is None:
            raise self.log.missing(path)
        known = stream.message.label(label)
        if known is None and name in INERTIAL and label in ("T", "Temp"):
            raise MissingChannel(
                f"{self.log.path}: {stream.message.name} has no temperature, as in logs before Copter 3.3; set "
                "source.channels.temperature.path: BARO.Temp where the log has it, or temperature: null to go without"
            )
        return None if known is None else (stream, known)

    def _stream(self, name: str, instance: int | None) -> MessageStream | None:
        """Return the rows of a message, of the instance that is named or meant; None where the log has none."""
        found = self.log.instances(name)
        if not found or (name in INERTIAL and not self.log.units and name == "IMU"):
            return None
        if instance is None and name not in INERTIAL:
            return found[min(found)]
        k = self.imu if instance is None else instance
        if k in found:
            return found[k]
        have = ", ".join(f"{name} {one} ({self._about(stream)})" for one, stream in found.items())
        raise MissingChannel(
            f"{self.log.path}: has no {name} {k}, it has {have}; "
            + ("set imu under source" if instance is None else "correct the number in the path")
        )

    def _note_units(self, stream: MessageStream) -> None:
        """Say which of several inertial units is read."""
        if stream.unit is None or len(self.log.units) < 2:
            return
        own = self._raw.unit(stream)
        parts = [f"IMU {k} ({self._about(self.log.units[k])})" for k in sorted(self.log.units, key=lambda k: k != own)]
        self.faults.note(f"{self.log.path.name}: read is {parts[0]}; not read are {', '.join(parts[1:])}")

    def _about(self, stream: MessageStream) -> str:
        """Return rows, rate and range of temperature of a stream."""
        t = self.log.sound(stream, None).time() if stream.message.clock else np.empty(0)
        span = float(t[-1] - t[0]) if len(t) > 1 else 0.0
        text = f"{len(stream.at)} rows" + (f", {(len(t) - 1) / span:.4g} Hz" if span > 0 else "")
        label = stream.message.label("T")
        T = stream.values(label) if label else np.empty(0)
        if np.any(np.isfinite(T)):
            text += f", {np.nanmin(T):.1f} to {np.nanmax(T):.1f} °C"
        return text
