"""The base of sources that read a file: its channels, their units, the range of rows, and every check.

A kind of file gives a `Table`: named columns, each with a unit where the file knows one, read block after block.

::

    columns of a block -> rows in START:STOP -> channels (N,) or (N, d) in SI -> chunks of at most `size`

START and STOP are seconds from the first row. The range begins with the first row at or after START and ends
before the first one at or after STOP: consecutive ranges share no row.

The format of a file is recognised by its first bytes where a source is given a file of another kind. The kind that
reads it follows from the `signatures` of the installed file sources, so that the advice of a message can be followed;
formats that nothing reads have their names here, too.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol, Self

import numpy as np
from pydantic import Field, PrivateAttr, field_serializer, model_validator

from fusion_core.budget import TimeBudget, check_all, of_all
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.plugin import installed, kind_default
from fusion_core.contracts.source import Source
from fusion_core.contracts.table import USUAL, Block, Channel, Table, Window
from fusion_core.errors import BadValue, ConfigError, EmptyRecording, MissingChannel, UnitError, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.settings import ConfigPath, did_you_mean
from fusion_core.units import Unit, convert, problem

Conversions = Mapping[str, list[tuple[str, str] | None]]  # the unit and the SI unit of each path of a channel


class RecordingWriter(Protocol):
    """A recording that is being written."""

    @property
    def names(self) -> tuple[str, ...]:
        """The channels that it has a place for; none where it takes all."""

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk, which has all of `names`; what else it has is left out."""

    def close(self) -> None:
        """Finish the file: rows that were added are whole in it."""


