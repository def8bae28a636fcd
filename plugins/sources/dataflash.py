"""Logs of ArduPilot vehicles (.bin): rows of an inertial unit, as its sensor measured them.

::

    path IMU.GyrX      of the unit that `imu` names        IMU[1].GyrX    of that one
    path BARO.Temp     of the first instance, joined to the rows in time

The rows are those of the message of channel `time`; all others are joined to them. Where `compensated` is not `keep`,
gyros and accelerometers are in the frame of the board, without the autopilot's corrections (`dataflash_imu`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from fusion_core.chunk import Array
from fusion_core.contracts import Block, FileSource, Source, Table, foreign, head
from fusion_core.errors import BadValue, MissingChannel, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.dataflash_log import Log, Stream
from fusion_plugins.sources.dataflash_messages import CLOCKS, DESCRIPTIONS, INERTIAL
from fusion_plugins.sources.dataflash_raw import Raw
from fusion_plugins.sources.dataflash_scan import SIGNATURE
from fusion_plugins.sources.joining import joined

NEAR = 1 << 16  # bytes within which a log whose beginning is damaged shows its first description


class DataFlash(FileSource):
    """A DataFlash log of an ArduPilot vehicle, from the card or as a ground station downloads it."""

    signatures: ClassVar[tuple[bytes, ...]] = (SIGNATURE,)
    suffixes: ClassVar[tuple[str, ...]] = (".bin", ".BIN")
    product: ClassVar[str | None] = "ardupilot_log"

    kind: Literal["dataflash"] = "dataflash"
    imu: Annotated[int, Field(ge=0)] = 0
    """Which inertial unit, from 0: paths that begin with IMU, GYR or ACC and name none are of this one."""
    compensated: Literal["undo", "refuse", "keep"] = "undo"
    """Of what the autopilot corrected: undo it, refuse a log with a learned polynomial, or keep all as logged."""

    @contextmanager
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the log; raises UnreadableFile where it is of another kind, MissingChannel where it lacks the unit."""
        first = head(path)
        data = np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
        if first.startswith(b"FMT, "):
            raise UnreadableFile(
                f"{path}: is an ArduPilot log as text, a binary one (.bin) was expected; take the .bin from the "
                "vehicle's card, or write its IMU lines as CSV and use kind: csv"
            )
        if not first.startswith(SIGNATURE) and SIGNATURE not in data[:NEAR].tobytes():
            raise foreign(path, first, self.kind)
        paths = [path for channel in self.channels.values() for path in channel.paths]
        wanted = {path.partition(".")[0].partition("[")[0] for path in paths}
        log = Log(path, data, wanted | {"IMU"}, faults)
        yield Messages(log, self, faults, self.channels["time"].paths[0] if "time" in self.channels else paths[0])


class Messages(Table):
    """The messages of an open log, joined to the rows of one of them."""

    noun: ClassVar[str] = "message field"

    def __init__(self, log: Log, source: DataFlash, faults: Faults, of_rows: str) -> None:
        self.log, self.source, self.faults, self._of_rows = log, source, faults, of_rows
        self._raw = Raw(log, source.compensated)
        self._streams: dict[tuple[str, int | None], Stream | None] = {}

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
            part = Stream(rows.message, rows.at[start : start + size], self.log.data, rows.unit)
            yield Block(len(part.at), partial(self._read, part=part, start=start, columns=columns, known={}))

    def _read(self, path: str, part: Stream, start: int, columns: dict[str, Array], known: dict[str, Array]) -> Array:
        if path in columns:
            return columns[path][start : start + len(part.at)]
        return self._raw.values(part, self._found(path)[1], known)

    def _joined(self, stream: Stream, label: str, t: Array, clock: str | None, known: dict[str, Array]) -> Array:
        stream = self.log.sound(stream, None, clock)
        own = stream.time(clock)
        falls = np.flatnonzero(np.diff(own) < 0)
        rises = slice(0, int(falls[0]) + 1 if len(falls) else len(own))  # what comes behind a restart is refused
        return joined(t, own[rises], self._raw.values(stream, label, known)[rises])

    def _found(self, path: str) -> tuple[Stream, str]:
        found = self._find(path)
        assert found is not None, "the source asked for it before"
        return found

    def _find(self, path: str) -> tuple[Stream, str] | None:
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
        return None if known is None else (stream, known)

    def _stream(self, name: str, instance: int | None) -> Stream | None:
        """Return the rows of a message, of the instance that is named or meant; None where the log has none."""
        found = self.log.instances(name)
        if not found or (name in INERTIAL and not self.log.units and name == "IMU"):
            return None
        if instance is None and name not in INERTIAL:
            return found[min(found)]
        k = self.source.imu if instance is None else instance
        if k in found:
            return found[k]
        have = ", ".join(f"{name} {one} ({self._about(stream)})" for one, stream in found.items())
        raise MissingChannel(
            f"{self.log.path}: has no {name} {k}, it has {have}; "
            + ("set imu under source" if instance is None else "correct the number in the path")
        )

    def _about(self, stream: Stream) -> str:
        """Return rows, rate and range of temperature of a stream."""
        t = self.log.sound(stream, None).time() if stream.message.clock else np.empty(0)
        span = float(t[-1] - t[0]) if len(t) > 1 else 0.0
        text = f"{len(stream.at)} rows" + (f", {(len(t) - 1) / span:.4g} Hz" if span > 0 else "")
        label = stream.message.label("T")
        T = stream.values(label) if label else np.empty(0)
        if np.any(np.isfinite(T)):
            text += f", {np.nanmin(T):.1f} to {np.nanmax(T):.1f} degC"
        return text


@hookimpl
def sources() -> list[type[Source]]:
    """Register the plugin."""
    return [DataFlash]
