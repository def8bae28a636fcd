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
from typing import Any, BinaryIO, ClassVar

import numpy as np

from fusion_core.budget import LISTED, TEXTS, check_count, check_size
from fusion_core.errors import UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag import storage

SIGNATURE = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, INFO, CONNECTION = 2, 5, 6, 7
LONGEST = 1 << 20  # bytes of a header
COUNTS = 4_000_000  # of messages by chunk and connection
VALUES = {b"conn": "I", b"op": "B", b"time": "Q"}
REPAIR = "`rosbag reindex` repairs a copy"
DAMAGED = (ValueError, KeyError, IndexError, struct.error)  # what a record raises that is none


class Ros1(storage.ChunkedFile):
    """An open bag."""

    repair: ClassVar[str] = REPAIR

    def __init__(self, path: Path, file: BinaryIO, faults: Faults) -> None:
        self._raw: dict[int, tuple[bytes, bytes]] = {}  # of each connection: topic, and the fields of its data
        self._form = _HeaderLayout(b"")
        super().__init__(path, file, faults)

    def count(self, connection: int) -> int:
        """Return the number of messages of a connection."""
        return sum((piece.counts or {}).get(connection, 0) for piece in self.pieces)

    def _indexed(self) -> bool:
        try:
            first = _record(self.data, len(SIGNATURE))[0]
            start = at = int.from_bytes(first[b"index_pos"], "little")
            if not len(SIGNATURE) < start <= self.size or self.size - start > LISTED:
                return False
            pairs = 0
            while at < self.size:
                self.clock.tick()
                header, begin, at = _record(self.data, at)
                if at > self.size:
                    return False
                if header[b"op"][0] == CONNECTION:
                    self._keep(header, self.data[begin:at])
                elif header[b"op"][0] == INFO:
                    pairs += (at - begin) // 8
                    check_count(self.path, "counts of messages in its index", pairs, COUNTS)
                    counts = dict(np.frombuffer(self.data[begin:at], "<u4").reshape(-1, 2).tolist())
                    self.pieces.append(storage.Piece(int.from_bytes(header[b"chunk_pos"], "little"), counts))
            declared = tuple(int.from_bytes(first[name], "little") for name in (b"conn_count", b"chunk_count"))
        except DAMAGED:
            return False
        inside = all(piece.offset < start for piece in self.pieces)
        return inside and declared == (len(self._raw), len(self.pieces))

    def _scan(self) -> None:
        self._raw, self._texts = {}, 0
        self.faults.add(f"bag that was not closed, read without its index; {REPAIR}", 1, f"in {self.path.name}")
        at, pairs = len(SIGNATURE), 0
        while at < self.size:
            self.clock.tick()
            try:
                header, begin, end = _record(self.data, at)
                kind = header[b"op"][0]
                if kind == CHUNK:
                    data, whole = self._chunk(at, None)
                    end = min(end, self.size)
                    if not whole and not self._walk(data, None)[1]:
                        self._lose(end - at, f"at byte {at}")
                    counts = storage.counted(self._messages(storage.Piece(at, None), data, None))
                    self.pieces.append(storage.Piece(at, counts))
                    pairs += len(counts) + 1
                    check_count(self.path, "connections in its chunks", pairs, COUNTS)
                elif kind == CONNECTION:
                    check_size(self.path, f"the connection at byte {at}", end - begin, TEXTS)
                    self._keep(header, self.data[begin:end])
            except DAMAGED:
                self._lose(self.size - at, f"at byte {at}")
                return
            at = end

    def _connected(self) -> Iterator[storage.Connection]:
        for number, (topic, data) in self._raw.items():
            try:
                fields = _fields(data)
                kind, text = fields[b"type"].decode(), fields[b"message_definition"].decode("utf-8", "replace")
            except (ValueError, KeyError, struct.error) as error:
                raise UnreadableFile(f"{self.path}: has a damaged connection ({error}); {REPAIR}") from None
            name = topic.decode("utf-8", "replace")
            yield storage.Connection(number, name, storage.ros2_name(kind), text, "msg", "ros1")

    def _keep(self, header: Mapping[bytes, bytes], data: bytes) -> None:
        number = storage.U32.unpack(header[b"conn"])[0]
        if number not in self._raw:
            self._raw[number] = header[b"topic"], data
            self._add_text(len(data) + len(header[b"topic"]) + 100, "connections")  # of a small one the objects

    def _content(self, piece: storage.Piece) -> bytes:
        return self._chunk(piece.offset, piece.counts)[0]

    def _chunk(self, offset: int, counts: Mapping[int, int] | None) -> tuple[bytes, bool]:
        """Return the records of a chunk and whether it is whole; missing messages of its `counts` are reported."""
        try:
            header, begin, end = _record(self.data, offset)
            compression = header[b"compression"].decode()
        except DAMAGED:
            self.faults.add("messages in damaged chunks, lost", sum((counts or {}).values()), f"at byte {offset}")
            return b"", False
        what = f"the chunk at byte {offset}"
        stored = self._stored(what, begin, end)
        what += f", which declares {int.from_bytes(header.get(b'size', b''), 'little')} bytes,"
        data, whole = storage.unpacked(stored, compression, self.path, what)
        whole = whole and end <= self.size
        if not whole and counts is not None:
            lost = sum(counts.values()) - sum(storage.counted(self._walk(data, None)[0]).values())
            self.faults.add("messages in damaged chunks, lost", max(lost, 0), f"at byte {offset}")
        return data, whole

    def _walk(self, data: bytes, wanted: Set[int] | None) -> tuple[storage.ChunkMessages, int]:
        messages: storage.ChunkMessages = {}
        at, form = 0, self._form
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
        return messages, at

    def _other(self, data: bytes, at: int) -> int | None:
        """Go past a record that does not look like the last message: where to go on, None where nothing is whole."""
        self.clock.tick()
        try:
            header, begin, end = _record(data, at)
            kind = header[b"op"][0]
            if end > len(data):
                return None
            if kind == CONNECTION:
                self._keep(header, data[begin:end])
            if kind != MESSAGE:
                return end
            self._form = _HeaderLayout(data[at : begin - 4])
        except DAMAGED:
            return None
        return at if self._form.size == begin - at else None


class _HeaderLayout:
    """The layout of the header of a message, by which the next one is read in one step."""

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
    fields, at = {}, 0
    while at < len(header):
        length = storage.U32.unpack_from(header, at)[0]
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > len(header):
            raise ValueError("a field of a header is cut")
        fields[name] = value
    return fields


def _record(data: bytes | storage.FileBytes, at: int) -> tuple[dict[bytes, bytes], int, int]:
    """Return the header of a record, and where its data begins and ends, which may be behind the end of all."""
    length = storage.U32.unpack(data[at : at + 4])[0]
    if length > LONGEST:
        raise ValueError("no record")
    begin = at + 8 + length
    return _fields(data[at + 4 : begin - 4]), begin, begin + storage.U32.unpack(data[begin - 4 : begin])[0]
