"""Small Parquet files that declare more rows, values or bytes than they hold, by a writer of their format's own."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torture.bombs_of_logs import PIECE, RNG, many, packed, text


def thrift(value: Any) -> bytes:
    """Return a value in Thrift's compact protocol: bool, int (of 64 bits), bytes, list, dict of fields."""
    if isinstance(value, bytes):
        return varint(len(value)) + value
    if isinstance(value, list):
        kind = kind_of(value[0]) if value else 12
        head = bytes([len(value) << 4 | kind]) if len(value) < 15 else bytes([0xF0 | kind]) + varint(len(value))
        return head + b"".join(map(thrift, value))
    if isinstance(value, dict):
        return b"".join(bytes([kind_of(v)]) + varint(2 * k) + thrift(v) for k, v in value.items()) + b"\0"
    return varint(value << 1 ^ value >> 63)


def kind_of(value: Any) -> int:
    """Return the type of a value in that protocol."""
    return 8 if isinstance(value, bytes) else 9 if isinstance(value, list) else 12 if isinstance(value, dict) else 6


def varint(value: int) -> bytes:
    """Return a number, seven bits a byte."""
    value, out = value & (2**64 - 1), b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def levels(bits: int, runs: list[tuple[int, int]]) -> bytes:
    """Return runs of (count, value) behind their length."""
    return text(b"".join(varint(count << 1) + bytes([value]) for count, value in runs if count)) if bits else b""


def page(kind: int, header: dict[int, Any], data: bytes, unpacked: int | None = None) -> bytes:
    """Return a page: of data (0) or a dictionary (2)."""
    size = len(data) if unpacked is None else unpacked
    fields = [(1, kind), (2, size), (3, len(data)), (5 if kind == 0 else 7, header)]
    return (
        b"".join(bytes([12 if k > 4 else 5]) + varint(2 * k) + thrift32(v) for k, v in fields)
        + b"\0"[:0]
        + b"\0"
        + data
    )


def thrift32(value: Any) -> bytes:
    """Return a value whose numbers are of 32 bits."""
    if isinstance(value, dict):
        return b"".join(bytes([5]) + varint(2 * k) + thrift32(v) for k, v in value.items()) + b"\0"
    return varint(value << 1 ^ value >> 63)


def parquet(rng: RNG, path: Path) -> None:
    """Row groups, pages, lists and dictionaries that declare more values or bytes than they hold."""
    how = int(rng.integers(4))
    rows, values = many(rng, 3, 8.5), many(rng, 6, 9.3)
    lists, codec = how == 1, 6 if how == 2 else 0
    names = [b"time", b"gx", b"gy", b"gz", b"ax", b"ay", b"az", b"temperature"]
    schema: list[dict[int, Any]] = [{4: b"root", 5: len(names)}]
    out, chunks = [b"PAR1"], []
    for name in names:
        schema.append({1: 5, 3: 2 if lists else 0, 4: name})
        count = values if lists else rows
        runs = levels(1, [(1, 0), (values - 1, 1)]) + levels(1, [(values, 1)]) if lists else b""
        first = page(2, {1: 1, 2: 0}, bytes(8)) if codec == 0 else b""
        if codec == 0:
            data = page(0, {1: count, 2: 8, 3: 3, 4: 3}, runs + b"\1" + varint(count << 1) + b"\0")
        else:
            size = many(rng, 8, 9.32)
            data = page(
                0, {1: rows, 2: 0, 3: 3, 4: 3}, packed("zstd", bytes(1000), size), size // PIECE * PIECE + PIECE
            )
        begin = sum(map(len, out))
        out += [first, data]
        meta = {
            1: 5,
            2: [0, 8],
            3: [name],
            4: codec,
            5: count,
            6: 100,
            7: len(first) + len(data),
            9: begin + len(first),
        }
        chunks.append({2: begin, 3: meta | ({11: begin} if first else {})})
    rows = 1 if lists else many(rng, 3, 15) if how == 3 else rows
    groups = [{1: chunks, 2: 100, 3: rows}] * (many(rng, 0, 3) if how == 0 else 1)
    footer = thrift_file(schema, rows * len(groups), groups)
    path.write_bytes(b"".join(out) + footer + struct.pack("<I", len(footer)) + b"PAR1")


def thrift_file(schema: list[dict[int, Any]], rows: int, groups: list[Any]) -> bytes:
    """Return the footer, with the numbers of 32 bits where the format has them."""

    def struct_of(
        value: dict[int, Any], short: tuple[int, ...], inner: Callable[[int, Any], bytes] | None = None
    ) -> bytes:
        parts = []
        for k, v in value.items():
            kind = 5 if k in short and isinstance(v, int) else kind_of(v)
            parts.append(bytes([kind]) + varint(2 * k) + (inner(k, v) if inner else thrift(v)))
        return b"".join(parts) + b"\0"

    def lists(items: list[bytes]) -> bytes:
        return b"\xfc" + varint(len(items)) + b"".join(items)

    def numbers(v: list[int]) -> bytes:
        return bytes([len(v) << 4 | 5]) + b"".join(varint(2 * x) for x in v)

    def meta(k: int, v: Any) -> bytes:
        return numbers(v) if k == 2 else thrift(v)

    def column(k: int, v: Any) -> bytes:
        return struct_of(v, (1, 4), meta) if k == 3 else thrift(v)

    def group(k: int, v: Any) -> bytes:
        return lists([struct_of(c, (), column) for c in v]) if k == 1 else thrift(v)

    def whole(k: int, v: Any) -> bytes:
        if k == 2:
            return lists([struct_of(node, (1, 2, 3, 5)) for node in v])
        return lists([struct_of(g, (), group) for g in v]) if k == 4 else thrift(v)

    return struct_of({1: 1, 2: schema, 3: rows, 4: groups}, (1,), whole)


def footers(rng: RNG, path: Path) -> None:
    """Footers of a great many columns, of columns in columns, of lists that are not there."""
    how, count = int(rng.integers(4)), many(rng, 3, 5.5)
    if how == 0:
        schema = [{4: b"root", 5: count}, *({1: 5, 3: 0, 4: b"c%d" % k} for k in range(count))]
        footer = thrift_file(schema, 0, [])
    elif how == 1:
        schema = [{4: b"root", 5: 1}, *({3: 0, 4: b"gx", 5: 1} for _ in range(count)), {1: 5, 3: 0, 4: b"gx"}]
        footer = thrift_file(schema, 0, [])
    elif how == 2:
        footer = b"\x05\x02\x02\x09\x04\xfc" + varint(many(rng, 6, 18)) + bytes(20)
    else:
        footer = b"\x1c" * count + bytes(count)
    declared = len(footer) if rng.integers(3) else many(rng, 3, 9.5)
    path.write_bytes(b"PAR1" + footer + struct.pack("<I", declared) + b"PAR1")
    if declared > len(footer):
        with path.open("r+b") as file:
            file.seek(10**10)
            file.write(footer + struct.pack("<I", declared) + b"PAR1")


FORMATS: dict[str, Callable[[RNG, Path], None]] = {"parquet pages": parquet, "parquet footers": footers}
SUFFIXES = {"parquet": ".parquet"}
