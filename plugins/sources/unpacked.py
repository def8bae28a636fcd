"""The bytes of a file, unpacked where they are a gzip archive; `-` is standard input.

Standard input is taken as it is asked for, and kept in a temporary file without a name, so that it can be read as often
as a recording is: once for each config that is compared, again to find the number of a line that is wrong. What is no
recording is refused by its beginning, and nothing is left behind however the program ends.
"""

from __future__ import annotations

import io
import os
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from threading import Lock
from typing import IO, Any, BinaryIO

from fusion_core.budget import COPIED, TEXTS, check_all, keep, no_room, size_of, temporary_folder, unpacked_at_most
from fusion_core.contracts import Table, head
from fusion_core.errors import FusionError, UnreadableFile
from fusion_core.faults import Faults

STANDARD_INPUT = Path("-")
GZIP = b"\x1f\x8b"
WITH_HEADER = 31  # what zlib calls a member of a gzip archive
READ = 1 << 16  # bytes of an archive at a time
BUFFER = 1 << 17  # of what it holds
Stream = io.BufferedReader


@contextmanager
def opened(path: Path) -> Iterator[Stream]:
    """Open the plain bytes of a file.

    Raises
    ------
    UnreadableFile
        If it is not there, empty, or a damaged archive, which may show only while it is read.
    Unwritable
        If standard input cannot be kept.
    """
    if path != STANDARD_INPUT:
        head(path)
    with path.open("rb") if path != STANDARD_INPUT else io.BufferedReader(_StandardInput(), BUFFER) as file:
        if not beginning(file, path).startswith(GZIP):  # type: ignore[arg-type]
            yield file  # type: ignore[misc]
            return
        try:
            with io.BufferedReader(_Members(path, file), BUFFER) as unpacked:
                yield unpacked  # type: ignore[misc]
        except (EOFError, zlib.error) as error:
            raise damaged(path, str(error)) from None


@contextmanager
def plain_file(path: Path) -> Iterator[Path]:
    """Yield the path of a file's plain bytes: its own, or of a gzip archive that of a temporary file.

    Raises
    ------
    UnreadableFile, Unwritable
        If the archive is damaged or too large, or the file cannot be kept.
    """
    if not path.is_file() or not head(path).startswith(GZIP):  # what is no file its own reader refuses
        yield path
        return
    with temporary_folder(path) as folder:
        place = folder / (path.stem if path.suffix == ".gz" else path.name)
        with opened(path) as packed, place.open("wb") as file:
            while data := packed.read(COPIED):
                keep(path, data, file, unpacked_at_most(path))
        try:
            yield place
        except FusionError as error:
            raise type(error)(str(error).replace(str(place), str(path))) from None


Open = Callable[[Any, Path, Faults], AbstractContextManager[Table]]


def unpacking(own: Callable[[Any, Path, Faults], Iterator[Table]]) -> Open:
    """Make the `open` of a source of a function that yields the table, and let it read gzip archives of its files too.

    As `contextlib.contextmanager` does.
    """

    @contextmanager
    @wraps(own)
    def open_(self: Any, path: Path, faults: Faults) -> Iterator[Table]:
        with plain_file(path) as place:
            yield from own(self, place, faults)

    return open_


def damaged(path: Path, reason: str) -> UnreadableFile:
    """Return the error of a file that is not as its format asks."""
    return UnreadableFile(f"{path}: is cut short or damaged ({reason}); copy or record it again")


@contextmanager
def translated(path: Path, *errors: type[BaseException]) -> Iterator[None]:
    """Turn the errors of a library, while it has a file open, into the error of a damaged one.

    So also the panic of one that is written in Rust, which is no exception.
    """
    try:
        yield
    except (FusionError, MemoryError):
        raise
    except BaseException as error:
        if not (isinstance(error, errors) or type(error).__name__ == "PanicException"):
            raise
        raise damaged(path, " ".join(str(error).split()).strip("'\"")[:160]) from None


