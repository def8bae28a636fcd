"""MCAP files: chunks of messages between schemas and channels, then a summary that says where they are.

::

    record   op u8, length u64, content                    3 schema, 4 channel, 5 message, 6 chunk, 8 index of a chunk,
                                                           11 statistics, 15 end of data, 2 footer

A file without a footer was not closed, and one may be written without a summary or without chunks: its records are then
walked over, and what a cut chunk still holds is read. A chunk whose checksum is wrong is left out.

Source: the format's description, mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Set
from pathlib import Path
from typing import BinaryIO, ClassVar
from zlib import crc32

from fusion_core.budget import LISTED, PIECE, TEXTS, check_count, check_size, size_of
from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag import storage

SIGNATURE = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, STATISTICS, END, FOOTER = 3, 4, 5, 6, 8, 11, 15, 2
HEAD = struct.Struct("<BQ")
STAMPED = struct.Struct("<BQHIQQ")  # a message: op, length, channel, sequence, time of the log, time of publishing
CHUNK_HEAD = struct.Struct("<QQQI")  # first and last time, size when unpacked, checksum
LANGUAGES = {"ros2msg": "msg", "ros1msg": "msg", "ros2idl": "idl", "omgidl": "idl"}
REPAIR = "`mcap recover IN -o OUT` repairs it"
READ = 4 << 20  # bytes of messages outside chunks that are read at a time, where there is more than one


class Mcap(storage.ChunkedFile):
    """An open file."""

    repair: ClassVar[str] = REPAIR

    def __init__(self, path: Path, file: BinaryIO, faults: Faults) -> None:
        self._schemas: dict[int, tuple[str, str, str]] = {}  # name, encoding, text
        self._channels: dict[int, tuple[int, str, str]] = {}  # schema, topic, encoding
        self._counts: dict[int, int] = {}
        super().__init__(path, file, faults)

    def count(self, connection: int) -> int:
        """Return the number of messages of a connection."""
        return self._counts.get(connection, 0)

    def _connected(self) -> Iterator[storage.Connection]:
        for number, (schema, topic, encoding) in sorted(self._channels.items()):
            name, form, text = self._schemas.get(schema, ("", "", ""))
            yield storage.Connection(number, topic, storage.ros2_name(name), text, LANGUAGES.get(form, ""), encoding)

    def _indexed(self) -> bool:
        end = self.size - HEAD.size - 20 - len(SIGNATURE)
        footer = self.data[max(end, 0) :]
        if end < len(SIGNATURE) or HEAD.unpack_from(footer) != (FOOTER, 20):
            return False
        at = struct.unpack_from("<Q", footer, HEAD.size)[0]
        if not footer.endswith(SIGNATURE) or not 0 < at < self.size:
            return False
        check_size(self.path, "the summary", end - at, PIECE)
        declared = None
        try:
            while at < end:
                op, length = self._head(at)
                begin, at = at + HEAD.size, at + HEAD.size + length
                content = self.data[begin : min(at, end)]
                self.clock.tick()
                self._describe(op, content)
                if op == INDEX:
                    _, _, offset, size, pairs = struct.unpack_from("<QQQQI", content)
                    self._add(storage.Piece(offset, _pairs(content[32 : 36 + pairs]) or None, size))
                elif op == STATISTICS:
                    declared = struct.unpack_from("<QHIIIIQQ", content)
                    self._counts = _pairs(content[42:])
        except (struct.error, UnicodeDecodeError):
            return False
        if declared is None or len(self.pieces) != declared[5] or len(self._channels) < declared[2]:
            return False
        known = self._channels.keys() >= self._counts.keys()
        return known and (declared[0] == 0 or bool(self.pieces))  # else its messages stand outside chunks

    def _add(self, piece: storage.Piece) -> None:
        self.pieces.append(piece)
        check_count(self.path, "chunks", len(self.pieces))

    def _describe(self, op: int, content: bytes) -> None:
        """Keep a schema or a channel."""
        if op == SCHEMA:
            number = int.from_bytes(content[:2], "little")
            name, at = _text(content, 2)
            form, at = _text(content, at)
            schema = (name.decode(), form.decode(), _text(content, at)[0].decode("utf-8", "replace"))
            if self._schemas.get(number) != schema:
                self._add_text(len(content), "schemas and channels")
            self._schemas[number] = schema
        elif op == CHANNEL:
            number, of = struct.unpack_from("<HH", content)
            topic, at = _text(content, 4)
            channel = (of, topic.decode(), _text(content, at)[0].decode())
            if self._channels.get(number) != channel:
                self._add_text(len(content), "schemas and channels")
            self._channels[number] = channel

    def _learn(self, op: int, content: bytes, at: int) -> None:
        """Keep a schema or a channel; one that is damaged is counted as lost."""
        try:
            self._describe(op, content)
        except (struct.error, UnicodeDecodeError):
            self._lose(len(content), f"at byte {at}, a schema or a channel")

    def _scan(self) -> None:
        self._counts = {}
        at, op = len(SIGNATURE), 0
        while at + HEAD.size <= self.size and op not in (END, FOOTER):
            self.clock.tick()
            op, length = self._head(at)
            end = at + HEAD.size + length
            if op == MESSAGE:
                end = self._loose(at)
            elif op == CHUNK:
                self._look(storage.Piece(at, None, end - at))
                end = min(end, self.size)
            elif end > self.size or op == 0:
                break
            elif op in (SCHEMA, CHANNEL):
                check_size(self.path, f"the record at byte {at}", length, TEXTS)
                self._learn(op, self.data[at + HEAD.size : end], at)
            if end == at:
                break
            at = end
        if op not in (END, FOOTER):
            self.faults.add(f"file that was not closed, read without its summary; {REPAIR}", 1, f"in {self.path.name}")
            self._lose(self.size - at, f"at byte {at}")

    def _head(self, at: int) -> tuple[int, int]:
        """Return type and length of the record at an offset."""
        op, length = HEAD.unpack(self.data[at : at + HEAD.size])
        return op, length

    def _loose(self, at: int) -> int:
        """Keep messages that stand outside chunks, from an offset on; return where they end."""
        end = at
        while end + STAMPED.size <= self.size:
            op, length = self._head(end)
            step = end + HEAD.size + length
            if op != MESSAGE or step > self.size or (end > at and step > at + READ):
                break
            check_size(self.path, f"the message at byte {end}", length, LISTED)
            end = step
        if end > at:
            self._look(storage.Piece(at, None, end - at, chunk=False))
        return end

    def _look(self, piece: storage.Piece) -> None:
        """Keep a piece with the number of its messages."""
        counts = storage.counted(self._messages(piece, self._content(piece), None))
        for number, n in counts.items():
            self._counts[number] = self._counts.get(number, 0) + n
        if counts:
            self._add(piece._replace(counts=counts))

    def _content(self, piece: storage.Piece) -> bytes:
        what = f"the chunk at byte {piece.offset}"
        data = self._stored(what, piece.offset, piece.offset + piece.length)
        if not piece.chunk:
            return data
        try:
            op, length = HEAD.unpack_from(data)
            _, _, size, checksum = CHUNK_HEAD.unpack_from(data, HEAD.size)
            name, at = _text(data, HEAD.size + CHUNK_HEAD.size)
            stored = struct.unpack_from("<Q", data, at)[0]
        except struct.error:
            op, length, size, checksum, name, at, stored = 0, 0, 0, 0, b"", 0, 0
        good = op == CHUNK and HEAD.size + length == piece.length
        records, whole = b"", False
        if good:
            what = f"{what}, which declares {size_of(size)},"
            records, whole = storage.unpacked(data[at + 8 : at + 8 + stored], name.decode("latin-1"), self.path, what)
        if whole and len(records) == size and checksum and crc32(records) != checksum:
            records = b""
        if not records and (size or not good):
            self._lose(len(data), f"in the chunk at byte {piece.offset}")
        return records

    def _walk(self, data: bytes, wanted: Set[int] | None) -> tuple[storage.ChunkMessages, int]:
        messages: storage.ChunkMessages = {}
        at, total, unpack = 0, len(data), STAMPED.unpack_from
        while at + HEAD.size <= total:
            if data[at] == MESSAGE and at + STAMPED.size <= total:
                _, length, channel, _, time, _ = unpack(data, at)
                end = at + HEAD.size + length
                if end > total or length < STAMPED.size - HEAD.size:
                    break
                if wanted is None or channel in wanted:
                    messages.setdefault(channel, []).extend((time, at + STAMPED.size, end - at - STAMPED.size))
            else:
                op, length = HEAD.unpack_from(data, at)
                end = at + HEAD.size + length
                if end > total or op == 0:
                    break
                self.clock.tick()
                if wanted is None:
                    self._learn(op, data[at + HEAD.size : end], at)
            at = end
        return messages, at


def _text(content: bytes, at: int) -> tuple[bytes, int]:
    """Return the bytes whose length stands before them, and where they end."""
    begin = at + 4
    end = begin + storage.U32.unpack_from(content, at)[0]
    return content[begin:end], end


def _pairs(content: bytes) -> dict[int, int]:
    """Return a map of channels to numbers."""
    size = storage.U32.unpack_from(content)[0]
    return dict(struct.iter_unpack("<HQ", content[4 : 4 + size]))
