"""The bytes of a file, unpacked where they are a gzip archive; `-` is standard input.

Standard input is kept in a temporary file, so that it can be read as often as a recording is: once for each config that
is compared, again to find the number of a line that is wrong.
"""

from __future__ import annotations

import atexit
import io
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import BinaryIO

from fusion_core.budget import TimeBudget, keep, no_room
from fusion_core.contracts import head
from fusion_core.errors import UnreadableFile

STANDARD_INPUT = Path("-")
GZIP = b"\x1f\x8b"
WITH_HEADER = 31  # what zlib calls a member of a gzip archive
READ = 1 << 16  # bytes of an archive at a time
BUFFER = 1 << 17  # of what it holds
SECONDS = 5e-8  # that an unpacked byte may cost: members may be empty, and padded without end
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
    where = _standard_input() if path == STANDARD_INPUT else path
    if not head(where, path).startswith(GZIP):
        with where.open("rb") as file:
            yield file
        return
    try:
        with where.open("rb") as file, io.BufferedReader(_Members(path, file), BUFFER) as unpacked:
            yield unpacked  # type: ignore[misc]
    except (EOFError, zlib.error) as error:
        raise damaged(path, str(error)) from None


def damaged(path: Path, reason: str) -> UnreadableFile:
    """Return the error of a file that is not as its format asks."""
    return UnreadableFile(f"{path}: is cut short or damaged ({reason}); copy or record it again")


def beginning(file: Stream, path: Path) -> bytes:
    """Return the first bytes of an open file and go back to them; raises UnreadableFile where there are none."""
    first = file.read(4096)
    file.seek(0)
    if not first:
        raise UnreadableFile(f"{path}: is empty (0 bytes when unpacked); nothing was written to it, or a copy failed")
    return first


@cache
def _standard_input() -> Path:
    """Return a temporary file with all of standard input, which is removed at exit."""
    if sys.stdin is None or sys.stdin.isatty():
        raise UnreadableFile("-: standard input is a terminal, a recording was expected; pipe one in, or name a file")
    try:
        file = tempfile.NamedTemporaryFile(prefix="driftlab-")  # noqa: SIM115
        atexit.register(file.close)
    except OSError as error:
        raise no_room(STANDARD_INPUT, error) from None
    try:
        keep(STANDARD_INPUT, sys.stdin.buffer, file)
    except BaseException:
        file.close()
        raise
    return Path(file.name)


class _Members(io.RawIOBase):
    """The content of the members of a gzip archive, one after the other; zeros behind one are padding."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.clock = TimeBudget(path, "what unpacks to next to nothing")
        self._rewind()

    def _rewind(self) -> None:
        self.file.seek(0)
        self.engine, self.left, self.at, self.inside = zlib.decompressobj(WITH_HEADER), b"", 0, False

    def readable(self) -> bool:
        """Return True if it can be read."""
        return True

    def seekable(self) -> bool:
        """Return True if `seek` is possible, at the cost of unpacking what lies before."""
        return True

    def tell(self) -> int:
        """Return the place in the unpacked bytes."""
        return self.at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place in the unpacked bytes."""
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
        with self.clock:
            data = self._next(len(buffer)) if len(buffer) else b""
            self.clock.seconds += len(data) * SECONDS
        buffer[: len(data)] = data
        self.at += len(data)
        return len(data)

    def _next(self, most: int) -> bytes:
        while True:
            self.clock.tick()
            if self.engine.eof:
                self.engine, self.left, self.inside = zlib.decompressobj(WITH_HEADER), self.engine.unused_data, False
            packed = self.left or self.file.read(READ)
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
                return data
            if not packed and not self.engine.eof:
                raise EOFError("Compressed file ended before the end-of-stream marker was reached")
