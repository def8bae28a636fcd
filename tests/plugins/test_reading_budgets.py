"""Files of logs and columns that declare much, inflate to much or have no end: one line, and in time."""

import io
import sqlite3
import struct
import sys
import tempfile
import time
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1]))

from torture import bombs_of_columns
from torture import bombs_of_logs as bombs

from fusion_core import budget
from fusion_core.contracts import Source
from fusion_core.errors import DataError, UnreadableFile, Unwritable
from fusion_core.faults import Faults
from fusion_core.host.registry import registry
from fusion_plugins.sources import unpacked

MCAP = b"\x89MCAP0\r\n"


def read(kind, path, channels=None, **more):
    """Return the number of rows."""
    settings = {"kind": kind, "path": path, "channels": channels or bombs.CHANNELS[kind], **more}
    return sum(
        len(chunk.t) for chunk in registry().classes(Source)[kind].model_validate(settings).chunks(4096, Faults())
    )


@pytest.mark.parametrize(("kind", "declared"), [("zstd", 100), ("lz4", 2**62), ("bz2", 135_000_000)])
def test_a_chunk_inflates_no_further_than_the_budget(tmp_path, kind, declared):
    stored = bombs.packed(kind, bytes(1000), 135_000_000)
    bombs.mcap(tmp_path / "a.mcap", bombs.described(), bombs.chunk(stored, kind, declared))
    assert (tmp_path / "a.mcap").stat().st_size < 2_000_000
    with pytest.raises(UnreadableFile, match=r"which declares .*inflates to more than 128 MB, which is the limit"):
        read("rosbag", tmp_path / "a.mcap")


@pytest.mark.parametrize("length", [2**62, 2**63 + 1, 2**64 - 10, 10**11])
def test_a_declared_length_makes_no_room(tmp_path, length):
    for part in (
        bombs.chunk(b"abc", "zstd", 100, length),
        bombs.record(5, bytes(22), length),
        bombs.record(3, bytes(22), length),
    ):
        bombs.mcap(tmp_path / "a.mcap", bombs.described(), bombs.message(0), part, closed=False)
        assert read("rosbag", tmp_path / "a.mcap") == 1  # what stands before it
        with (tmp_path / "a.mcap").open("r+b") as file:
            file.truncate(10**12)
        with suppress(UnreadableFile):
            assert read("rosbag", tmp_path / "a.mcap") == 1


def test_types_in_pairs_of_pairs_and_in_circles_end(tmp_path):
    line = "=" * 80 + "\nMSG: a/T{}\n"
    pairs = "T0 x\n" + "".join(line.format(k) + f"T{k + 1} a\nT{k + 1} b\n" for k in range(200)) + line.format(200)
    circle = "T1 x\n" + line.format(1) + "T2 x\n" + line.format(2) + "T1 x\nfloat64 y\n"
    for definition in (pairs + "string s\n", circle, "\n" * 10**6):
        bombs.mcap(tmp_path / "a.mcap", bombs.described(definition, kind="a/msg/B"), bombs.message(0))
        begun = time.process_time()
        with pytest.raises(DataError):
            read("rosbag", tmp_path / "a.mcap")
        assert time.process_time() - begun < 10


def test_an_archive_keeps_to_its_budget_and_a_full_disk_is_told_apart(tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "MIN_UNPACKED", 10_000_000)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    path = tmp_path / "a.mcap.zstd"
    path.write_bytes(bombs.packed("zstd", bytes(1000), 50_000_000, MCAP))
    with pytest.raises(UnreadableFile, match="unpacks to more than 10 MB, which is the limit"):
        read("rosbag", path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]

    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(28, "No space left on device")

    with pytest.raises(Unwritable, match=r"No space left on device\) and there is no room in TMPDIR; make room"):
        budget.keep(path, b"abc", Full())


def test_messages_that_are_packed_one_by_one_have_a_budget_together(tmp_path):
    bomb = bombs.packed("zstd", bytes(1000), 40_000_000)
    bombs.mcap(tmp_path / "a.mcap", bombs.described(), *(bombs.message(k, bomb) for k in range(5)))
    with pytest.raises(UnreadableFile, match=r"a batch of 5 messages .* inflates to more than"):
        read("rosbag", tmp_path / "a.mcap")


def test_a_database_gives_no_more_than_it_has(tmp_path):
    import sqlite3

    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        base.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data AS (zeroblob(1000000)))"
        )
        base.execute("INSERT INTO topics VALUES (1, '/imu/data', ?, 'cdr')", (bombs.IMU,))
        base.executemany("INSERT INTO messages(topic_id, timestamp) VALUES (1, ?)", ((k,) for k in range(100)))
    base.close()
    with pytest.raises(UnreadableFile, match="columns that are computed"):
        read("rosbag", path)
    data = path.read_bytes().replace(b"zeroblob(1000000)", b"zeroblob(900000000)"[:17])
    path.write_bytes(data)
    with pytest.raises(DataError):
        read("rosbag", path)