class FileSource(Source):
    """A file of samples. A subclass names its `kind` and gives `open`; `--input` works for every one of them."""

    signatures: ClassVar[tuple[bytes, ...]] = ()  # what its files begin with, where that tells them
    suffixes: ClassVar[tuple[str, ...]] = ()  # of its files' names, as `.csv`
    written: ClassVar[tuple[str, ...]] = ()  # suffixes of those that `writer` writes
    product: ClassVar[str | None] = None  # what a config of such a file extends, where its channels are always the same

    _title: str = PrivateAttr("")  # name of the recording, where `path` is of a copy of it

    path: ConfigPath | None = None
    """The recording; `--input` on the command line takes its place."""
    start: Annotated[float, Unit("s", example="60 s")] | None = None
    """Begin of the part that is read, from the first row; the beginning where it is left out."""
    stop: Annotated[float, Unit("s", example="600 s")] | None = None
    """End of the part that is read, from the first row; the end where it is left out."""
    interval: Annotated[float, Unit("s", positive=True, example="20 ms")] | None = None
    """Between rows, where the file has no time column."""
    channels: Annotated[Mapping[str, Channel], Field(min_length=1)]
    """Channels: `time`, `gyro`, `accel`, `temperature`, `valid`; any other name is an auxiliary channel."""

    @model_validator(mode="after")
    def _check_channels(self) -> Self:
        self.check_time()
        for name, channel in self.channels.items():
            try:
                channel.check(name)
            except UnitError as error:
                raise problem(str(error)) from None
        return self

    def check_time(self) -> None:
        """Raise a `problem` where the settings do not say, or say twice, when the rows were measured.

        A kind of file that knows the time itself has a check of its own.
        """
        if self.interval is None and "time" not in self.channels:
            raise problem(
                "neither a time channel nor an interval is given; write time: {path: ..., unit: s} under "
                "channels, or interval: 20 ms where the file has no time column"
            )
        if self.interval is not None and "time" in self.channels:
            raise problem("both a time channel and an interval are given; remove one (time stamps are the better)")

    @field_serializer("path", when_used="json")
    def _written_path(self, path: Path | None) -> str | None:
        return self._title or (None if path is None else str(path))

    @property
    def name(self) -> str:
        """The path, with ::START:STOP where a range is set."""
        start, stop = ("" if value is None else f"{value:.12g}" for value in (self.start, self.stop))
        return f"{self._title or self.path or self.kind}" + (f"::{start}:{stop}" if start or stop else "")

    @classmethod
    def settings_for(cls, path: Path, known: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings beside the channels under which a file can be read, by its beginning; `known` are some.

        Raises
        ------
        UnreadableFile
            If the file cannot be read.
        """
        return {key: value for key, value in known.items() if key in cls.model_fields}

    @abstractmethod
    def open(self, path: Path, faults: Faults) -> AbstractContextManager[Table]:
        """Open the file as a table, and close it at the end of the block.

        What is wrong with the file and does not stop its reader goes to `faults`. `head` and `foreign` of
        `fusion_core.contracts` say what is wrong with a file that is not there, empty, or of another kind.

        Raises
        ------
        UnreadableFile
            If the file cannot be read; also at the end of the block, where it is found damaged while it is open.
        """

    @classmethod
    def parameters(cls, path: Path) -> Mapping[str, float]:
        """Return the parameters of the device that logged a file, by their names; none by default."""
        return {}

    @classmethod
    def writer(cls, path: Path, suffix: str, note: str) -> RecordingWriter:
        """Begin a recording as a device of this kind writes it, for rehearsals: of a source that has `written`.

        `path` is to be written, whatever it is called; its name will end in `suffix`, one of `written`. `note`, at
        most 128 characters, is to stand in the file as it is: it tells the file from one that was measured.

        Raises
        ------
        ConfigError
            If a package is needed that is not installed.
        """
        raise NotImplementedError

    def about(self, channel: str) -> Mapping[str, str]:
        """Return the properties of a channel's device that the file holds."""
        if self.path is None or channel not in self.channels:
            return {}
        with of_all(self.path, "looking for its devices"), self.open(self.path, Faults()) as table:
            return dict(table.about(self.channels[channel].paths[0]))

    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the range as chunks of at most `size` samples in SI units."""
        if self.path is None:
            raise ConfigError(
                f"{self.kind}: no recording is named; write path: FILE under source, or give --input FILE"
            )
        for word, value in (("START", self.start), ("STOP", self.stop)):
            if value is not None and not value >= 0:
                raise ConfigError(
                    f"{self.name}: {word} is {value:.12g} s, seconds from the first row were expected; write 0 or more"
                )
        yield from TimeBudget(self.path, "what yields no row").over(self._chunks(self.path, size, faults))

    def _chunks(self, path: Path, size: int, faults: Faults) -> Iterator[Chunk]:
        window, rows_read = Window(self.start, self.stop), 0
        with self.open(path, faults) as table:
            units = {name: self._conversions(table, name) for name in self.channels}
            paths = list(dict.fromkeys(path for channel in self.channels.values() for path in channel.paths))
            for block in table.blocks(paths, size):
                check_all(block.rows)
                t = self._time(block, units, rows_read)
                rows_read += block.rows
                rows = window.cut(t)
                faults.first_row = None if np.isnan(window.first) else float(window.first)
                if rows.start < rows.stop:
                    channels = {name: self._values(name, block, units) for name in self.channels if name != "time"}
                    yield from _pieces(Chunk(t, channels), rows, size)
                if window.ended and window.rows:
                    return
        if window.rows == 0:
            raise self._empty(window, rows_read, table.noun, faults)

    def _empty(self, window: Window, rows_read: int, noun: str, faults: Faults) -> EmptyRecording:
        if rows_read == 0 and (wrong := faults.lines(notes=False)):
            return EmptyRecording(f"{self.path}: has no rows that can be read ({'; '.join(wrong)}); copy it again")
        if rows_read == 0:
            return EmptyRecording(
                f"{self.path}: has {noun}s and no rows; check that the recording was not stopped at once"
            )
        if np.isnan(window.first):
            return EmptyRecording(
                f"{self.name}: none of {rows_read} time stamps is a number; check the path of channel time"
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
                have = ", ".join(known[:30]) + (f" and {len(known) - 30} more" if len(known) > 30 else "")
                raise MissingChannel(
                    f"{self.path}: has no {table.noun} '{path}' for channel {name}, it has {have or 'none'}; "
                    + did_you_mean(path, known, f"correct source.channels.{name}.path", "'")
                )
        return [channel.conversion(self.path or Path(), name, path, table.unit(path)) for path in channel.paths]

    def _time(self, block: Block, conversions: Conversions, rows_read: int) -> Array:
        if self.interval is None:
            return self._values("time", block, conversions)
        return np.arange(rows_read, rows_read + block.rows, dtype=np.float64) * self.interval

    def _values(self, name: str, block: Block, conversions: Conversions) -> Array:
        """Return a channel of a block in SI: (N, d) for vectors, (N,) for scalars."""
        pairs = zip(self.channels[name].paths, conversions[name], strict=True)
        columns = [convert(block.read(path), *units) if units else block.read(path) for path, units in pairs]
        values = columns[0] if len(columns) == 1 else np.column_stack(columns)
        d = 1 if values.ndim == 1 else values.shape[1]
        usual = USUAL.get(name)
        most = (usual and usual.axes) or d
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


AS_CSV = "export it as CSV and use kind: csv"
FORMATS = {  # the first bytes of a file: what it is, and what to do with it where no source reads it
    b"\x89HDF": ("an HDF5 file", AS_CSV),
    b"MATLAB 7.3": ("a MAT file of version 7.3", AS_CSV),
    b"MATLAB 5.0": ("a MAT file", AS_CSV),
    b"CDF": ("a NetCDF-3 file", "convert it with `nccopy -k nc4 OLD NEW` and use kind: hdf5"),
    b"PAR1": ("a Parquet file", f"install a source for it, or {AS_CSV}"),
    b"ULog\x01\x12\x35": ("a PX4 log (ULog)", "install a source for it"),
    b"\xa3\x95\x80\x80": ("an ArduPilot log (DataFlash)", "install a source for it"),
    b"#ROSBAG V2.0": ("a ROS 1 bag", "install a source for it"),
    b"\x89MCAP0\r\n": ("an MCAP file", "install a source for it"),
    b"SQLite format 3\0": ("an SQLite database, as in a ROS 2 bag", f"install a source for it, or {AS_CSV}"),
    b"PK\x03\x04": ("a zip archive or a spreadsheet", f"unpack it, or {AS_CSV}"),
    b"\x1f\x8b": ("a gzip archive", "unpack it first"),
}


def kinds_of(first: bytes) -> list[str]:
    """Return the kinds of the installed sources whose files begin as `first` does."""
    classes = [cls for cls in installed() if any(map(first.startswith, getattr(cls, "signatures", ())))]
    return sorted(map(kind_default, classes))


def recognised(first: bytes) -> bool:
    """Return True if the format of a file that begins so is known."""
    return any(map(first.startswith, FORMATS)) or bool(kinds_of(first))


def foreign(path: Path, first: bytes, kind: str) -> UnreadableFile:
    """Return the error for a file that is not of this kind, saying what it is by its `first` bytes."""
    known = next((what for magic, what in FORMATS.items() if first.startswith(magic)), None)
    kinds = [other for other in kinds_of(first) if other != kind]
    if kinds:
        what, advice = known[0] if known else f"a file of kind {kinds[0]}", f"use kind: {kinds[0]}"
    else:
        what, advice = known or (
            ("of an unknown format", "check the path") if b"\0" in first else ("a text file", "use kind: csv")
        )
    return UnreadableFile(f"{path}: is {what}, a file of kind {kind} was expected; {advice}")