def beginning(file: Stream, path: Path) -> bytes:
    """Return the first bytes of an open file and go back to them; raises UnreadableFile where there are none."""
    first = file.read(4096)
    file.seek(0)
    if not first:
        none = "0 bytes" if path == STANDARD_INPUT else "0 bytes when unpacked"
        raise UnreadableFile(f"{path}: is empty ({none}); nothing was written to it, or a copy failed")
    return first


@cache
def _standard_input() -> tuple[io.BufferedReader, IO[bytes], Lock]:
    """Return standard input, the file that keeps what came of it, and their lock: a thread may read ahead."""
    if sys.stdin is None or sys.stdin.isatty():
        raise UnreadableFile("-: standard input is a terminal, a recording was expected; pipe one in, or name a file")
    stream = sys.stdin.buffer
    with suppress(AttributeError, OSError, ValueError):  # the first on Windows
        os.set_blocking(stream.fileno(), True)  # else nothing yet looks like the end
    try:
        return stream, tempfile.TemporaryFile(), Lock()  # type: ignore[return-value]
    except OSError as error:
        raise no_room(STANDARD_INPUT, error) from None


class _Seekable(io.RawIOBase):
    """Bytes that are read from a place `at` on."""

    at = 0

    def readable(self) -> bool:
        """Return True if it can be read."""
        return True

    def seekable(self) -> bool:
        """Return True, since `seek` is possible."""
        return True


class _StandardInput(_Seekable):
    """Standard input from its beginning."""

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place in what was read."""
        if whence == io.SEEK_END:
            raise io.UnsupportedOperation("the end is not known")
        self.at = offset + (self.at if whence == io.SEEK_CUR else 0)
        return self.at

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read into a buffer; return the number of bytes, 0 at the end."""
        stream, file, lock = _standard_input()
        with lock:
            if self.at < file.seek(0, io.SEEK_END):
                file.seek(self.at)
                data = file.read(len(buffer))
            else:
                data = stream.read1(len(buffer))
                keep(STANDARD_INPUT, data, file)
        buffer[: len(data)] = data
        self.at += len(data)
        return len(data)


class _Members(_Seekable):
    """The content of the members of a gzip archive, one after the other; zeros behind one are padding."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self._rewind()

    def _rewind(self) -> None:
        self.file.seek(0)
        self.engine, self.left, self.at, self.inside = zlib.decompressobj(WITH_HEADER), b"", 0, False
        self.idle = 0  # bytes since some that held anything

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place in the unpacked bytes, at the cost of unpacking what lies before."""
        offset += self.at if whence == io.SEEK_CUR else 0
        if whence == io.SEEK_END:
            raise io.UnsupportedOperation("the end is not known")
        if offset < self.at:
            self._rewind()
        while self.at < offset and self.read(min(offset - self.at, BUFFER)):
            pass
        return self.at

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Unpack into a buffer; return the number of bytes, 0 at the end."""
        data = self._next(len(buffer)) if len(buffer) else b""
        buffer[: len(data)] = data
        self.at += len(data)
        return len(data)

    def _next(self, most: int) -> bytes:
        while True:
            check_all()
            if self.engine.eof:
                self.engine, self.left, self.inside = zlib.decompressobj(WITH_HEADER), self.engine.unused_data, False
            packed = self.left or self._packed()
            self.left = b""
            if not self.inside:
                ended, packed = not packed, packed.lstrip(b"\0")
                if ended:
                    return b""
                if not packed:
                    continue
            self.inside = True
            data = self.engine.decompress(packed, most)
            self.left = self.engine.unconsumed_tail
            if data:
                self.idle = 0
                return data
            if not packed and not self.engine.eof:
                raise EOFError("Compressed file ended before the end-of-stream marker was reached")

    def _packed(self) -> bytes:
        self.idle += READ
        if self.idle > TEXTS:
            raise UnreadableFile(
                f"{self.path}: has more than {size_of(TEXTS)} that unpack to nothing, which is the limit; pack it again"
            )
        return self.file.read(READ)
