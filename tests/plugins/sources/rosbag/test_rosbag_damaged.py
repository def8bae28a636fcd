"""Bags that were cut, not closed or overwritten: what is whole is read, and what is lost is counted."""

import contextlib
import shutil
import sqlite3
import struct

import numpy as np
import pytest
from bags import ACCEL, BEGAN, FIELDS, GYRO, KINDS, STEP, N, of_rosbags, stamps, storage_file, unit, write
from recordings_on_disk import read

from fusion_core.errors import DataError, UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag import Rosbag

CHANNELS = {name: FIELDS[name] for name in ("time", "gyro", "accel")}


def imu(path, faults=None):
    return read(Rosbag(path=path, channels=CHANNELS), 1000, faults)


def bag(tmp_path, kind, compression=""):
    """A bag of an inertial unit alone; many chunks, where there are chunks."""
    return storage_file(write(tmp_path / "bag", kind, lambda types: unit(types, camera=False), compression))


def assert_a_part(got):
    """Each row is one that was written, in order, none twice."""
    rows = np.rint((got.t - BEGAN / 1e9) / (STEP / 1e9)).astype(int)
    assert np.all(np.diff(rows) > 0)
    np.testing.assert_array_equal(got["gyro"], GYRO[rows])
    np.testing.assert_array_equal(got["accel"], ACCEL[rows])
    return rows


@pytest.mark.parametrize(
    ("kind", "compression", "size"),
    [
        ("ros1", "", 400),
        ("ros1", "bz2", 100_000),
        ("ros1", "lz4", 100_000),
        ("mcap", "", 400),
        ("mcap", "storage", 100_000),
    ],
)
def test_a_bag_cut_anywhere_is_read_up_to_there(tmp_path, kind, compression, size):
    """A bag as a recorder has written it when the power goes: no index, no end."""
    path = bag(tmp_path, kind, compression)
    whole = path.read_bytes()
    read_so_far = 0
    for share in np.linspace(0.05, 0.98, 23):
        cut = int(share * len(whole))
        path.write_bytes(whole[:cut])
        faults = Faults()
        try:
            got = imu(path, faults)
        except DataError as error:
            assert not read_so_far, error  # noqa: PT017
            continue
        rows = assert_a_part(got)
        np.testing.assert_array_equal(rows, np.arange(len(rows)))
        assert len(rows) >= read_so_far
        read_so_far = len(rows)
        texts = " ".join(faults.lines())
        assert "that was not closed, read without its" in texts
        lost = sum(fault.count for what, fault in faults.found.items() if what.startswith("bytes"))
        if not compression and len(rows) < N:
            # all that stands before the cut was read, but for the record that it went through
            assert lost < size
    assert read_so_far > 0.8 * N


def test_a_bag_of_ros_1_that_is_not_indexed(tmp_path):
    """As `rosbag record` leaves it when it is killed: index_pos is 0, and there is no index."""
    path = bag(tmp_path, "ros1")
    whole = bytearray(path.read_bytes())
    at = whole.index(b"index_pos=") + 10
    start = struct.unpack_from("<Q", whole, at)[0]
    whole[at : at + 8] = bytes(8)
    path.write_bytes(whole[:start])
    faults = Faults()
    np.testing.assert_array_equal(imu(path, faults)["gyro"], GYRO)
    assert faults.lines() == [
        "bag that was not closed, read without its index; `rosbag reindex` repairs a copy: 1 (first in bag.bag)"
    ]


def records(whole):
    """Yield op, offset and content of the records of an MCAP file."""
    at = 8
    while at < len(whole) - 8:
        op, length = struct.unpack_from("<BQ", whole, at)
        yield op, at, whole[at + 9 : at + 9 + length]
        at += 9 + length


def test_mcap_without_chunks_without_a_summary_and_of_ros_1(tmp_path):
    path = bag(tmp_path, "mcap")
    whole = path.read_bytes()
    head = whole[: next(at for op, at, _ in records(whole) if op == 6)]
    loose = b""
    for op, _, content in records(whole):
        if op == 6:
            name = struct.unpack_from("<I", content, 28)[0]
            loose += content[32 + name + 8 :]
    end = struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + whole[:8]
    path.write_bytes(head + loose + end)
    faults = Faults()
    np.testing.assert_array_equal(imu(path, faults)["gyro"], GYRO)
    assert not faults.found  # it is as whole as the format asks for
    assert len(of_rosbags(path, "/imu/data")) == N

    # a file of ROS 1 messages, as a converter from a .bag writes it
    types_1 = storage_file(write(tmp_path / "one", "ros1", lambda types: unit(types, 100, camera=False)))
    messages = [(time, m) for time, m in of_rosbags(types_1, "/imu/data")]
    from bags import Types
    from rosbags.typesys import Stores, get_typestore

    types = Types(True)
    text = get_typestore(Stores.ROS1_NOETIC).generate_msgdef("sensor_msgs/msg/Imu")[0].encode()

    def string(value):
        return struct.pack("<I", len(value)) + value

    def record(op, content):
        return struct.pack("<BQ", op, len(content)) + content

    schema = struct.pack("<H", 1) + string(b"sensor_msgs/Imu") + string(b"ros1msg") + string(text)
    channel = struct.pack("<HH", 1, 1) + string(b"/imu/data") + string(b"ros1") + string(b"")
    body = record(3, schema) + record(4, channel)
    for time, message in messages:
        body += record(5, struct.pack("<HIQQ", 1, 0, time, time) + types.bytes(message))
    path.write_bytes(whole[:8] + record(1, string(b"ros1") + string(b"")) + body + end)
    np.testing.assert_array_equal(imu(path)["gyro"], GYRO[:100])


