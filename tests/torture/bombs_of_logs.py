"""Small files of logs that declare much, inflate to much, or have no end.

Each name begins with the kind of the source that reads the file; `CHANNELS` are what it is to read.
"""

from __future__ import annotations

import bz2
import gzip
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from bags import FIELDS, Types

from torture.base import COLUMNS

RNG = np.random.Generator
PIECE = 1 << 22
IMU = "sensor_msgs/msg/Imu"
BEGAN = 1_700_000_000 * 10**9
CHANNELS: dict[str, dict[str, Any]] = {
    "rosbag": {name: field for name, field in FIELDS.items() if name != "temperature"},
    "ulog": {
        "time": {"path": "sensor_gyro.time"},
        "gyro": {"path": [f"sensor_gyro.{axis}" for axis in "xyz"]},
        "accel": {"path": [f"sensor_gyro.{axis}" for axis in "xyz"], "unit": "m/s^2"},
    },
    "dataflash": {
        "time": {"path": "IMU.TimeUS"},
        "gyro": {"path": [f"IMU.Gyr{axis}" for axis in "XYZ"]},
        "accel": {"path": [f"IMU.Acc{axis}" for axis in "XYZ"]},
    },
}


def many(rng: RNG, low: float, high: float) -> int:
    """Return a number between two powers of ten."""
    return int(10 ** rng.uniform(low, high))


