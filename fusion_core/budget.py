"""The budget of a reader: the limits of size and time for a file of unknown origin, beside the cost of its rows.

A header, a chunk or an archive can declare any size, and a few bytes can inflate to any number. So every reader asks
here before it makes room for a piece that has to be held whole, inflates no further than the budget, and gives up on
what has no end. `docs/explanation/robustness.md` states the figures.
"""

from __future__ import annotations

import errno
import io
import math
import os
import stat
import tempfile
import time
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, BinaryIO, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from fusion_core.errors import UnreadableFile, Unwritable

PIECE = 512_000_000  # bytes of a piece (row group, variable, index) that is held whole
LISTED = 128_000_000  # bytes of a piece whose messages are listed one by one
TEXTS = 64_000_000  # bytes of all definitions (schemas, formats, parameters)
COUNT = 1_000_000  # pieces of one sort (chunks, parameters, subscriptions) that are listed
TOTAL = 1_500_000_000  # bytes of memory in all, over what the rows cost
MAX_TEMPORARY = 16_000_000_000  # bytes of a temporary file,
RATIO, MIN_UNPACKED = 100, 1_000_000_000  # and of an archive so many times its own, or at least so many
SECONDS = 30.0  # of the processor, for what yields no rows: with all else it stays below a minute
PACE = 1e8  # bytes a second: what a file takes on the disk may be passed over at that
COPIED = 1 << 20  # bytes at a time
ROW = 2e-5  # s that a row, or a message, may cost beside
LISTING = 20.0  # s of looking for what a file holds, which is done more than once
FILE = 16_000_000  # bytes of a file of settings, a map or the like, which is read whole
NAMES = 100_000  # data sets, groups and variables of a file
DEEPEST = 32  # of them within one another
UNWRITTEN = 1_000_000  # rows that a file declares and does not hold, over as many as it holds
NAME = 64  # characters of a channel, a kind, a unit
TEXT = 100_000  # characters of another text in the record of a map


class Decompressor(Protocol):
    """An engine that inflates, as those of bz2, lz4 and zstd do."""

    def decompress(self, data: bytes, max_length: int = -1) -> bytes:
        """Return at most `max_length` bytes."""