@pytest.mark.parametrize(("kind", "compression"), [("ros1", "lz4"), ("ros1", "bz2"), ("mcap", "storage")])
def test_a_damaged_chunk_costs_itself_and_no_more(tmp_path, kind, compression):
    path = bag(tmp_path, kind, compression)
    whole = bytearray(path.read_bytes())
    middle = len(whole) // 3
    whole[middle : middle + 64] = bytes(64)
    path.write_bytes(whole)
    faults = Faults()
    rows = assert_a_part(imu(path, faults))
    assert 0 < len(rows) < N
    assert any("lost" in what for what in faults.found), faults


def test_a_chunk_whose_checksum_is_wrong_is_left_out(tmp_path):
    path = bag(tmp_path, "mcap")
    whole = bytearray(path.read_bytes())
    chunks = [at for op, at, _ in records(bytes(whole)) if op == 6]
    assert len(chunks) > 1
    struct.pack_into("<I", whole, chunks[0] + 9 + 24, 12345)
    path.write_bytes(whole)
    faults = Faults()
    rows = assert_a_part(imu(path, faults))
    assert rows[0] > 0
    assert rows[-1] == N - 1
    (what,) = faults.found
    assert what.startswith("bytes that are no whole record, lost; `mcap recover IN -o OUT` repairs it")


def test_bytes_that_are_lost_are_counted_once(tmp_path):
    """Of a chunk that is read for its rows, and for what is joined to them."""
    path = storage_file(write(tmp_path / "bag", "mcap", unit))
    whole = bytearray(path.read_bytes())
    chunks = [at for op, at, _ in records(bytes(whole)) if op == 6]
    struct.pack_into("<I", whole, chunks[1] + 9 + 24, 12345)
    path.write_bytes(whole)
    lost = []
    for channels in (CHANNELS, {**CHANNELS, "temperature": FIELDS["temperature"]}):
        faults = Faults()
        read(Rosbag(path=path, channels=channels), 1000, faults)
        lost += [fault.count for fault in faults.found.values()]
    assert len(lost) == 2
    assert lost[0] == lost[1]


def test_what_a_recorder_left_in_the_write_ahead_log(tmp_path):
    """The last transactions of a bag that was not closed are in a file beside it."""
    path = bag(tmp_path, "sqlite3")
    taken = tmp_path / "taken"
    taken.mkdir()
    base = sqlite3.connect(path)
    base.execute("PRAGMA journal_mode = WAL")
    base.execute("PRAGMA wal_autocheckpoint = 0")
    half = int(stamps()[N // 2])
    moved = base.execute("SELECT topic_id, timestamp, data FROM messages WHERE timestamp > ?", (half,)).fetchall()
    base.execute("DELETE FROM messages WHERE timestamp > ?", (half,))
    base.commit()
    base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    base.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", moved)
    base.commit()
    for name in (path.name, f"{path.name}-wal"):
        shutil.copy(path.with_name(name), taken / name)
    base.close()
    content = {p.name: p.read_bytes() for p in taken.iterdir()}
    np.testing.assert_array_equal(imu(taken / path.name)["gyro"], GYRO)
    assert {p.name: p.read_bytes() for p in taken.iterdir() if not p.name.endswith("-shm")} == content


def test_a_database_that_is_cut(tmp_path):
    path = bag(tmp_path, "sqlite3")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    faults = Faults()
    rows = assert_a_part(imu(path, faults))
    assert 0 < len(rows) < N
    (what,) = faults.found
    assert what.startswith("damaged page (")
    assert what.endswith("what follows is lost; `sqlite3 OLD .recover | sqlite3 NEW` repairs it")
    path.write_bytes(whole[:4096])
    with pytest.raises(UnreadableFile, match=r"is no bag, or is damaged"):
        imu(path)


@pytest.mark.parametrize("kind", KINDS)
def test_any_byte_may_be_wrong(tmp_path, kind):
    """Whatever is overwritten, the answer is rows or an error of ours."""
    path = bag(tmp_path, kind)
    whole = path.read_bytes()
    rng = np.random.default_rng(9)
    heads = rng.integers(0, 4000, 40)  # where the definitions stand
    for at in [*heads, *rng.integers(0, len(whole), 40), *(len(whole) - rng.integers(1, 2000, 20))]:
        changed = bytearray(whole)
        changed[at] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        with contextlib.suppress(DataError):
            imu(path)
