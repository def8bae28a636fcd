"""ROS 1 bags, version 2.0: chunks of messages, then, once the recorder has closed the file, an index of the chunks.

::

    record   length of header u32, header, length of data u32, data
    header   fields: length u32, name=value                           op 2 message, 3 bag, 5 chunk, 6 info, 7 connection

A bag without an index was not closed: its chunks are then found by walking over them. What a cut chunk still holds is
read. Only chunks that hold a wanted message are read at all.

Source: the format's description, wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Set
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from fusion_core.budget import LISTED, TEXTS, TimeBudget, check_count, check_size
from fusion_core.errors import UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag.storage import U32, Batch, ChunkMessages, Connection, ros2_name, unpacked

SIGNATURE = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, INFO, CONNECTION = 2, 5, 6, 7
LONGEST = 1 << 20  # bytes of a header
COUNTS = 4_000_000  # of messages by chunk and connection
VALUES = {b"conn": "I", b"op": "B", b"time": "Q"}
REPAIR = "`rosbag reindex` repairs a copy"


class BagChunk(NamedTuple):
    """Where a chunk is: the offset of its record, and how many messages of which connection it holds."""

    offset: int
    counts: Mapping[int, int]


class Ros1:
    """An open bag."""

    def __init__(self, path: Path, file: BinaryIO, faults: Faults) -> None:
        self.path, self.file, self.faults = path, file, faults
        self.size = file.seek(0, 2)
        self.connections: list[Connection] = []
        self.chunks: list[BagChunk] = []
        self._raw: dict[int, tuple[bytes, bytes]] = {}  # of each connection: topic, and the fields of its data
        self._form = _Form(b"")
        self._texts = 0  # bytes of connections
        self.clock = TimeBudget(path, "what is no message")
        with self.clock:
            self.scanned = not self._indexed()
            if self.scanned:
                self._raw, self.chunks, self._texts = {}, [], 0
                self._scan()
        self._connect()

    def count(self, connection: int) -> int | None:
        """Return how many messages a connection has."""
        return sum(chunk.counts.get(connection, 0) for chunk in self.chunks)

    def batches(self, wanted: Set[int]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, chunk by chunk."""
        for chunk in self.chunks:
            if not wanted.isdisjoint(chunk.counts):
                with self.clock:
                    data = self._chunk(chunk.offset, chunk.counts)[0]
                    found, end = self._walk(data, wanted)
                    self.clock.check(len(found))
                    if not self.scanned:
                        self._lost(len(data) - end, f"in the chunk at byte {chunk.offset}")
                yield from found.batches(data)

    def _indexed(self) -> bool:
        """Read the index; False where there is none, or it is not whole."""
        try:
            first = self._record(len(SIGNATURE))[0]
            start = int.from_bytes(first[b"index_pos"], "little")
            if not len(SIGNATURE) < start <= self.size or self.size - start > LISTED:
                return False
            self.file.seek(start)
            data, at, pairs = self.file.read(), 0, 0
            while at < len(data):
                self.clock.tick()
                header, begin, at = _record(data, at)
                if header[b"op"][0] == CONNECTION:
                    self._keep(header, data[begin:at])
                elif header[b"op"][0] == INFO:
                    pairs += (at - begin) // 8
                    check_count(self.path, "counts of messages in its index", pairs, COUNTS)
                    counts = dict(np.frombuffer(data[begin:at], "<u4").reshape(-1, 2).tolist())
                    self.chunks.append(BagChunk(int.from_bytes(header[b"chunk_pos"], "little"), counts))
            declared = tuple(int.from_bytes(first[name], "little") for name in (b"conn_count", b"chunk_count"))
        except (ValueError, KeyError, IndexError, struct.error):
            return False
        inside = all(chunk.offset < start for chunk in self.chunks)
        return inside and declared == (len(self._raw), len(self.chunks))

    def _scan(self) -> None:
        """Find the chunks of a bag that has no index, one after the other."""
        self.faults.add(f"bag that was not closed, read without its index; {REPAIR}", 1, f"in {self.path.name}")
        at, pairs = len(SIGNATURE), 0
        while at < self.size:
            self.clock.tick()
            try:
                header, begin, end = self._record(at)
                kind = header[b"op"][0]
                if kind == CHUNK:
                    data, whole = self._chunk(at, None)
                    found, walked = self._walk(data, None)
                    self.clock.check(len(found))
                    self.chunks.append(BagChunk(at, found.counts()))
                    pairs += len(found.messages) + 1
                    check_count(self.path, "connections in its chunks", pairs, COUNTS)
                    end = min(end, self.size)
                    if not whole and not walked:
                        self._lost(end - at, f"at byte {at}")
                    self._lost(len(data) - walked, f"in the chunk at byte {at}")
                elif kind == CONNECTION:
                    check_size(self.path, f"the connection at byte {at}", end - begin, TEXTS)
                    self.file.seek(begin)
                    self._keep(header, self.file.read(end - begin))
            except (ValueError, KeyError, IndexError, struct.error):
                self._lost(self.size - at, f"at byte {at}")
                return
            at = end

    def _connect(self) -> None:
        for number, (topic, data) in self._raw.items():
            try:
                fields = _fields(data)
                kind, text = fields[b"type"].decode(), fields[b"message_definition"].decode("utf-8", "replace")
            except (ValueError, KeyError, struct.error) as error:
                raise UnreadableFile(f"{self.path}: has a damaged connection ({error}); {REPAIR}") from None
            name = topic.decode("utf-8", "replace")
            self.connections.append(Connection(number, name, ros2_name(kind), text, "msg", "ros1"))

    def _keep(self, header: Mapping[bytes, bytes], data: bytes) -> None:
        number = U32.unpack(header[b"conn"])[0]
        if number not in self._raw:
            self._raw[number] = header[b"topic"], data
            self._texts += len(data) + len(header[b"topic"]) + 100  # of a small one the objects
            check_size(self.path, "the text of its connections", self._texts, TEXTS)

    def _record(self, at: int) -> tuple[dict[bytes, bytes], int, int]:
        """Return the header of the record at an offset of the file, and where its data begins and ends."""
        self.file.seek(at)
        length = U32.unpack(self.file.read(4))[0]
        if length > LONGEST:
            raise ValueError("no record")
        header = self.file.read(length + 4)
        begin = at + 8 + length
        return _fields(header[:-4]), begin, begin + U32.unpack(header[length:])[0]

    def _chunk(self, offset: int, counts: Mapping[int, int] | None) -> tuple[bytes, bool]:
        """Return what the chunk at an offset holds, and whether it is whole; what is lost is counted, with `counts`."""
        try:
            header, begin, end = self._record(offset)
            compression = header[b"compression"].decode()
        except (ValueError, KeyError, struct.error):
            self.faults.add("messages in damaged chunks, lost", sum((counts or {}).values()), f"at byte {offset}")
            return b"", False
        what = f"the chunk at byte {offset}"
        check_size(self.path, what, min(end, self.size) - begin, LISTED)
        self.file.seek(begin)
        stored = self.file.read(max(min(end, self.size) - begin, 0))
        what += f", which declares {int.from_bytes(header.get(b'size', b''), 'little')} bytes,"
        data, whole = unpacked(stored, compression, self.path, what)
        whole = whole and len(stored) == end - begin
        if not whole and counts is not None:
            found = self._walk(data, None)[0].counts()
            lost = sum(counts.values()) - sum(found.values())
            self.faults.add("messages in damaged chunks, lost", max(lost, 0), f"at byte {offset}")
        return data, whole

    def _walk(self, data: bytes, wanted: Set[int] | None) -> tuple[ChunkMessages, int]:
        """Return the messages in a chunk (of all connections, by default), and where its last whole record ends."""
        found, at, form = ChunkMessages(), 0, self._form
        messages = found.messages
        while at + form.size <= len(data):
            values = form.unpack_from(data, at)
            if form.fixed(values) != form.expected:
                if (step := self._other(data, at)) is None:
                    break
                at, form = step, self._form
                continue
            begin = at + form.size
            end = begin + values[-1]
            if end > len(data):
                break
            if wanted is None or values[form.connection] in wanted:
                time = values[form.time]
                messages.setdefault(values[form.connection], []).extend(
                    ((time & 0xFFFFFFFF) * 1_000_000_000 + (time >> 32), begin, values[-1])
                )
            at = end
        return found, at

    def _other(self, data: bytes, at: int) -> int | None:
        """Go past a record that does not look like the last message: where to go on, None where nothing is whole."""
        self.clock.tick()
        try:
            header, begin, end = _record(data, at)
            kind = header[b"op"][0]
            if kind == CONNECTION:
                self._keep(header, data[begin:end])
            if kind != MESSAGE:
                return end
            self._form = _Form(data[at : begin - 4])
        except (ValueError, KeyError, IndexError, struct.error):
            return None
        return at if self._form.size == begin - at else None

    def _lost(self, count: int, where: str) -> None:
        self.faults.add(f"bytes that are no whole record, lost; {REPAIR}", count, where)


