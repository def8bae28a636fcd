"""What every kind of bag file gives: its connections, and their messages as bytes, many at a time."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterator, Set
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fusion_core.budget import LISTED, check_size, inflated
from fusion_core.errors import UnreadableFile, shown

if TYPE_CHECKING:
    from pathlib import Path

Integers = NDArray[np.int64]
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


class Storage(Protocol):
    """An open bag file."""

    connections: list[Connection]

    def count(self, connection: int) -> int | None:
        """Return how many messages a connection has, None where a damaged file does not tell."""

    def batches(self, wanted: Set[int]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections as they stand in the file."""


class ChunkMessages:
    """Messages of one chunk, by connection: time, start and size of each."""

    def __init__(self) -> None:
        self.messages: dict[int, list[int]] = {}

    def __len__(self) -> int:
        """Return the number of messages."""
        return sum(len(flat) for flat in self.messages.values()) // 3

    def counts(self) -> dict[int, int]:
        """Return the number of messages of each connection."""
        return {connection: len(flat) // 3 for connection, flat in self.messages.items()}

    def batches(self, data: bytes) -> Iterator[Batch]:
        """Yield them as arrays."""
        for connection, flat in self.messages.items():
            times, starts, sizes = (
                np.array(flat, dtype=np.uint64).view(np.int64).reshape(-1, 3).T
            )  # a damaged time may be any
            yield Batch(connection, times, data, starts, sizes)


def plain(batch: Batch, path: Path) -> Batch:
    """Return messages that were compressed one by one as they were before."""
    if not batch.data.startswith(ZSTD, int(batch.starts[0])):
        return batch
    messages, left = [], LISTED
    for start, end in zip(batch.starts, batch.starts + batch.sizes, strict=True):
        what = f"a batch of {len(batch.starts)} messages"
        messages.append(unpacked(batch.data[start:end], "zstd", path, what, left)[0])
        left -= len(messages[-1])
    sizes = np.array([len(data) for data in messages], dtype=np.int64)
    return batch._replace(data=b"".join(messages), starts=np.cumsum(sizes) - sizes, sizes=sizes)


def ros2_name(name: str) -> str:
    """Return the name of a type as ROS 2 writes it: `sensor_msgs/Imu` is `sensor_msgs/msg/Imu`."""
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}" if kind and "/" not in kind else name


def unpacked(data: bytes, compression: str, path: Path, what: str, most: int = LISTED) -> tuple[bytes, bool]:
    """Return what a chunk holds, as far as it is whole, and whether all of it was there.

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
            f"{path}: is compressed with '{shown(compression)}', bz2, lz4 or zstd was expected; rewrite it with one of "
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
    """Return what makes a decompressor of each kind; the extra `ros` brings the libraries along."""
    import bz2

    lz4 = import_module("lz4.frame")
    return {"bz2": bz2.BZ2Decompressor, "lz4": lz4.LZ4FrameDecompressor, "zstd": zstd().ZstdDecompressor}


def zstd() -> Any:
    """Return the module: Python has it from 3.14 on."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
