"""Recordings that driftlab writes: of a live source, while its samples come, and of a simulated one.

That of a live source (`driftlab live --record FILE.h5`) has a data set for each channel, in SI and bit by bit the
samples of the filter, so that `driftlab run` with the same config and the file gives the live estimates again.

A simulated one is HDF5 with units as attributes, CSV with units in comments, or a spreadsheet with units in its heads,
in SI, temperatures in degC; a log or a bag, written by the source that reads it; or a device's bytes. It has its final
name only when it is whole.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from zipfile import ZipFile

import numpy as np

from driftlab import __version__
from driftlab.storage import ownership
from driftlab.storage.folders import Lock, check_writable, refusals
from driftlab.storage.hdf5 import GrowingFile, beside, continued, reading
from driftlab.storage.map_file import write_text
from driftlab.storage.ownership import check_own, digest, free, put, seal, seal_of
from driftlab.storage.system import sync
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import FileSource, Framing, Source, head
from fusion_core.contracts.file_source import RecordingWriter
from fusion_core.data_sets import attribute
from fusion_core.errors import ConfigError, UnreadableFile, check_installed
from fusion_core.escaping import comment, json_text, yaml_text
from fusion_core.host.registry import registry

if TYPE_CHECKING:
    import h5py

RECORDED_MARK = "recorded by driftlab"
SIGNATURE = b"\x89HDF\r\n\x1a\n"
RECORDED_UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
"""Of the others: SI, as converted."""
COLUMNS = {name: {"unit": unit} for name, unit in RECORDED_UNITS.items()}


class Recorder:
    """A recording in progress, locked (`PATH.lock`) until it is closed.

    Parameters
    ----------
    path : Path
        Of the file.
    config : str
        Kept in it.
    resume : bool
        Whether to go on with the file where it is there; its time goes on too.
    force : bool
        Whether to replace a recording that is there, once the first samples have come.

    Raises
    ------
    ConfigError
        If the file is there and is not to be continued, is being written, or cannot be written.
    """

    def __init__(self, path: Path, config: str, *, resume: bool, force: bool = False) -> None:
        self.path, self.config = Path(os.path.realpath(path)), config
        self.named = path  # in messages
        self.file: GrowingFile | None = None
        self.last = -np.inf  # time of the last row [s]
        self.started: float | None = None  # time zero in s since 1970
        self._shift: float | None = None
        self.kept: Path | None = None  # an unreadable file, under its new name
        self._replaced = there = self.path.exists()
        if there and not resume and not force:
            raise self._in_the_way()
        if there and not self.path.is_file():
            raise ConfigError(f"--record {path}: is no file; name another")
        if not self.path.parent.is_dir():
            raise ConfigError(f"--record {path}: there is no folder {path.parent}; make it, or name another")
        with refusals(f"--record {path}", "name another place"):
            check_writable(self.path.parent)
            self.lock = _locked(self.path, f"--record {path}", [beside(self.path)])
        try:
            if there and resume:
                self._continue()
            elif there:
                self._check(self._attributes())
        except BaseException:
            self.lock.release()
            raise

    def _in_the_way(self) -> ConfigError:
        return ConfigError(
            f"--record {self.named}: is there already; name another file, or go on with it with --resume"
        )

    def _attributes(self) -> dict[str, Any]:
        with reading(self.path) as old:
            return {name: attribute(self.path, old, name) for name in old.attrs}

    def _check(self, attributes: dict[str, Any]) -> None:
        if not str(attributes.get("program", "")).startswith(RECORDED_MARK):
            raise UnreadableFile(f"{self.named}: was not {RECORDED_MARK}; name another file with --record")

    def _continue(self) -> None:
        try:
            attributes = self._attributes()
        except UnreadableFile:
            with self.path.open("rb") as file:
                if not SIGNATURE.startswith(file.read(len(SIGNATURE))):  # neither of HDF5 and cut short, nor empty
                    raise
            # its writer was killed too early, or it is damaged: it is kept under another name
            self.kept = free(self.path, "unreadable")
            os.rename(self.path, self.kept)
            return
        self._check(attributes)
        self.started = float(attributes["started"])
        self.file = continued(self.path, None, attributes, COLUMNS)
        if self.file.rows:
            with reading(self.path) as old:
                self.last = float(old["time"][-1])

    @property
    def rows(self) -> int:
        """Number of rows that are safe."""
        return self.file.rows if self.file is not None else 0

    def add(self, chunk: Chunk) -> Chunk:
        """Take a chunk and return it as it is recorded: after a pause, with times that go on."""
        if len(chunk) == 0:
            return chunk
        now = time.time() - float(chunk.t[-1])
        if self.started is None:
            self.started = now
        if self._shift is None:
            step = float(np.median(np.diff(chunk.t))) if len(chunk) > 1 else 1e-3
            late = self.last + step - float(chunk.t[0])
            self._shift = 0.0 if self.file is None else max(now - self.started, late)
        if self._shift:
            chunk = Chunk(chunk.t + self._shift, chunk.channels)
        if self.file is None:
            if self.path.exists() and not self._replaced:  # it has come since
                raise self._in_the_way()
            attributes = {"program": f"{RECORDED_MARK} {__version__}", "config": self.config, "started": self.started}
            self.file = GrowingFile(self.path, attributes, COLUMNS)
        self.file.append({"time": chunk.t, **chunk.channels})
        return chunk

    def flush(self) -> None:
        """Write all rows that were added; from here on they survive."""
        if self.file is not None:
            self.file.flush()

    def close(self) -> None:
        """Write the rest, close the file and have it reach the disk."""
        try:
            if self.file is not None:
                self.file.close()
                sync(self.path)
        finally:
            self.lock.release()


def _locked(path: Path, what: str, unfinished: list[Path]) -> Lock:
    """Return the lock on a file (`PATH.lock`); raises ConfigError where files that are not finished are another's.

    They are ours where a lock file is left, by a process that was killed.
    """
    lock = Lock(path.with_name(path.name + ".lock"), what)
    for name in unfinished:
        if name.exists() and not lock.left_over:
            lock.release()
            raise ConfigError(f"{what}: {name.name} is in the way; move it, or name another file")
    lock.sign()
    return lock


def _is_recorded(path: Path, file: h5py.File) -> bool:
    return str(attribute(path, file, "program") or "").startswith(RECORDED_MARK)


def recorded_source(path: Path, live: Source | None = None) -> Source:
    """Return the source that reads a recording of a live one, or of `live` the bytes that its device sent.

    Raises
    ------
    UnreadableFile
        If the file is neither.
    """
    import h5py

    plain = (path.is_file() and not h5py.is_hdf5(path)) or path == Path("-")
    if live is not None and plain and (raw := live.of_file(path)) is not None:
        return raw
    with reading(path) as file:
        if not _is_recorded(path, file):
            raise UnreadableFile(
                f"{path}: was not {RECORDED_MARK}; name its channels in a config with a source for files"
            )
        channels = {name: {"path": name} for name in file}
    kind = registry().classes(Source)["hdf5"]
    source = kind.model_validate({"kind": "hdf5", "path": str(path), "channels": channels})
    assert isinstance(source, Source)
    return source


def started_at(path: Path) -> float | None:
    """Return the time at which the recording of a live run began, s since 1970; None of any other file."""
    import h5py

    if not (path.is_file() and h5py.is_hdf5(path)):
        return None
    with reading(path) as file:
        known = _is_recorded(path, file) and "started" in file.attrs
        return float(attribute(path, file, "started")) if known else None


SIMULATED_MARK = "driftlab simulate"
HEAD = 1 << 16  # bytes that its comments take at most
SIMULATED_UNITS = {**RECORDED_UNITS, "bias_truth": "rad/s"}


@contextmanager
def recording_file(out: Path, settings: str, framing: Framing | None = None) -> Iterator[RecordingWriter]:
    """Give a file to append chunks to, which is called `out` when all went well.

    Its ending says what it is, unless it is to hold the bytes of a `framing`. A recording that was simulated before,
    and is as it was written, is replaced; any other file is refused. `settings` are kept in it where there is a place
    for them, and its SHA-256.

    Raises
    ------
    ConfigError
        If the ending is another one, the file is not ours, or another process writes it.
    Unwritable
        If the disk is full, or the like.
    """
    begin = _format_of(out) if framing is None else partial(FramingWriter, framing=framing)
    place = Path(os.path.realpath(out))
    for path in (out, *([] if framing is None else [ownership.beside(place)])):
        check_own(path, "simulate", f"--out {path}", "name another file")
    with _locked_partial(place, out) as unfinished:
        writer = begin(unfinished, settings)
        with closing(writer):  # also of a program that stops: rows that were written are whole
            yield writer
        seal(unfinished)
        if framing is not None:  # and before the file has its place: whenever this ends, what is there is known
            known = {place.name: digest(unfinished), "before/": digest(place)}
            note = json_text({"settings": json.loads(settings), "written": known}, 2)
            write_text(ownership.beside(place), f"{note}\n", "simulate")
        put(unfinished, out, "simulate", f"--out {out}")


def _format_of(out: Path) -> Callable[[Path, str], RecordingWriter]:
    """Return the function that begins a recording of the format that a name ends in; raises ConfigError."""
    known, suffix = dict(TABLES), out.suffix.lower()
    for cls in registry().classes(Source).values():
        if issubclass(cls, FileSource):
            known |= dict.fromkeys(cls.written, partial(_begun, cls, suffix))
    if suffix not in known:
        raise ConfigError(f"--out {out}: ends in '{out.suffix}'; write a name that ends in one of {', '.join(known)}")
    return known[suffix]


def _begun(cls: type[FileSource], suffix: str, path: Path, settings: str) -> RecordingWriter:
    return cls.writer(path, suffix, seal_of("simulate"))


@contextmanager
def _locked_partial(out: Path, named: Path) -> Iterator[Path]:
    """Give the name `OUT.partial` to write to.

    `OUT.lock` is held meanwhile. Left behind, it says that what is called `OUT.partial` is ours.
    """
    partial = out.with_name(out.name + ".partial")
    unfinished = [partial, beside(partial)]
    with refusals(f"--out {named}", "make room, or name another place", usage=False):
        out.parent.mkdir(parents=True, exist_ok=True)
        lock = _locked(out, f"--out {named}", unfinished)
        try:
            yield partial
        finally:
            lock.release(remove=not any(path.exists() for path in unfinished))


class Hdf5Writer:
    """One data set a channel, each with its `unit`; time is the first axis."""

    names: ClassVar[tuple[str, ...]] = ()

    def __init__(self, path: Path, settings: str) -> None:
        attributes = {"sha256": seal_of("simulate"), "program": f"{SIMULATED_MARK} {__version__}", "settings": settings}
        self.file = GrowingFile(path, attributes, {name: {"unit": unit} for name, unit in SIMULATED_UNITS.items()})

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""
        self.file.append(_columns(chunk))

    def close(self) -> None:
        """Finish the file."""
        self.file.close()


class CsvWriter:
    """One column an axis, below comments with the config that reads them."""

    names: ClassVar[tuple[str, ...]] = ()

    def __init__(self, path: Path, settings: str) -> None:
        self.settings, self.file = settings, path.open("wb")

    def close(self) -> None:
        """Finish the file."""
        self.file.close()

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""
        import polars as pl

        columns = _columns(chunk)
        table = {name: names_of_axes(name, values) for name, values in columns.items()}
        begun = self.file.tell() > 0
        if not begun:
            self.file.write(self._comments(table).encode())
        flat = [
            pl.Series(column, np.ascontiguousarray(part))
            for name, values in columns.items()
            for column, part in zip(table[name], np.atleast_2d(values.T), strict=True)
        ]
        self.file.write(pl.DataFrame(flat).write_csv(include_header=not begun).encode())

    def _comments(self, table: dict[str, list[str]]) -> str:
        lines = [f"{seal_of('simulate')}; to read it:", "source:", "  kind: csv", "  channels:"]
        for name, columns in table.items():
            unit = f", unit: {SIMULATED_UNITS[name]}" if name in SIMULATED_UNITS else ""
            named = [yaml_text(column) for column in columns]
            path = named[0] if len(named) == 1 else f"[{', '.join(named)}]"
            lines.append(f"    {yaml_text(name)}: {{path: {path}{unit}}}")
        return "\n".join(map(comment, [*lines, f"settings: {self.settings}"])) + "\n"


def written_units(path: Path) -> dict[str, str]:
    """Return the units of channels in the comments of a simulated CSV; none of any other file."""
    with suppress(OSError, UnicodeDecodeError, UnreadableFile):
        first = head(path, most=HEAD).decode("utf-8", "ignore")
        comments = "".join(takewhile(lambda line: line.startswith("#"), first.splitlines(keepends=True)))
        if comments.startswith(f"# {SIMULATED_MARK}"):
            return dict(re.findall(r"^# +(\w+): \{path: .*, unit: ([^}]+)\}$", comments, re.MULTILINE))
    return {}


MOST_ROWS = 1_048_575  # of a sheet, below its heads


class XlsxWriter:
    """A spreadsheet: one column an axis, its unit in its head; what it was made from is on a second sheet."""

    names: ClassVar[tuple[str, ...]] = ()

    def __init__(self, path: Path, settings: str) -> None:
        check_installed("--out", "openpyxl", ".xlsx", "excel")
        from openpyxl import Workbook

        self._path, self._book, self._rows = path, Workbook(write_only=True), 0
        self._sheet = self._book.create_sheet("recording")
        self._book.create_sheet("settings").append([settings])

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk; raises ConfigError where a sheet cannot hold them."""
        columns = _columns(chunk)
        if not self._rows:
            heads = [
                (head, SIMULATED_UNITS.get(name)) for name in columns for head in names_of_axes(name, columns[name])
            ]
            self._sheet.append([f"{head} [{unit}]" if unit else head for head, unit in heads])
        self._rows += len(chunk)
        if self._rows > MOST_ROWS:
            raise ConfigError(f"--out: more than {MOST_ROWS:,} rows, as many as a sheet holds; write .csv or .h5")
        for row in np.column_stack(list(columns.values())).tolist():
            self._sheet.append(row)

    def close(self) -> None:
        """Finish the file: its seal is the comment of the archive that a spreadsheet is."""
        self._book.save(self._path)
        with ZipFile(self._path, "a") as archive:
            archive.comment = seal_of("simulate").encode()


class FramingWriter:
    """The bytes that a device sends, one sample behind the other."""

    def __init__(self, path: Path, settings: str, *, framing: Framing) -> None:
        self._file, self._framing, self._sent = path.open("wb"), framing, 0
        self.names = tuple(framing.decode(b"", None)[0].channels)

    def append(self, chunk: Chunk) -> None:
        """Add the samples of a chunk."""
        self._file.write(self._framing.encode(chunk, self._sent))
        self._sent += len(chunk)

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


TABLES: dict[str, Callable[[Path, str], RecordingWriter]] = {
    ".h5": Hdf5Writer, ".hdf5": Hdf5Writer, ".csv": CsvWriter, ".xlsx": XlsxWriter,
}  # fmt: skip


def _columns(chunk: Chunk) -> dict[str, Array]:
    return {"time": chunk.t, **chunk.channels}


def names_of_axes(name: str, values: Array) -> list[str]:
    """Return the names of the columns of a channel."""
    if values.ndim == 1:
        return [name]
    count = values.shape[1]
    return [f"{name}_{axis}" for axis in ("xyz"[:count] if count <= len("xyz") else range(count))]