def repeated(unit: bytes, size: int) -> Iterator[bytes]:
    """Yield at least `size` bytes of a unit again and again."""
    block = unit * max(PIECE // len(unit), 1)
    for _ in range(0, size, len(block)):
        yield block


def packed(kind: str, unit: bytes, size: int, before: bytes = b"") -> bytes:
    """Return what `before`, and then a unit up to `size` bytes, is when compressed."""
    if kind in ("", "none"):
        return before + b"".join(repeated(unit, min(size, 10**8)))
    if kind == "bz2":
        size = min(size, 5 * 10**8)
    if kind == "lz4":
        engine: Any = lz4.frame.LZ4FrameCompressor()
        return bytes(engine.begin() + engine.compress(before)) + b"".join(
            [*(engine.compress(block) for block in repeated(unit, size)), engine.flush()]
        )
    engine = {
        "zstd": lambda: import_module("backports.zstd").ZstdCompressor(),
        "bz2": bz2.BZ2Compressor,
        "gzip": lambda: zlib.compressobj(1, zlib.DEFLATED, 31),
    }[kind]()
    return b"".join([engine.compress(before), *(engine.compress(b) for b in repeated(unit, size)), engine.flush()])


def record(op: int, content: bytes, length: int | None = None) -> bytes:
    """Return a record of an MCAP file, of a length that may not be its own."""
    return struct.pack("<BQ", op, len(content) if length is None else length) + content


def text(content: bytes | str) -> bytes:
    """Return a text behind its length."""
    content = content.encode() if isinstance(content, str) else content
    return struct.pack("<I", len(content)) + content


def described(definition: str = "", number: int = 1, kind: str = IMU, topic: str = "/imu/data") -> bytes:
    """Return the records of a schema and a channel."""
    definition = definition or Types(False).store.generate_msgdef(IMU, ros_version=2)[0]
    schema = struct.pack("<H", number) + text(kind) + text("ros2msg") + text(definition)
    return record(3, schema) + record(4, struct.pack("<HH", number, number) + text(topic) + text("cdr") + text(b""))


def message(k: int, data: bytes | None = None) -> bytes:
    """Return the k-th message of a unit at rest."""
    t = BEGAN + k * 10**7
    data = Types(False).bytes(Types(False).imu(t, np.zeros(3), np.zeros(3))) if data is None else data
    return record(5, struct.pack("<HIQQ", 1, k, t, t) + data)


def chunk(stored: bytes, compression: str, declared: int, length: int | None = None) -> bytes:
    """Return the record of a chunk."""
    return record(
        6, struct.pack("<QQQI", 0, 2**62, declared, 0) + text(compression) + struct.pack("<Q", len(stored)) + stored,
        length,
    )  # fmt: skip


def mcap(path: Path, *parts: bytes, closed: bool = True) -> None:
    """Write an MCAP file without a summary."""
    end = record(15, bytes(4)) + record(2, bytes(20)) + b"\x89MCAP0\r\n"
    path.write_bytes(b"\x89MCAP0\r\n" + record(1, text("ros2") + text("bomb")) + b"".join(parts) + end * closed)


def mcap_chunk(rng: RNG, path: Path) -> None:
    """A chunk that inflates to gigabytes: of zeros, of messages, of records that nobody knows, of schemas."""
    kind = str(rng.choice(["zstd", "lz4", "bz2", ""]))
    size, head = many(rng, 8, 9.7), described()
    unit = [bytes(1000), message(0), record(200, b""), described() + message(1), record(5, bytes(22))][rng.integers(5)]
    declared = [size, 100, 0, 2**62][rng.integers(4)]
    mcap(path, head, message(0), chunk(packed(kind, unit, size, head), kind, declared), closed=bool(rng.integers(2)))


def mcap_declared(rng: RNG, path: Path) -> None:
    """Lengths that are not there: of chunks, messages, schemas, a summary, in a file that may have a hole behind it."""
    size = [2**62, 2**63 + 1, 2**64 - 10, many(rng, 9, 12)][rng.integers(4)]
    part = [
        chunk(b"abc", "zstd", 100, size),
        chunk(b"abc", "", size),
        record(5, bytes(22), size),
        record(3, bytes(22), size),
        record(4, bytes(22), size),
        record(9, bytes(22), size),
    ][rng.integers(6)]
    mcap(path, described(), message(0), part, closed=bool(rng.integers(2)))
    if rng.integers(2):
        hole = many(rng, 9, 12.5)
        index = struct.pack("<QQQQI", 0, 1, [8, size % 2**64][rng.integers(2)], size % 2**64, 0) + bytes(20)
        summary = described() + record(8, index) + record(11, struct.pack("<QHIIIIQQI", 9, 1, 1, 0, 0, 1, 0, 9, 0))
        with path.open("r+b") as file:
            file.seek(hole)
            file.write(summary * bool(rng.integers(2)))
            start = [hole, 100][rng.integers(2)]
            file.write(record(2, struct.pack("<QQI", start, 0, 0)) + b"\x89MCAP0\r\n")


def mcap_types(rng: RNG, path: Path) -> None:
    """Definitions in circles, in pairs of pairs, of a great many lines, and a great many topics."""
    line, how = "=" * 80 + "\nMSG: a/{}\n", int(rng.integers(6))
    pairs = "".join(line.format(f"T{k}") + f"T{k + 1} a\nT{k + 1} b\n" for k in range(many(rng, 1, 3)))
    definition = [
        "std_msgs/Header header\nT0 x\n" + pairs + line.format("T" + str(pairs.count("MSG"))) + "string s\n",
        "T1 x\n" + line.format("T1") + "T2 x\n" + line.format("T2") + "T1 x\nfloat64 y\n",
        "\n" * many(rng, 4, 6.5),
        "".join(f"float64 a{k}\n" for k in range(many(rng, 3, 5))),
        f"std_msgs/Empty[{many(rng, 6, 9.5)}] a\nfloat64 x\n" + line.replace("a/{}", "std_msgs/Empty"),
        f"float64[{many(rng, 6, 9.5)}] a\nfloat64 x\n",
    ][how]
    topics = b"".join(
        described(definition, k, f"a/msg/B{k}", "/imu/data" if k == 1 else f"/{k}")
        for k in range(1, 2 if rng.integers(2) or len(definition) > 1e5 else many(rng, 2, 4.5))
    )
    mcap(path, topics, *(message(k, b"\0\1\0\0" + bytes(64)) for k in range(9)))


def mcap_layouts(rng: RNG, path: Path) -> None:
    """Messages whose strings differ in length from one to the next, or are long, or are a great many."""
    n, longest = many(rng, 3, 5), many(rng, 2, 4.8)
    definition, body = "std_msgs/Header header\nstring[] names\nfloat64 x\n", bytes(24 + 8 * 40)
    header = "\n" + "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    time = "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    if rng.integers(2):
        definition = ""
    parts, size = [described(definition + (header + time) * bool(definition))], 0
    for k in range(n):
        length = longest if rng.integers(2) else int(rng.integers(1, longest))
        frame = bytes(4) * bool(definition) if rng.integers(9) == 0 else text(b"f" * length)
        count = struct.pack("<I", many(rng, 1, 7)) + bytes(longest) if definition else b""
        data = b"\0\1\0\0" + struct.pack("<iI", 1_700_000_000, k) + frame + bytes(-len(frame) % 4) + count + body
        parts.append(message(k, data))
        size += len(data)
        if size > 10**8:
            break
    mcap(path, parts[0], chunk(packed("zstd", b"\xc8" + bytes(8), 9, b"".join(parts)), "zstd", size))


def messages_zstd(rng: RNG, path: Path) -> None:
    """Messages that are compressed one by one, each of which inflates to far more."""
    bomb = packed("zstd", bytes(1000), many(rng, 7, 9.3))
    mcap(path, described(), *(message(k, bomb) for k in range(many(rng, 0, 2.5))))


def archive(rng: RNG, path: Path) -> None:
    """A bag in an archive that unpacks to gigabytes."""
    before = [b"\x89MCAP0\r\n", b"SQLite format 3\0"][rng.integers(2)] + described()
    path.with_name(path.name).write_bytes(packed("zstd", bytes(1000), many(rng, 8.5, 9.8), before))


def ros1(rng: RNG, path: Path) -> None:
    """A ROS 1 bag: a chunk that inflates, declares, or holds headers that differ; counts without end."""

    def head(data: bytes, length: int | None = None, **fields: bytes) -> bytes:
        header = b"".join(text(name.encode() + b"=" + value) for name, value in fields.items())
        return text(header) + struct.pack("<I", (len(data) if length is None else length) & 0xFFFFFFFF) + data

    definition = Types(True).store.generate_msgdef(IMU, ros_version=1)[0]
    about = b"".join(
        text(f"{name}={value}")
        for name, value in {"type": IMU, "md5sum": "x", "message_definition": definition}.items()
    )
    conn = head(about, op=b"\7", conn=bytes(4), topic=b"/imu/data")
    one = head(bytes(40), op=b"\2", conn=bytes(4), time=bytes(8))
    other = head(bytes(4), time=bytes(8), op=b"\2", conn=bytes(4))
    unit = [bytes(1000), one, one + other, head(b"", op=b"\7", conn=bytes(4), topic=b"x"), head(b"", op=b"\4")]
    kind = str(rng.choice(["bz2", "lz4", "none"]))
    stored = packed(kind, unit[rng.integers(5)], many(rng, 7, 9.5), conn + one)
    length = [None, None, 2**32 - 1][rng.integers(3)]
    big = head(stored, length, op=b"\5", compression=kind.encode(), size=struct.pack("<I", many(rng, 2, 9)))
    index = b"".join(head(bytes(8 * many(rng, 3, 6)), op=b"\6", chunk_pos=bytes(8)) for _ in range(many(rng, 0, 2)))
    begin = 4096 + len(big) if rng.integers(2) else 0
    single = struct.pack("<I", 1)
    first = head(b"", op=b"\3", index_pos=struct.pack("<Q", begin), conn_count=single, chunk_count=single)
    path.write_bytes(b"#ROSBAG V2.0\n" + first + big + (conn + index if begin else b""))
    if rng.integers(3) == 0:
        with path.open("r+b") as file:
            file.truncate(many(rng, 9, 12))


def sqlite(rng: RNG, path: Path) -> None:
    """A bag of sqlite3: values that are computed, pages in a circle, a view, a great many topics, large values."""
    how = int(rng.integers(7))
    with sqlite3.connect(path) as base:
        size = many(rng, 7, 8.9)
        slow = "cast(substr(hex(zeroblob(50000000)), 1, 1) AS BLOB)"
        value = {0: f"data AS (zeroblob({size}))", 6: f"data AS ({slow})"}.get(how, "data BLOB")
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        if how == 1:
            more = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"
            base.execute(
                f"CREATE VIEW messages AS {more} SELECT x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM n"
            )
        else:
            base.execute(f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, {value})")
        base.execute("INSERT INTO topics VALUES (1, '/imu/data', ?, 'cdr')", (IMU,))
        if how == 2:
            base.executemany("INSERT INTO topics VALUES (NULL, ?, ?, 'cdr')", ((f"/{k}", IMU) for k in range(10**5)))
        data = Types(False).bytes(Types(False).imu(BEGAN, np.zeros(3), np.zeros(3)))
        for k in range(0 if how == 1 else many(rng, 2, 4)):
            if how in (0, 6):
                base.execute("INSERT INTO messages(topic_id, timestamp) VALUES (1, ?)", (k,))
            else:
                base.execute("INSERT INTO messages VALUES (NULL, 1, ?, ?)", (k, data))
        if how == 3:
            base.execute("INSERT INTO messages VALUES (NULL, 1, 1, zeroblob(?))", (size,))
        if how == 4:
            base.execute("PRAGMA writable_schema = ON")
            base.execute("UPDATE sqlite_master SET sql = replace(sql, 'id INTEGER PRIMARY KEY', 'id INTEGER')")
    base.close()
    if how == 5:
        circle(path)


def circle(path: Path) -> None:
    """Make every interior page of a database point at one page again and again, itself where there are two levels."""
    data = bytearray(path.read_bytes())
    size = int.from_bytes(data[16:18], "big")
    for begin in range(size, len(data), size):
        if data[begin] == 5:  # an interior page: cells of 4 bytes of a page's number, and a key
            cells = int.from_bytes(data[begin + 3 : begin + 5], "big")
            for k in range(cells):
                at = begin + int.from_bytes(data[begin + 12 + 2 * k : begin + 14 + 2 * k], "big")
                data[at : at + 4] = struct.pack(">I", len(data) // size - 1)
    path.write_bytes(data)


def archived(rng: RNG, path: Path) -> None:
    """A gzip archive of zeros, of comments, of one line, of names, of padding, of empty members."""
    size = many(rng, 8, 9.7)
    header = ",".join(COLUMNS).encode() + b"\n" + b"0,0,0,0,0,0,-9.8,20\n"
    how = int(rng.integers(6))
    if how < 3:
        path.write_bytes(packed("gzip", [bytes(1000), b"# a comment\n", b"1,"][how], size, header))
    elif how == 3:
        path.write_bytes(b"\x1f\x8b\x08\x08" + bytes(6) + b"x" * min(size, 3 * 10**8))
    else:
        member = gzip.compress(header if how == 4 else b"")
        path.write_bytes(gzip.compress(header) + member * (1 if how == 4 else 10**6))
        with path.open("r+b") as file:
            file.truncate(10**12 if how == 4 else path.stat().st_size)


def noise(rng: RNG, path: Path) -> None:
    """Bytes that are no frame, in a file with a hole or an archive."""
    unit = [bytes(1), b"\xa5", b"\xa5\x5a", b"$", b"\xff"][rng.integers(5)]
    if rng.integers(2):
        path.write_bytes(packed("gzip", unit, many(rng, 8, 9.7)))
    else:
        path.write_bytes(unit * PIECE)
        with path.open("r+b") as file:
            file.truncate(many(rng, 8, 12))


def ulog(rng: RNG, path: Path) -> None:
    """Formats of arrays in arrays, in circles; subscriptions, parameters, dropouts and rows without end."""

    def one(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    gyro = one("F", b"sensor_gyro:uint64_t timestamp;uint32_t device_id;float x;float y;float z;float temperature;")
    wide, depth = int(rng.choice([9, 99, 999, 65535])), int(rng.integers(1, 30))
    nest = b"".join(one("F", b"f%d:f%d[%d] a;" % (k, k + 1, wide)) for k in range(depth))
    formats = [
        nest + one("F", b"f%d:uint8_t[%d] a;" % (depth, wide)),
        one("F", b"f0:f0 a;uint64_t timestamp;"),
        one("F", b"f0:uint8_t[2000000000] a;"),
        one("F", b"f0:" + b"".join(b"uint8_t a%d;" % k for k in range(700))),
        nest + one("F", b"f%d:" % depth),
    ][rng.integers(5)]
    row = one("D", struct.pack("<HQI4f", 1, 0, 9, 0, 0, 0, 20))
    added = one("A", b"\0" + struct.pack("<H", 1) + b"sensor_gyro")
    unit = [
        one("A", b"\0\2\0f0"),
        one("P", b"\x0afloat abcd" + bytes(4)),
        one("O", bytes(2)),
        one("I", b"\x0achar[9] ab" + bytes(400)),
        one("L", bytes(40)),
        b"\xff" * 9,
        row,
        one("Q", b"\xff\x0afloat abcd" + bytes(4)),
    ][rng.integers(8)]
    start = b"ULog\x01\x125\1" + bytes(8) + gyro + formats + added + one("A", b"\0\2\0f0") + row * 9
    with path.open("wb") as file:
        file.write(start)
        for block in repeated(unit, many(rng, 3, 8)):
            file.write(block)
        file.write(row)
        if rng.integers(3) == 0:
            file.truncate(many(rng, 9, 12))


def dataflash(rng: RNG, path: Path) -> None:
    """Descriptions, parameters that toggle, units and records in doubt without end."""

    def fmt(kind: int, length: int, name: bytes, letters: bytes, labels: bytes) -> bytes:
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, name, letters, labels)

    def row(kind: int, form: str, *values: Any) -> bytes:
        return b"\xa3\x95" + bytes([kind]) + struct.pack(f"<{form}", *values)

    start = fmt(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    start += fmt(1, 35 + 4, b"IMU", b"Qffffffff", b"TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T,E")
    start = start.replace(struct.pack("<BB", 1, 39), struct.pack("<BB", 1, 43), 1)
    start += fmt(2, 31, b"PARM", b"QNf", b"TimeUS,Name,Value") + fmt(
        3, 44, b"FMTU", b"QBNN", b"TimeUS,FmtType,UnitIds,MultIds"
    )
    start += fmt(4, 3, b"NONE", b"", b"")
    imu = row(1, "Q8f", 10, *[0.0] * 7, 1.0)
    parameters = b"".join(row(2, "Q16sf", 1, b"INS_GYROFFS_X", value) for value in (1.0, 2.0))
    unit = [
        fmt(7, 9, b"ABCD", b"BB", b"A,B") + fmt(7, 9, b"ABCE", b"BB", b"A,C"),
        parameters,
        row(3, "QB16s16s", 1, 1, b"s", b"F"),
        row(4, ""),
        imu[:-1] + b"x" * 9,
        bytes(7),
        imu + parameters,
        b"\xa3",
    ][rng.integers(8)]
    with path.open("wb") as file:
        file.write(start + imu * 20)
        for block in repeated(unit, many(rng, 3, 8)):
            file.write(block)
        file.write(imu * 9)
        if rng.integers(3) == 0:
            file.truncate(many(rng, 9, 12))


FORMATS: dict[str, Callable[[RNG, Path], None]] = {
    "rosbag chunk": mcap_chunk, "rosbag declared": mcap_declared, "rosbag types": mcap_types,
    "rosbag layouts": mcap_layouts, "rosbag messages": messages_zstd, "rosbag archive": archive, "rosbag ros1": ros1,
    "rosbag sqlite": sqlite, "csv archive": archived, "binary_log archive": archived, "binary_log noise": noise,
    "ulog formats": ulog, "dataflash records": dataflash,
}  # fmt: skip
SUFFIXES = {
    "rosbag": ".mcap", "rosbag archive": ".mcap.zstd", "rosbag ros1": ".bag", "rosbag sqlite": ".db3", "csv": ".csv",
    "binary_log": ".bin", "ulog": ".ulg", "dataflash": ".bin",
}  # fmt: skip