class _Form:
    """How the header of a message stands in the file, so that the next one is read in one step."""

    def __init__(self, header: bytes) -> None:
        layout, at = "<I", 1
        constant: list[tuple[int, Any]] = [(0, len(header) - 4)]
        places: dict[bytes, int] = {}
        for name, value in (_fields(header[4:]) if header else {b"conn": b"", b"op": b"", b"time": b""}).items():
            form = VALUES.get(name, f"{len(value)}s")
            layout += f"I{len(name) + 1}s{form}"
            constant += [(at, len(name) + 1 + struct.calcsize(f"<{form}")), (at + 1, name + b"=")]
            places[name], at = at + 2, at + 3
        constant.append((places[b"op"], MESSAGE))
        whole = struct.Struct(f"{layout}I")
        self.size, self.unpack_from = whole.size, whole.unpack_from
        self.connection, self.time = places[b"conn"], places[b"time"]
        self.fixed: Any = itemgetter(*(place for place, _ in constant))
        self.expected = tuple(value for _, value in constant)


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields of a header; raises ValueError where it is none."""
    found, at = {}, 0
    while at < len(header):
        length = U32.unpack_from(header, at)[0]
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > len(header):
            raise ValueError("a field of a header is cut")
        found[name] = value
    return found


def _record(data: bytes, at: int) -> tuple[dict[bytes, bytes], int, int]:
    """Return the header of a record, and where its data begins and ends; raises ValueError where it is not whole."""
    length = U32.unpack_from(data, at)[0]
    if length > LONGEST:
        raise ValueError("no record")
    begin = at + 8 + length
    end = begin + U32.unpack_from(data, begin - 4)[0]
    if end > len(data):
        raise ValueError("a record is cut")
    return _fields(data[at + 4 : begin - 4]), begin, end
