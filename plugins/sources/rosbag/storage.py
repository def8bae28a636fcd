"""The storage of a bag: connections, and their messages as bytes, many at a time; files of chunks, and compression."""

from __future__ import annotations

import struct
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, NamedTuple

import numpy as np

from fusion_core.budget import LISTED, TEXTS, TimeBudget, check_size, inflated
from fusion_core.chunk import Integers
from fusion_core.errors import UnreadableFile, quote
from fusion_core.faults import Faults

U32 = struct.Struct("<I")
ZSTD = b"\x28\xb5\x2f\xfd"  # what a message begins with that was compressed on its own; CDR begins with a zero


class Connection(NamedTuple):
    """The messages of one type on one topic, from one who publishes them.

    Attributes
    ----------
    id : int
        Unique in its file.
    topic, type : str
        As `/imu/data` and `sensor_msgs/msg/Imu`.
    definition : str
        Of the type, in the words of a .msg or .idl file; empty where the file has none.
    language : str
        `msg`, `idl`, or empty.
    encoding : str
        `cdr` (ROS 2), `ros1`, or what else the file says.
    """

    id: int
    topic: str
    type: str
    definition: str
    language: str
    encoding: str


class Batch(NamedTuple):
    """Some messages of one connection: the k-th is `data[starts[k] : starts[k] + sizes[k]]`.

    Attributes
    ----------
    connection : int
    times : (n,) array of int64
        When each was recorded, ns.
    data : bytes
    starts, sizes : (n,) arrays of int64
    """

    connection: int
    times: Integers
    data: bytes
    starts: Integers
    sizes: Integers


ChunkMessages = dict[int, list[int]]
"""Messages of one chunk by connection: time, start and size of each, one after the other."""


class Piece(NamedTuple):
    """A chunk, or messages that stand outside chunks; their number by connection, None where it is not known."""

    offset: int
    counts: Mapping[int, int] | None
    length: int = 0
    chunk: bool = True


class FileBytes:
    """The bytes of an open file by slices, as far as they are there; a file of any size takes no memory."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.size = file, file.seek(0, 2)

    def __getitem__(self, part: slice) -> bytes:
        begin, end, _ = part.indices(self.size)
        self.file.seek(begin)
        return self.file.read(max(end - begin, 0))


class ChunkedFile(ABC):
    """An open bag file of chunks, with an index that one which was not closed lacks: it is then walked over."""

    repair: ClassVar[str]

    def __init__(self, path: Path, file: BinaryIO, faults: Faults) -> None:
        self.path, self.data, self.faults = path, FileBytes(file), faults
        self.size = self.data.size
        self.pieces: list[Piece] = []
        self._texts = 0  # bytes of definitions and topics
        self._told: set[str] = set()  # places whose losses were reported
        self.clock = TimeBudget(path, "what is no message")
        with self.clock:
            if not self._indexed():
                self.pieces = []
                self._scan()
        self.connections = list(self._connected())

    @abstractmethod
    def count(self, connection: int) -> int:
        """Return the number of messages of a connection."""

    @abstractmethod
    def _indexed(self) -> bool:
        """Read the index; False where there is none, or it does not tell all."""

    @abstractmethod
    def _scan(self) -> None:
        """Find the pieces of a file without an index, record after record."""

    @abstractmethod
    def _connected(self) -> Iterator[Connection]:
        """Yield the connections."""

    @abstractmethod
    def _content(self, piece: Piece) -> bytes:
        """Return the records of a piece as far as they are whole, unpacked."""

    @abstractmethod
    def _walk(self, data: bytes, wanted: Set[int] | None) -> tuple[ChunkMessages, int]:
        """Return the messages in a piece (of all connections, by default), and where its last whole record ends."""

    def batches(self, wanted: Set[int]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, piece by piece."""
        for piece in self.pieces:
            if piece.counts is not None and wanted.isdisjoint(piece.counts):
                continue
            with self.clock:
                data = self._content(piece)
                messages = self._messages(piece, data, wanted)
            for connection, flat in messages.items():
                # a damaged time may be any
                times, starts, sizes = np.array(flat, dtype=np.uint64).view(np.int64).reshape(-1, 3).T
                yield Batch(connection, times, data, starts, sizes)

    def _messages(self, piece: Piece, data: bytes, wanted: Set[int] | None) -> ChunkMessages:
        """Return the messages in a piece; bytes behind its last whole record are reported."""
        messages, end = self._walk(data, wanted)
        self.clock.check(sum(counted(messages).values()))
        self._lose(len(data) - end, f"in the chunk at byte {piece.offset}")
        return messages

    def _stored(self, what: str, begin: int, end: int) -> bytes:
        """Return bytes of the file as far as they are there; raises UnreadableFile beyond the budget."""
        check_size(self.path, what, min(end, self.size) - begin, LISTED)
        return self.data[begin:end]

    def _add_text(self, count: int, what: str) -> None:
        self._texts += count
        check_size(self.path, f"the text of its {what}", self._texts, TEXTS)

    def _lose(self, count: int, where: str) -> None:
        """Report bytes that are lost, once, however often they are met."""
        if count and where not in self._told:
            self._told.add(where)
            self.faults.add(f"bytes that are no whole record, lost; {self.repair}", count, where)


