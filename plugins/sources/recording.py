"""What the sources that read a file share: channels, units, the range of rows, and every check.

A kind of file is a `Table`: named columns, each with a unit where the file knows one, read block after block.

::

    columns of a block -> rows in START:STOP -> channels (N,) or (N, d) in SI -> chunks of at most `size`

START and STOP are seconds from the first row. The range begins with the first row at or after START and ends
before the first one at or after STOP: consecutive ranges share no row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Source
from fusion_core.errors import (
    BadValue,
    ConfigError,
    EmptyRecording,
    MissingChannel,
    UnitError,
    UnreadableFile,
)
from fusion_core.faults import Faults
from fusion_core.settings import ConfigPath, nearest
from fusion_core.units import Unit, convert
from fusion_plugins.sources.channel import Channel

FORMATS = {  # the first bytes of a file: what it is, and what to do with it
    b"\x89HDF": ("an HDF5 file", "use kind: hdf5"),
    b"CDF": ("a NetCDF-3 file", "convert it with `nccopy -k nc4 OLD NEW` and use kind: hdf5"),
    b"PK\x03\x04": ("a zip archive or a spreadsheet", "unpack it, or export it as CSV and use kind: csv"),
    b"\x1f\x8b": ("a gzip archive", "unpack it first"),
    b"PAR1": ("a Parquet file", "export it as CSV and use kind: csv"),
}
Conversions = Mapping[str, list[tuple[str, str] | None]]  # the unit and the SI unit of each path of a channel


def head(path: Path) -> bytes:
    """Return the first bytes of a file; raises UnreadableFile where it is not there, not a file, or empty."""
    try:
        with path.open("rb") as file:
            first = file.read(4096)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name an existing file") from None
    if not first:
        raise UnreadableFile(f"{path}: is empty (0 bytes); nothing was written to it, or a copy failed")
    return first


def foreign(path: Path, first: bytes, kind: str) -> UnreadableFile:
    """Return the error for a file that is not of this kind, saying what it is."""
    known = next((what for magic, what in FORMATS.items() if first.startswith(magic)), None)
    what, advice = known or (
        ("of an unknown format", "check the path") if b"\0" in first else ("a text file", "use kind: csv")
    )
    return UnreadableFile(f"{path}: is {what}, a file of kind {kind} was expected; {advice}")


@dataclass(frozen=True)
class Block:
    """Some consecutive rows of a table: `read(path)` gives a column's values, (rows,) or (rows, d)."""

    rows: int
    read: Callable[[str], Array]


class Table(ABC):
    """An open file as named columns."""

    noun: ClassVar[str] = "column"  # what a path names in this kind of file

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Every path that can be read."""

    @abstractmethod
    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield the rows in order; `size` is how many the reader wants at a time."""

    def has(self, path: str) -> bool:
        """Whether `path` can be read."""
        return path in self.names

    def unit(self, path: str) -> str | None:
        """Return the unit that the file gives for `path`, as it is written there."""
        return None


@dataclass
class Window:
    """The rows from `start` up to `stop` seconds after the first one, found block by block."""

    start: float | None
    stop: float | None
    first: float = np.nan  # the first time stamp [s]
    last: float = np.nan  # the latest time stamp seen [s]
    rows: int = 0  # within the range, so far
    ended: bool = False

    def cut(self, t: Array) -> slice:
        """Return the rows of the next block that are within the range."""
        finite = t[np.isfinite(t)]
        if len(finite):
            self.first = finite[0] if np.isnan(self.first) else self.first
            self.last = finite[-1]
        begin = 0 if self.start is None or self.rows else _first(t - self.first >= self.start)
        end = len(t) if self.stop is None else begin + _first(t[begin:] - self.first >= self.stop)
        if self.ended:
            return slice(0, 0)
        self.ended = end < len(t)
        self.rows += end - begin
        return slice(begin, end)


def _first(found: np.ndarray) -> int:
    return int(np.argmax(found)) if np.any(found) else len(found)