def test_the_members_of_an_archive_are_those_of_gzip(tmp_path):
    import gzip

    rng, whole = np.random.default_rng(0), b""
    packed = b""
    for size in (0, 1, 10, 100_000, 0, 300_000):
        part = rng.integers(0, 4, size, dtype=np.uint8).tobytes()
        whole, packed = whole + part, packed + gzip.compress(part) + bytes(int(rng.integers(0, 200)))
    path = tmp_path / "a.gz"
    path.write_bytes(packed + bytes(200_000))
    with unpacked.opened(path) as file:
        assert file.read() == whole == gzip.decompress(path.read_bytes())
        for at in (7, 250_000, 0, 399_000):
            file.seek(at)
            assert file.tell() == at
            assert file.read(999) == whole[at : at + 999]
    for cut in (20, len(packed) // 2, len(gzip.compress(b"abc")) - 1):
        path.write_bytes(packed[:cut] if cut > 22 else gzip.compress(b"abc" * 99)[:cut])
        with pytest.raises(UnreadableFile, match="cut short or damaged"), unpacked.opened(path) as file:
            file.read()
    for size in (1, 2, 3, 258, 65_536, 131_072, 131_073):
        path.write_bytes(gzip.compress(bytes(size)))
        with unpacked.opened(path) as file:
            assert len(file.read()) == size


def test_padding_without_end_is_given_up(tmp_path):
    path = tmp_path / "a.gz"
    path.write_bytes(zlib.compress(b"abc", wbits=31))
    with path.open("r+b") as file:
        file.truncate(10**13)
    with pytest.raises(UnreadableFile, match="more than 64 MB that unpack to nothing"), unpacked.opened(path) as file:
        file.read()


def test_rows_of_one_group_are_read_in_spans(tmp_path):
    """40,000,000 rows that take 8 bytes each, and 90 kB in the file."""
    import polars as pl

    n = 40_000_000
    pl.select(x=pl.repeat(1.0, n)).write_parquet(tmp_path / "a.parquet", row_group_size=n)
    from fusion_plugins.sources.parquet import SPAN, RowGroups

    spans = list(RowGroups(tmp_path / "a.parquet").spans({"x"}))
    assert sum(rows for _, rows in spans) == n
    assert all(8 * rows <= SPAN for _, rows in spans)
    assert [begin for begin, _ in spans] == np.cumsum([0, *(rows for _, rows in spans[:-1])]).tolist()


@pytest.mark.parametrize("seed", [0, 1, *range(3, 8), *range(9, 12), 13, 14])  # others make sparse files of 10 GB
def test_footers_and_pages_are_refused_or_read(tmp_path, seed):
    rng = np.random.default_rng(seed)
    path = tmp_path / "a.parquet"
    (bombs_of_columns.parquet if seed % 2 else bombs_of_columns.footers)(rng, path)
    channels = {"time": {"path": "time", "unit": "s"}, "gyro": {"path": ["gx", "gy", "gz"], "unit": "rad/s"}}
    begun = time.process_time()
    with suppress(DataError):
        read("parquet", path, channels)
    assert time.process_time() - begun < 60


def test_formats_of_arrays_in_arrays_are_refused(tmp_path):
    def one(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    gyro = one("F", b"sensor_gyro:uint64_t timestamp;uint32_t device_id;float x;float y;float z;")
    row = one("A", b"\0\1\0sensor_gyro") + one("D", struct.pack("<HQI3f", 1, 9, 9, 0, 0, 0)) * 9
    head = b"ULog\x01\x125\1" + bytes(8) + gyro
    nest = b"".join(one("F", b"f%d:f%d[999] a;" % (k, k + 1)) for k in range(20)) + one("F", b"f20:uint8_t[999] a;")
    for formats in (nest, one("F", b"f0:f0 a;uint64_t timestamp;")):
        (tmp_path / "a.ulg").write_bytes(head + formats + row + one("A", b"\0\2\0f0") + row)
        with pytest.raises(UnreadableFile, match="numbers in the rows of f0"):
            read("ulog", tmp_path / "a.ulg")
    toggles = one("P", b"\x0afloat abcd" + bytes(4)) * 600_000
    (tmp_path / "a.ulg").write_bytes(head + row + toggles)
    with pytest.raises(UnreadableFile, match="parameters, dropouts and the like, at most"):
        read("ulog", tmp_path / "a.ulg")


def test_the_descriptions_and_parameters_of_a_vehicle_are_counted(tmp_path):
    def fmt(kind, length, name, letters, labels):
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, name, letters, labels)

    start = fmt(1, 43, b"IMU", b"Qffffffff", b"TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T,E")
    start += fmt(2, 31, b"PARM", b"QNf", b"TimeUS,Name,Value")
    rows = b"".join(b"\xa3\x95\1" + struct.pack("<Q8f", 1000 * k, *[0.0] * 8) for k in range(20))
    parameters = b"".join(b"\xa3\x95\2" + struct.pack("<Q16sf", 1, b"INS_GYROFFS_X", k) for k in range(11_000))
    (tmp_path / "a.bin").write_bytes(start + parameters + rows)
    with pytest.raises(UnreadableFile, match="10,999 changes of the inertial units' parameters"):
        read("dataflash", tmp_path / "a.bin")
    (tmp_path / "a.bin").write_bytes(start + rows + fmt(7, 9, b"ABCD", b"BB", b"A,B") * 100_100)
    with pytest.raises(UnreadableFile, match="descriptions of messages"):
        read("dataflash", tmp_path / "a.bin")


@pytest.mark.parametrize("table", ["messages", "topics"])
def test_nothing_of_a_bag_of_sqlite_is_computed(tmp_path, table):
    """A view, a column that is generated and a virtual table may take any time, for each row anew."""
    slow = "AS (cast(substr(hex(zeroblob(50000000)), 1, 1) AS BLOB))"
    columns = {"topics": "id, name, type, serialization_format", "messages": "id, topic_id, timestamp, data"}
    for how, matter in enumerate(("columns that are computed", "tables topics and messages were expected")):
        path = tmp_path / f"{how}.db3"
        with sqlite3.connect(path) as base:
            for name, own in columns.items():
                if name != table:
                    base.execute(f"CREATE TABLE {name}({own})")
                elif how:
                    base.execute(f"CREATE VIRTUAL TABLE {name} USING fts5({own})")
                else:
                    base.execute(f"CREATE TABLE {name}({own} {slow})")
        base.close()
        with pytest.raises(UnreadableFile, match=matter):
            read("rosbag", path)
