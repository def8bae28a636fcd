"""A recording that driftlab writes: HDF5 with units as attributes, or CSV with units in comments.

Everything is in SI, temperatures in degC. A file has its final name only when it is whole.
"""

from __future__ import annotations

import hashlib
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from driftlab import __version__
from driftlab.files.hdf5_stream import GrowingFile, beside, reading, reason
from driftlab.files.locks import Lock
from fusion_core.budget import COPIED
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import head
from fusion_core.data_sets import attribute
from fusion_core.errors import ConfigError, UnreadableFile, Unwritable
from fusion_core.escaping import comment, yaml_text

MARK = "driftlab simulate"  # begins every file that may be replaced
HEAD = 1 << 16  # bytes that its comments take at most
SEAL, UNSEALED = re.compile(rb"sha256:([0-9a-f]{64})"), "sha256:" + 64 * "0"
UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC", "bias_truth": "rad/s"}


@contextmanager
def recording_file(out: Path, settings: str) -> Iterator[Writer]:
    """Give a file to append chunks to, which is called `out` (.h5, .hdf5 or .csv) when all went well.

    A recording that was simulated before, and is as it was written, is replaced; any other file is refused. `settings`
    are kept in it, and its SHA-256.

    Raises
    ------
    ConfigError
        If the ending is another one, the file is not ours, or another process writes it.
    Unwritable
        If the disk is full, or the like.
    """
    kind = WRITERS.get(out.suffix.lower())
    if kind is None:
        raise ConfigError(f"--out {out}: ends in '{out.suffix}'; write a name that ends in .h5, .hdf5 or .csv")
    if out.exists() and not (out.is_file() and kind.ours(out)):
        raise ConfigError(f"--out {out}: exists and is not a simulated recording; name another file, or remove it")
    if out.exists() and not _as_written(out):
        raise ConfigError(
            f"--out {out}: is a simulated recording that was changed since; name another file, or remove it"
        )
    with _renamed(Path(os.path.realpath(out)), out) as partial:
        with kind(partial, settings).opened() as file:
            yield file
        _seal(partial)


def _seal(path: Path) -> None:
    """Write the SHA-256 of a file into the place that it has for it."""
    place, _, found = _digests(path)
    with path.open("r+b") as file:
        file.seek(place)
        file.write(found)


def _as_written(path: Path) -> bool:
    """Whether a file has the SHA-256 that it says."""
    try:
        _, said, found = _digests(path)
    except (OSError, UnreadableFile):
        return False
    return said == found


def _digests(path: Path) -> tuple[int, bytes, bytes]:
    """Return where a file says its SHA-256, what it says, and the one that it has with zeros in that place."""
    with path.open("rb") as file:
        first = file.read(HEAD)
        place = SEAL.search(first)
        if place is None:
            raise UnreadableFile(f"{path}: says no SHA-256 of its own; simulate it again")
        found = hashlib.sha256(first[: place.start(1)] + UNSEALED[-64:].encode() + first[place.end(1) :])
        while piece := file.read(COPIED):
            found.update(piece)
    return place.start(1), place[1], found.hexdigest().encode()


@contextmanager
def _renamed(out: Path, named: Path) -> Iterator[Path]:
    """Give the name `OUT.partial` to write to, and rename the file to `out` when all went well.

    `OUT.lock` is held meanwhile. Left behind, it says that what is called `OUT.partial` is ours.
    """
    partial = out.with_name(out.name + ".partial")
    done = False
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        lock = Lock(out.with_name(out.name + ".lock"), f"--out {named}")
        try:
            for name in (partial, beside(partial)):
                if name.exists() and not lock.left_over:
                    done = True
                    raise ConfigError(f"--out {named}: {name.name} is in the way; move it, or name another file")
            lock.sign()
            yield partial
            os.replace(partial, out)
            done = True
        finally:
            lock.release(remove=done or not (partial.exists() or beside(partial).exists()))
    except OSError as error:
        text = f"--out {named}: cannot be written ({reason(error)}); make room, or name another place"
        raise Unwritable(text) from None