class Recording(Source):
    """A file of samples."""

    path: ConfigPath | None = None
    start: Annotated[float, Unit("s", example="60 s")] | None = None  # from the first row
    stop: Annotated[float, Unit("s", example="600 s")] | None = None  # from the first row
    interval: Annotated[float, Unit("s", positive=True, example="20 ms")] | None = None  # where there is no time column
    channels: Annotated[Mapping[str, Channel], Field(min_length=1)]

    @model_validator(mode="after")
    def _check_channels(self) -> Self:
        if self.interval is None and "time" not in self.channels:
            raise _problem(
                "neither a time channel nor an interval is given; write time: {path: ..., unit: s} under "
                "channels, or interval: 20 ms where the file has no time column"
            )
        if self.interval is not None and "time" in self.channels:
            raise _problem("both a time channel and an interval are given; remove one (time stamps are the better)")
        for name, channel in self.channels.items():
            try:
                channel.check(name)
            except UnitError as error:
                raise _problem(str(error)) from None
        return self

    @property
    def name(self) -> str:
        """The path, with ::START:STOP where a range is set."""
        start, stop = ("" if value is None else f"{value:.12g}" for value in (self.start, self.stop))
        return f"{self.path or self.kind}" + (f"::{start}:{stop}" if start or stop else "")

    @abstractmethod
    def _open(self, path: Path, faults: Faults) -> AbstractContextManager[Table]:
        """Open the file; raises UnreadableFile."""

    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the range as chunks of at most `size` samples in SI units."""
        if self.path is None:
            raise ConfigError(
                f"{self.kind}: no recording is named; write path: FILE under source, or give --input FILE"
            )
        self._check_range()
        window, seen = Window(self.start, self.stop), 0
        with self._open(self.path, faults) as table:
            units = {name: self._conversions(table, name) for name in self.channels}
            paths = list(dict.fromkeys(path for channel in self.channels.values() for path in channel.paths))
            for block in table.blocks(paths, size):
                t = self._time(block, units, seen)
                seen += block.rows
                rows = window.cut(t)
                faults.first_row = None if np.isnan(window.first) else float(window.first)
                if rows.start < rows.stop:
                    channels = {name: self._values(name, block, units) for name in self.channels if name != "time"}
                    yield from _pieces(Chunk(t, channels), rows, size)
                if window.ended and window.rows:
                    return
        if window.rows == 0:
            raise self._empty(window, seen, table.noun)

    def _check_range(self) -> None:
        for word, value in (("START", self.start), ("STOP", self.stop)):
            if value is not None and not value >= 0:
                raise ConfigError(
                    f"{self.name}: {word} is {value:.12g} s, seconds from the first row were expected; write 0 or more"
                )

    def _empty(self, window: Window, seen: int, noun: str) -> EmptyRecording:
        if seen == 0:
            return EmptyRecording(
                f"{self.path}: has {noun}s and no rows; check that the recording was not stopped at once"
            )
        if np.isnan(window.first):
            return EmptyRecording(
                f"{self.name}: none of {seen} time stamps is a number; check the path of channel time"
            )
        return EmptyRecording(
            f"{self.name}: has no row in this range, the recording is {window.last - window.first:.6g} s "
            "long; write START:STOP in seconds from its first row, START before STOP"
        )

    def _conversions(self, table: Table, name: str) -> list[tuple[str, str] | None]:
        """Return the unit and the SI unit of each path of a channel."""
        channel = self.channels[name]
        for path in channel.paths:
            if not table.has(path):
                known = list(table.names)
                hint = nearest(path, known)
                have = ", ".join(known[:30]) + (f" and {len(known) - 30} more" if len(known) > 30 else "")
                raise MissingChannel(
                    f"{self.path}: has no {table.noun} '{path}' for channel {name}, it has {have or 'none'}; "
                    + (f"did you mean '{hint}'?" if hint else f"correct source.channels.{name}.path")
                )
        return [channel.conversion(self.path or Path(), name, path, table.unit(path)) for path in channel.paths]

    def _time(self, block: Block, conversions: Conversions, seen: int) -> Array:
        if self.interval is None:
            return self._values("time", block, conversions)
        return np.arange(seen, seen + block.rows, dtype=np.float64) * self.interval

    def _values(self, name: str, block: Block, conversions: Conversions) -> Array:
        """Return a channel of a block in SI: (N, d) for vectors, (N,) for scalars."""
        pairs = zip(self.channels[name].paths, conversions[name], strict=True)
        columns = [convert(block.read(path), *units) if units else block.read(path) for path, units in pairs]
        values = columns[0] if len(columns) == 1 else np.column_stack(columns)
        d = 1 if values.ndim == 1 else values.shape[1]
        most = {"gyro": 3, "accel": 3, "time": 1, "temperature": 1}.get(name, d)
        if not 1 <= d <= most:
            raise BadValue(
                f"{self.path}: channel {name} has {d} columns, {'1 to 3 were' if most == 3 else '1 was'} "
                f"expected; name {'one path an axis' if most == 3 else 'one'} in source.channels.{name}.path"
            )
        if most == 3 or d == 1:
            values = values.reshape((len(values), d) if most == 3 else len(values))
        result: Array = np.ascontiguousarray(values, dtype=np.float64)
        return result


def _pieces(chunk: Chunk, rows: slice, size: int) -> Iterator[Chunk]:
    for start in range(rows.start, rows.stop, size):
        piece = slice(start, min(start + size, rows.stop))
        yield Chunk(chunk.t[piece], {name: values[piece] for name, values in chunk.channels.items()})


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("recording", "{text}", {"text": text})