def size_of(count: float) -> str:
    """Return a number of bytes in words, as `1.2 GB`."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count:.0f} bytes"


def check_regular(path: Path) -> None:
    """Raise an OSError that says so where a path, or what it links to, is a pipe or a device: they may never end."""
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", str(path))


def read_whole(path: Path, most: int = FILE) -> bytes:
    """Return the content of a file.

    Raises
    ------
    OSError
        If it cannot be read, is a pipe or a device, or holds more than `most` bytes; `strerror` says which.
    """
    check_regular(path)
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(min(size, most) + 1)  # room is made for all that is asked for
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has {size_of(size)}, at most {size_of(most)} are read", str(path))
    return data


def arrays_in(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of an archive as `np.savez` writes it: no objects, nothing compressed, so that it is as large.

    Raises ValueError or BadZipFile where it is anything else.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries) or (
            sum(entry.file_size for entry in entries) > len(content)
        ):
            raise ValueError("it is compressed, or declares more than it holds")
        return {
            entry.filename.removesuffix(".npy"): _array(archive.read(entry), f"the array '{entry.filename}'")
            for entry in entries
        }


def next_array(file: BinaryIO) -> NDArray[Any]:
    """Return the next array of a file as `np.save` writes it; raises ValueError or EOFError where it is none."""
    place = file.tell()
    shape, _, dtype = _header_of(file)
    if math.prod(shape) * dtype.itemsize > os.fstat(file.fileno()).st_size - place:
        raise ValueError("an array declares more than it holds")
    file.seek(place)
    return np.lib.format.read_array(file, allow_pickle=False)


_Header = tuple[tuple[int, ...], bool, np.dtype[Any]]  # shape, whether columns come first, and type


def _header_of(file: IO[bytes]) -> _Header:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    header: _Header = read(file)
    return header


@lru_cache(maxsize=256)
def _known_header(text: bytes) -> _Header:
    """Return the fields of a header: files of one kind have the same, and to parse one takes as long as its array.

    Raises ValueError where it is none.
    """
    return _header_of(io.BytesIO(text))


def _array(data: bytes, what: str) -> NDArray[Any]:
    """Return an array as `np.save` writes it; raises ValueError where it is none, or declares more than there is."""
    begin = 10 if data[6:7] == b"\x01" else 12
    size = begin + int.from_bytes(data[8:begin], "little")
    shape, by_columns, dtype = _known_header(data[:size])
    if dtype.hasobject:
        raise ValueError(f"{what} holds objects")
    if math.prod(shape) * dtype.itemsize > len(data) - size:
        raise ValueError(f"{what} declares more than it holds")
    return np.ndarray(shape, dtype, data, size, order="F" if by_columns else "C").copy()


def rows_at_once(path: Path, what: str, size: int, row: float) -> int:
    """Return the number of rows of `row` bytes each that are read at once: `size`, or as many as the budget allows.

    Raises UnreadableFile where it does not allow a single one.
    """
    check_size(path, f"one row of {what}", row)
    return max(1, min(size, int(PIECE // max(row, 1))))


def check_size(path: Path, what: str, size: float, most: float = PIECE) -> None:
    """Raise UnreadableFile where a piece is larger than the budget.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        The piece, as `row group 3` or `the chunk at byte 132`.
    size, most : float
        Bytes that it takes in memory, and that it may take.
    """
    if size > most:
        raise UnreadableFile(
            f"{path}: {what} takes {size_of(size)}, at most {size_of(most)} are read at once; write it in smaller "
            "pieces"
        )


def inflated(path: Path, what: str, engine: Decompressor, data: bytes, most: int = PIECE) -> bytes:
    """Return the content of compressed bytes, as far as they are whole; raises UnreadableFile beyond the budget."""
    content = engine.decompress(data, max_length=most + 1)
    if len(content) > most:
        raise UnreadableFile(
            f"{path}: {what} of {size_of(len(data))} inflates to more than {size_of(most)}, which is the limit; write "
            "it in smaller pieces"
        )
    return content


def check_count(path: Path, what: str, count: int, most: int = COUNT) -> None:
    """Raise UnreadableFile where a file has more of `what`, as `chunks`, than are listed."""
    if count > most:
        raise UnreadableFile(f"{path}: has {count:,} {what}, at most {most:,} are read; write it with fewer")


def on_disk(path: Path) -> int:
    """Return the bytes that a file takes on its disk: those of a hole are none."""
    try:
        status = path.stat()
    except OSError:
        return 0
    return min(status.st_size, 512 * getattr(status, "st_blocks", status.st_size))


def unpacked_at_most(path: Path) -> int:
    """Return the bytes that a temporary file with what an archive holds may have."""
    return min(MAX_TEMPORARY, max(MIN_UNPACKED, RATIO * on_disk(path)))


def keep(path: Path, data: bytes, to: IO[bytes], most: float = math.inf) -> None:
    """Write the next bytes of what a stream gives into a temporary file, at its end.

    Raises
    ------
    UnreadableFile
        If the stream is longer than `most` bytes, and than MAX_TEMPORARY.
    Unwritable
        If there is no room for the file.
    """
    most = min(most, MAX_TEMPORARY)
    if to.tell() + len(data) > most:
        what = "standard input has" if path == Path("-") else "unpacks to"
        raise UnreadableFile(
            f"{path}: {what} more than {size_of(most)}, which is the limit; write it to a file yourself, or split it"
        )
    try:
        to.write(data)
        to.flush()
    except OSError as error:
        raise no_room(path, error) from None


FOLDERS: list[tempfile.TemporaryDirectory[str]] = []  # for who ends the program at once, and a thread is in one


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Make a folder in TMPDIR for what a file unpacks to, and remove it; raises Unwritable where it cannot be made."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="driftlab-", ignore_cleanup_errors=True)
    except OSError as error:
        raise no_room(path, error) from None
    FOLDERS.append(folder)
    with folder as name:
        yield Path(name)
    FOLDERS.remove(folder)


def no_room(path: Path, error: OSError) -> Unwritable:
    """Return the error of a temporary file that cannot be written."""
    what = "standard input" if path == Path("-") else "what it unpacks to"
    full = " and there is no room in TMPDIR" if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else ""
    return Unwritable(
        f"{path}: {what} cannot be kept in {tempfile.gettempdir()} ({error.strerror or error}){full}; make room there, "
        "or name another folder in TMPDIR"
    )


class TimeBudget:
    """The time of a step that yields no rows, from when it is made; where it is entered, of what is done inside alone.

    The limit is `seconds`, what the file's bytes on the disk take at `PACE`, and `ROW` for each row that came. Within
    `of_all`, or `over` of another, a step ends with that clock too.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What is done, as `63,000,000 lines of comments`.
    seconds, row : float
        Of the processor, and those for a row.
    """

    def __init__(self, path: Path, what: str, seconds: float = SECONDS, row: float = ROW) -> None:
        self.path, self.what, self.seconds, self.row = path, what, seconds + on_disk(path) / PACE, row
        self.now, self.used, self.ticks = time.process_time, 0.0, 0
        self.begun = self.now()
        self.all = _ALL.get()

    def __enter__(self) -> Self:
        self.begun = self.now()
        self.check()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.check()
        now = self.now()
        self.used, self.begun = self.used + now - self.begun, now

    def check(self, rows: int = 0) -> None:
        """Raise UnreadableFile where the step has taken longer than it may, which is more by what `rows` may cost."""
        self.seconds += rows * self.row
        if self.all is not None:
            self.all.check(rows)
        if self.used + self.now() - self.begun > self.seconds:
            raise UnreadableFile(
                f"{self.path}: {self.what} took more than {self.seconds:.0f} s of the processor, which is the limit; "
                "write the recording anew"
            )

    def over(self, items: Iterable[Any]) -> Iterator[Any]:
        """Yield items; while each is made this is the clock of all steps, of the thread that makes it alone.

        What is done with them takes no time, nor what other threads do while a pipe is waited for.
        """
        iterator, self.now = iter(items), time.thread_time
        while True:
            token = _ALL.set(self)
            try:
                with self:
                    item = next(iterator, None)
            finally:
                _ALL.reset(token)
            if item is None:
                return
            yield item

    def tick(self) -> None:
        """Check at each 1024th call: of what is done for a few bytes."""
        self.ticks += 1
        if not self.ticks & 1023:
            self.check()


_ALL: ContextVar[TimeBudget | None] = ContextVar("of all attempts", default=None)


def check_all(rows: int = 0) -> None:
    """Raise UnreadableFile where all steps within `of_all`, or of a reading, have taken longer than they may.

    Of a reading that is more by what `rows` may cost.
    """
    if (clock := _ALL.get()) is not None:
        clock.check(rows)


@contextmanager
def of_all(path: Path, what: str, seconds: float = SECONDS) -> Iterator[None]:
    """Give one clock to attempts at a file that each have theirs: together they take what one may.

    A reader whose file is refused for one thing may be asked for another; where the time of all is over, each further
    attempt ends with that at its next check.
    """
    token = _ALL.set(TimeBudget(path, what, seconds, row=0.0))
    try:
        yield
    finally:
        _ALL.reset(token)