def counted(messages: ChunkMessages) -> dict[int, int]:
    """Return the number of messages of each connection."""
    return {connection: len(flat) // 3 for connection, flat in messages.items()}


def plain(batch: Batch, path: Path) -> Batch:
    """Return messages that were compressed one by one as they were before."""
    if not batch.data.startswith(ZSTD, int(batch.starts[0])):
        return batch
    messages, left = [], LISTED
    for start, end in zip(batch.starts, batch.starts + batch.sizes, strict=True):
        what = f"a batch of {len(batch.starts)} messages"
        messages.append(unpacked(batch.data[start:end], "zstd", path, what, left)[0])
        left -= len(messages[-1])
    return packed(batch.connection, batch.times, messages)


def packed(connection: int, times: Integers, messages: Sequence[bytes]) -> Batch:
    """Return messages of a connection as one batch."""
    sizes = np.array([len(data) for data in messages], dtype=np.int64)
    return Batch(connection, times, b"".join(messages), np.cumsum(sizes) - sizes, sizes)


def ros2_name(name: str) -> str:
    """Return the name of a type as ROS 2 writes it: `sensor_msgs/Imu` is `sensor_msgs/msg/Imu`."""
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}" if kind and "/" not in kind else name


def unpacked(data: bytes, compression: str, path: Path, what: str, most: int = LISTED) -> tuple[bytes, bool]:
    """Return the content of a chunk, as far as it is whole, and whether all of it was there.

    Raises
    ------
    UnreadableFile
        If the compression is unknown, or `what` holds more than `most` bytes.
    """
    if compression in ("", "none"):
        check_size(path, what, len(data), most)
        return data, True
    make = _decompressors().get(compression)
    if make is None:
        raise UnreadableFile(
            f"{path}: is compressed with '{quote(compression)}', bz2, lz4 or zstd was expected; rewrite it with one of "
            "them"
        )
    engine = make()
    try:
        return inflated(path, what, engine, data, most), engine.eof
    except UnreadableFile:
        raise
    except Exception:  # of a damaged chunk each library raises another one
        return b"", False


@cache
def _decompressors() -> dict[str, Callable[[], Any]]:
    """Return the makers of decompressors by kind; the extra `ros` brings the libraries along."""
    import bz2

    lz4 = import_module("lz4.frame")
    return {"bz2": bz2.BZ2Decompressor, "lz4": lz4.LZ4FrameDecompressor, "zstd": zstd().ZstdDecompressor}


def zstd() -> Any:
    """Return the module: Python has it from 3.14 on."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