class Writer(ABC):
    """A file that is written chunk after chunk."""

    def __init__(self, path: Path, settings: str) -> None:
        self.path, self.settings = path, settings
        self.file: Any = None

    @contextmanager
    def opened(self) -> Iterator[Writer]:
        """Keep the file open; what was written is whole rows, even when the program stops here."""
        self.file = self._open()
        try:
            yield self
        finally:
            self.file.close()

    @staticmethod
    @abstractmethod
    def ours(path: Path) -> bool:
        """Whether the file was written here."""

    @abstractmethod
    def _open(self) -> Any: ...

    @abstractmethod
    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""


class Hdf5Writer(Writer):
    """One data set a channel, each with its `unit`; time is the first axis."""

    @staticmethod
    def ours(path: Path) -> bool:
        """Whether the file was written here."""
        try:
            with reading(path) as file:
                return str(attribute(path, file, "program") or "").startswith(MARK)
        except UnreadableFile:
            return False

    def _open(self) -> Any:
        attributes = {"sha256": UNSEALED, "program": f"{MARK} {__version__}", "settings": self.settings}
        return GrowingFile(self.path, attributes, {name: {"unit": unit} for name, unit in UNITS.items()})

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""
        self.file.append(_columns(chunk))


class CsvWriter(Writer):
    """One column an axis, below comments that say how to read them."""

    axes: ClassVar[str] = "xyz"

    @staticmethod
    def ours(path: Path) -> bool:
        """Whether the file was written here."""
        try:
            with path.open("rb") as file:
                return file.read(len(MARK) + 2) == f"# {MARK}".encode()
        except OSError:
            return False

    def _open(self) -> Any:
        return self.path.open("wb")

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""
        import polars as pl

        columns = _columns(chunk)
        table = {name: self._names(name, values) for name, values in columns.items()}
        begun = self.file.tell() > 0
        if not begun:
            self.file.write(self._comments(table).encode())
        flat = [
            pl.Series(column, np.ascontiguousarray(part))
            for name, values in columns.items()
            for column, part in zip(table[name], np.atleast_2d(values.T), strict=True)
        ]
        self.file.write(pl.DataFrame(flat).write_csv(include_header=not begun).encode())

    def _names(self, name: str, values: Array) -> list[str]:
        if values.ndim == 1:
            return [name]
        count = values.shape[1]
        return [f"{name}_{axis}" for axis in (self.axes[:count] if count <= len(self.axes) else range(count))]

    def _comments(self, table: dict[str, list[str]]) -> str:
        lines = [f"{MARK} {__version__}, {UNSEALED}; to read it:", "source:", "  kind: csv", "  channels:"]
        for name, columns in table.items():
            unit = f", unit: {UNITS[name]}" if name in UNITS else ""
            named = [yaml_text(column) for column in columns]
            path = named[0] if len(named) == 1 else f"[{', '.join(named)}]"
            lines.append(f"    {yaml_text(name)}: {{path: {path}{unit}}}")
        return "\n".join(map(comment, [*lines, f"settings: {self.settings}"])) + "\n"


def written_units(path: Path) -> dict[str, str]:
    """Return the units of channels that the comments of a CSV of ours say; none of any other file."""
    with suppress(OSError, UnicodeDecodeError, UnreadableFile):
        first = head(path, most=HEAD).decode("utf-8", "ignore")
        comments = "".join(takewhile(lambda line: line.startswith("#"), first.splitlines(keepends=True)))
        if comments.startswith(f"# {MARK}"):
            return dict(re.findall(r"^# +(\w+): \{path: .*, unit: ([^}]+)\}$", comments, re.MULTILINE))
    return {}


WRITERS: dict[str, type[Writer]] = {".h5": Hdf5Writer, ".hdf5": Hdf5Writer, ".csv": CsvWriter}


def _columns(chunk: Chunk) -> dict[str, Array]:
    return {"time": chunk.t, **chunk.channels}
