"""ROS bags that rosbags writes, cell by cell against what rosbags reads."""

import sqlite3
from functools import reduce

import numpy as np
import pytest
from bags import (
    ACCEL,
    BEGAN,
    CUSTOM,
    FIELDS,
    GYRO,
    KINDS,
    SECOND,
    STEP,
    N,
    Types,
    of_rosbags,
    stamps,
    storage_file,
    unit,
    write,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings_on_disk import read
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fusion_core.errors import BadValue, MissingChannel, UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag import Rosbag
from fusion_plugins.sources.rosbag.decoding import Decoder, column
from fusion_plugins.sources.rosbag.decoding import Types as Definitions
from fusion_plugins.sources.rosbag.storage import Batch


def source(path, channels=None, **more):
    return Rosbag(path=path, channels=FIELDS if channels is None else channels, **more)


def only(*names):
    return {name: FIELDS[name] for name in names}


def seconds(nanoseconds):
    return np.array([ns // SECOND + ns % SECOND * 1e-9 for ns in np.asarray(nanoseconds).tolist()])


@pytest.mark.parametrize(
    ("kind", "compression"),
    [("ros1", ""), ("ros1", "bz2"), ("ros1", "lz4"), ("sqlite3", ""), ("sqlite3", "message"), ("sqlite3", "file"),
     ("mcap", ""), ("mcap", "message"), ("mcap", "file"), ("mcap", "storage")],
)  # fmt: skip
def test_every_kind_of_bag(tmp_path, kind, compression):
    path = write(tmp_path / "bag", kind, unit, compression)
    faults = Faults()
    got = read(source(path), 1000, faults)
    assert not faults.found
    theirs = [message for _, message in of_rosbags(path, "/imu/data")]
    gyro = [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in theirs]
    np.testing.assert_array_equal(got["gyro"], gyro)
    np.testing.assert_array_equal(got["accel"], ACCEL)
    np.testing.assert_array_equal(
        got.t, seconds([m.header.stamp.sec * SECOND + m.header.stamp.nanosec for m in theirs])
    )
    inside = got.t <= got.t[-1] - 1  # up to the last sample of the thermometer, it rises along a straight line
    np.testing.assert_allclose(got["temperature"][inside], 20 + (np.arange(N) / 200)[inside], atol=1e-6)

    log = read(source(path, stamp="log"), 1000)
    np.testing.assert_array_equal(log.t, seconds([time for time, _ in of_rosbags(path, "/imu/data")]))


@pytest.mark.parametrize("kind", KINDS)
def test_the_file_in_a_folder_alone(tmp_path, kind):
    path = write(tmp_path / "bag", kind, unit)
    file = storage_file(path)
    whole = read(source(path))
    np.testing.assert_array_equal(read(source(file))["gyro"], whole["gyro"])
    if kind != "ros1":
        np.testing.assert_array_equal(read(source(path / "metadata.yaml"))["gyro"], whole["gyro"])
        (path / "metadata.yaml").unlink()
        np.testing.assert_array_equal(read(source(path))["gyro"], whole["gyro"])


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_bag_of_several_files_is_read_in_the_order_of_their_numbers(tmp_path, kind):
    folder = tmp_path / "split"
    folder.mkdir()
    for part in (10, 9, 11):  # by name, 10 and 11 come before 9

        def some(types, part=part):
            for k, stamp in enumerate(stamps().tolist()):
                if k // 1000 == part - 9:
                    yield "/imu/data", stamp, types.imu(stamp, GYRO[k], ACCEL[k])

        made = write(tmp_path / f"bag_{part}", kind, some)
        storage_file(made).rename(folder / storage_file(made).name)
    faults = Faults()
    np.testing.assert_array_equal(read(source(folder, only("time", "gyro")), 1000, faults)["gyro"], GYRO)
    assert not faults.found


def custom(types, k, note, gains, points):
    nested = types.imu(k, GYRO[k], ACCEL[k])
    return types(
        CUSTOM, types.header(BEGAN + k * STEP, "f" * (k % 5)), note, np.array(gains, np.float32), k % 256,
        np.array([k, -k, 3], np.int16), k / 7, [types.vector(p) for p in points], 2**40 + k, k % 2 == 0, nested,
    )  # fmt: skip


PATHS = [
    "flags", "counts", "counts[1]", "scale", "ticks", "on", "header.stamp", "gains[0]", "gains[2]", "points[1].y",
    "points[0]", "imu.angular_velocity", "imu.linear_acceleration.z", "imu.angular_velocity_covariance[4]",
]  # fmt: skip


def expected(message, path):
    if path == "header.stamp":
        return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9

    def step(value, name):
        name, _, index = name.partition("[")
        value = getattr(value, name)
        return value if not index else value[int(index[:-1])]

    try:
        value = reduce(step, path.split("."), message)
    except IndexError:
        return np.full(3, np.nan) if path == "points[0]" else np.nan
    return [value.x, value.y, value.z] if hasattr(value, "x") else np.asarray(value, float)


@settings(max_examples=60)
@given(
    st.booleans(),
    st.lists(
        st.tuples(
            st.text("abc", max_size=9),
            st.lists(st.floats(-1, 1, width=32), max_size=3),
            st.lists(st.tuples(*[st.floats(-1, 1)] * 3), max_size=2),
        ),
        min_size=1,
        max_size=12,
    ),
    st.sets(st.sampled_from(PATHS), min_size=1),
)
def test_strings_and_sequences_of_any_length_shift_what_follows(ros1, contents, paths):
    """The layout of each message is found, in any order of them, as rosbags' deserializer finds it."""
    types = Types(ros1)
    raw = [types.bytes(custom(types, k, *content)) for k, content in enumerate(contents)]
    read_back = types.store.deserialize_ros1 if ros1 else types.store.deserialize_cdr
    messages = [read_back(data, CUSTOM) for data in raw]
    definitions = Definitions([])
    definitions._add(types.store.fielddefs)
    fields = {path: definitions.find(CUSTOM, path) for path in paths}
    leaves = [leaf for field in fields.values() for leaf in field.leaves]
    decoder = Decoder(definitions, CUSTOM, "ros1" if ros1 else "cdr", leaves)
    sizes = np.array([len(data) for data in raw])
    junk = b"\xff" * 3  # messages need not begin where a number may stand
    batch = Batch(1, np.arange(len(raw)), junk + b"".join(raw), 3 + np.cumsum(sizes) - sizes, sizes)
    columns, good = decoder.decode(batch)
    assert np.all(good)
    for path, field in fields.items():
        got = column(field, columns, len(raw))
        for row, message in zip(got, messages, strict=True):
            np.testing.assert_array_equal(row, expected(message, path), err_msg=path)


def test_big_endian_messages_and_others_that_are_cut():
    types = Types(False)
    little = types.imu(BEGAN, [1, 2, 3], [4, 5, 6])
    big = bytes(types.store.serialize_cdr(little, little.__msgtype__, little_endian=False))
    raw = [types.bytes(little), big, types.bytes(little)[:100], b"\0\7\0\0" + big[4:], b"", big]
    definitions = Definitions([])
    definitions._add(types.store.fielddefs)
    leaves = definitions.find("sensor_msgs/msg/Imu", "angular_velocity").leaves
    sizes = np.array([len(data) for data in raw])
    decoder = Decoder(definitions, "sensor_msgs/msg/Imu", "cdr", leaves)
    columns, good = decoder.decode(Batch(1, np.arange(6), b"".join(raw), np.cumsum(sizes) - sizes, sizes))
    np.testing.assert_array_equal(good, [True, True, False, False, False, True])
    np.testing.assert_array_equal(np.column_stack([columns[leaf] for leaf in leaves])[good], [[1, 2, 3]] * 3)


@pytest.mark.parametrize("kind", KINDS)
def test_types_of_ones_own(tmp_path, kind):
    def messages(types):
        for k in range(500):
            yield "/own", BEGAN + k, custom(types, k, "n" * (k % 3), [0.5] * (k % 4), [])

    path = write(tmp_path / "bag", kind, messages)
    channels = {
        "time": {"path": "/own"}, "gyro": {"path": "/own.imu.angular_velocity"}, "ticks": {"path": "/own.ticks"},
        "counts": {"path": "/own.counts", "unit": "0.5 V"}, "gain": {"path": "/own.gains[2]"},
    }  # fmt: skip
    faults = Faults()
    got = read(source(path, channels), 100, faults)
    np.testing.assert_array_equal(got["gyro"], GYRO[:500])
    np.testing.assert_array_equal(got["counts"], np.column_stack([np.arange(500), -np.arange(500), [3] * 500]) / 2)
    np.testing.assert_array_equal(np.isnan(got["gain"]), np.arange(500) % 4 < 3)
    np.testing.assert_array_equal(got["ticks"], 2.0**40 + np.arange(500))
    assert faults.lines() == [
        "messages on /own whose frame_id is not '', as that of the first: 400 (first logged at 1700000000.000000001 s)"
    ]
    with pytest.raises(
        BadValue, match=r"'/own.gains' has arrays of 0 to 3 values, .* name one value of them, as /own.gains\[0\]"
    ):
        read(source(path, {**channels, "gain": {"path": "/own.gains"}}))


@pytest.mark.parametrize("kind", KINDS)
def test_units_that_types_prescribe(tmp_path, kind):
    def messages(types):
        yield "/imu", 1, types.imu(1, [0] * 3, [0] * 3)
        yield "/T", 1, types.temperature(1, 20)
        yield "/m", 1, types("sensor_msgs/msg/MagneticField", types.header(1), types.vector([1, 2, 3]), np.zeros(9))
        yield "/p", 1, types("sensor_msgs/msg/FluidPressure", types.header(1), 101325.0, 0.0)
        yield "/own", 1, custom(types, 1, "", [], [])

    expected_units = {
        "/imu": "s", "/imu.header.stamp": "s", "/imu.angular_velocity.x": "rad/s", "/imu.linear_acceleration": "m/s^2",
        "/imu.orientation.x": None, "/T.temperature": "degC", "/T.variance": None, "/m.magnetic_field.y": "T",
        "/p.fluid_pressure": "Pa", "/own.imu.angular_velocity.z": "rad/s", "/own.scale": None,
    }  # fmt: skip
    with source(write(tmp_path / "bag", kind, messages)).open(
        storage_file(tmp_path / ("bag" if kind != "ros1" else "bag.bag")), Faults()
    ) as table:
        assert {path: table.unit(path) for path in expected_units} == expected_units
        assert {path for path in expected_units if path != "/imu.linear_acceleration"} <= set(table.names)


def test_a_bag_from_before_definitions_were_written_into_it(tmp_path):
    path = storage_file(write(tmp_path / "bag", "sqlite3", unit))
    with sqlite3.connect(path) as base:
        base.executescript("DROP TABLE message_definitions; DROP TABLE schema;")
    np.testing.assert_array_equal(read(source(path))["gyro"], GYRO)
    with sqlite3.connect(path) as base:
        base.execute("UPDATE topics SET type = 'acme_msgs/msg/Imu' WHERE name = '/imu/data'")
    with pytest.raises(
        UnreadableFile, match=r"topic '/imu/data' is of type acme_msgs/msg/Imu, whose definition is not in"
    ):
        read(source(path))


IDL = (
    """IDL: acme_msgs/msg/Plain
module acme_msgs { module msg {
  typedef float float__3[3];
  @verbatim (language="comment", text="one sample")
  struct Plain {
    acme_msgs::msg::Inner inner;
    acme_msgs::msg::float__3 axes;
  };
}; };
"""
    + "=" * 80
    + """
IDL: acme_msgs/msg/Inner
module acme_msgs { module msg {
  struct Inner { uint8 flag; double rate; };
}; };
"""
)


def test_definitions_in_idl(tmp_path):
    """As recorders of ROS 2 write them for types that were declared in .idl files."""

    def messages(types):
        types.store.register(get_types_from_msg("uint8 flag\nfloat64 rate", "acme_msgs/msg/Inner"))
        types.store.register(get_types_from_msg("Inner inner\nfloat32[3] axes", "acme_msgs/msg/Plain"))
        for k in range(10):
            inner = types("acme_msgs/msg/Inner", k, k / 2)
            yield "/plain", BEGAN + k, types("acme_msgs/msg/Plain", inner, np.array([k, 2 * k, 3 * k], np.float32))

    path = storage_file(write(tmp_path / "bag", "sqlite3", messages))
    with sqlite3.connect(path) as base:
        base.execute("UPDATE message_definitions SET encoding = 'ros2idl', encoded_message_definition = ?", (IDL,))
    channels = {"time": {"path": "/plain"}, "gyro": {"path": "/plain.axes", "unit": "rad/s"},
                "rate": {"path": "/plain.inner.rate"}}  # fmt: skip
    got = read(source(path, channels))
    np.testing.assert_array_equal(got["gyro"], np.arange(10)[:, None] * [1, 2, 3])
    np.testing.assert_array_equal(got["rate"], np.arange(10) / 2)


@pytest.mark.parametrize("kind", KINDS)
def test_what_there_is_is_listed(tmp_path, kind):
    path = write(tmp_path / "bag", kind, unit)
    with pytest.raises(MissingChannel, match=(
        r"has no topic '/imu/dat', it has /imu/data \(sensor_msgs/msg/Imu, 3000 messages\), /imu/temperature "
        r"\(sensor_msgs/msg/Temperature, 15 messages\), /camera \(std_msgs/msg/UInt8MultiArray, 150 messages\); did"
    )):  # fmt: skip
        read(source(path, {**FIELDS, "gyro": {"path": "/imu/dat.angular_velocity"}}))
    with pytest.raises(MissingChannel, match=(
        r"topic '/imu/data' of sensor_msgs/msg/Imu has no field 'angular_velocity.u' of numbers, it has .*"
        r"header.stamp, .*angular_velocity.x, .*; did you mean 'angular_velocity.[xyz]'"
    )):  # fmt: skip
        read(source(path, {**FIELDS, "gyro": {"path": "/imu/data.angular_velocity.u"}}))
    with pytest.raises(MissingChannel, match=r"has no field 'header.frame_id' of numbers"):
        read(source(path, {**FIELDS, "note": {"path": "/imu/data.header.frame_id"}}))


@pytest.mark.parametrize("kind", KINDS)
def test_stamps_that_are_zero_out_of_order_or_twice(tmp_path, kind):
    def zero(types):
        for k, stamp in enumerate(stamps(100).tolist()):
            yield "/imu/data", stamp, types.imu(0, GYRO[k], ACCEL[k])

    path = write(tmp_path / "zero", kind, zero)
    with pytest.raises(
        BadValue, match=r"topic '/imu/data' has a stamp of zero in all of its 100 headers.* set stamp: log"
    ):
        read(source(path, only("time", "gyro")))
    np.testing.assert_array_equal(read(source(path, only("time", "gyro"), stamp="log")).t, seconds(stamps(100)))

    order = [0, 1, 3, 2, 4, 4, 5, 6, 8, 7]

    def mixed(types):
        yield "/imu/data", BEGAN, types.imu(0, [9] * 3, [9] * 3)
        for k, j in enumerate(order):
            yield "/imu/data", BEGAN + k, types.imu(BEGAN + j * STEP, [j] * 3, [j] * 3)

    faults = Faults()
    got = read(source(write(tmp_path / "mixed", kind, mixed), only("time", "gyro")), 100, faults)
    np.testing.assert_array_equal(got["gyro"][:, 0], sorted(order))
    np.testing.assert_array_equal(np.diff(got.t) >= 0, True)
    assert {what: fault.count for what, fault in faults.found.items()} == {
        "messages on /imu/data with a stamp of zero, left out": 1,
        "messages on /imu/data that stand after a later one, put in order": 2,
    }


@pytest.mark.parametrize("kind", KINDS)
def test_any_number_of_rows_at_a_time_gives_the_same(tmp_path, kind, monkeypatch):
    """A thermometer at half the rate stands on the edge between picking and drawing a line: all blocks do alike."""
    rng = np.random.default_rng(4)
    order = np.argsort(np.arange(N) + rng.uniform(0, 20, N))  # each at most twenty places off

    def messages(types):
        for place, k in enumerate(order.tolist()):
            stamp = int(stamps()[k] + rng.integers(-(10**5), 10**5))
            yield "/imu/data", BEGAN + place, types.imu(stamp, GYRO[k], ACCEL[k])
            if k % 2 == 0:
                yield "/imu/temperature", BEGAN + place, types.temperature(stamp, np.sin(k))

    path = write(tmp_path / "bag", kind, messages)
    faults = Faults()
    whole = read(source(path), 1000, faults)
    assert np.all(np.diff(whole.t) > 0)
    assert list(faults.found) == [
        f"messages on {topic} that stand after a later one, put in order" for topic in ("/imu/temperature", "/imu/data")
    ]
    monkeypatch.setattr("fusion_plugins.sources.rosbag.ROWS", 300)
    monkeypatch.setattr("fusion_plugins.sources.rosbag.HELD", 100)
    again = Faults()
    blocks = read(source(path), 1000, again)
    assert {what: fault.count for what, fault in again.found.items()} == {
        what: fault.count for what, fault in faults.found.items()
    }
    np.testing.assert_array_equal(blocks.t, whole.t)
    for name in whole.channels:
        np.testing.assert_array_equal(blocks[name], whole[name])


@pytest.mark.parametrize("kind", KINDS)
def test_a_topic_without_a_header_and_one_of_another_clock(tmp_path, kind):
    def messages(types):
        for k, stamp in enumerate(stamps(1000).tolist()):
            yield "/imu/data", stamp, types.imu(stamp, GYRO[k], ACCEL[k])
            if k % 100 == 0:
                yield "/bare", stamp, types("std_msgs/msg/Float64", float(k))
                yield "/elsewhere", stamp, types.temperature(SECOND + k, k)

    path = write(tmp_path / "bag", kind, messages)
    bare = {**only("time", "gyro"), "temperature": {"path": "/bare.data", "unit": "degC"}}
    faults = Faults()
    np.testing.assert_allclose(read(source(path, bare), 100, faults)["temperature"][:900], np.arange(900), atol=1e-4)
    assert list(faults.found) == ["messages on /bare that have no header, taken by the log's time"]
    elsewhere = {**bare, "temperature": {"path": "/elsewhere.temperature"}}
    with pytest.raises(
        BadValue, match=r"topics '/imu/data' .* and '/elsewhere' .* no time in common, .* set stamp: log"
    ):
        read(source(path, elsewhere))
    got = read(source(path, elsewhere, stamp="log"))
    np.testing.assert_allclose(got["temperature"][:900], np.arange(900), atol=1e-4)


def test_without_the_package(tmp_path, monkeypatch):
    monkeypatch.setattr("fusion_core.errors.find_spec", lambda name: None)
    with pytest.raises(Exception, match=r"package rosbags is not installed, .*; pip install 'driftlab\[ros\]'"):
        read(source(tmp_path / "r.bag"))


def test_foreign_files_and_folders(tmp_path):
    (tmp_path / "r.bag").write_text("t,g\n")
    for path, message in (
        (tmp_path / "r.bag", "is a text file, a file of kind rosbag was expected"),
        (tmp_path, "is a folder without a .db3 or .mcap file, a bag was expected; name a bag"),
        (tmp_path / "none.bag", "cannot be read"),
    ):
        with pytest.raises(UnreadableFile, match=message):
            read(source(path))
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
    with pytest.raises(UnreadableFile, match=r"is of version #ROSBAG V1.2, #ROSBAG V2.0 was expected; convert it with"):
        read(source(tmp_path / "old.bag"))
    with sqlite3.connect(tmp_path / "other.db3") as base:
        base.execute("CREATE TABLE notes (a)")
    with pytest.raises(
        UnreadableFile, match=r"is no bag, .*\(tables topics and messages were expected, it has notes\)"
    ):
        read(source(tmp_path / "other.db3"))


def test_the_definitions_are_those_of_rosbags():
    """Every type of rosbags' stores can be listed, and each path that is listed is found."""
    for store in (Stores.ROS1_NOETIC, Stores.LATEST):
        definitions = Definitions([])
        definitions._add(get_typestore(store).fielddefs)
        for kind in definitions.fields:
            assert all(definitions.find(kind, path) for path in definitions.paths(kind))
