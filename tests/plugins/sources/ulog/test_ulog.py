"""PX4 logs, written here as a vehicle writes them and read beside pyulog."""

import struct

import numpy as np
import pytest
from pydantic import ValidationError
from pyulog import ULog
from ulog_writer import Extras, Topic, message, sensor, write_ulog

from fusion_core.chunk import concatenate
from fusion_core.errors import FusionError, MissingChannel, TimeBackwards, UnreadableFile
from fusion_core.faults import Faults, usable
from fusion_plugins.sources.ulog import Ulog
from fusion_plugins.sources.ulog.file import sampled

ICM, BMI_GYRO, BMI_ACCEL, OTHER = 0x26000A, 0x66020A, 0x6A010A, 0x3C0312
DEVICES = [(ICM, ICM), (BMI_GYRO, BMI_ACCEL), (OTHER, OTHER)]
AXES = ("x", "y", "z")
PARAMETERS = {"TC_G_ENABLE": 1, "TC_A_ENABLE": 0, "CAL_GYRO0_ID": ICM, "CAL_GYRO0_XOFF": 0.01, "CAL_GYRO0_YOFF": 0.0}


def topics(N=400, rate=10.0, begin=20.0):
    """Three units; the gyro of the second has no thermometer, the accelerometer beside it has."""
    rng = np.random.default_rng(4)
    found = []
    for k, (gyro, accel) in enumerate(DEVICES):
        t = begin + np.arange(N) / rate + 0.001 * k
        T = 20 + 10 * k + np.arange(N) / N
        found.append(sensor("sensor_gyro", k, t, rng.normal(size=(N, 3)), np.nan if k == 1 else T, gyro))
        found.append(sensor("sensor_accel", k, t + 0.0004, rng.normal(size=(N, 3)), T, accel))
    return found


def channels(gyro="sensor_gyro", accel="sensor_accel", temperature="sensor_gyro.temperature"):
    return {
        "time": {"path": f"{gyro}.time"},
        "gyro": {"path": [f"{gyro}.{a}" for a in AXES]},
        "accel": {"path": [f"{accel}.{a}" for a in AXES]},
        "temperature": {"path": temperature},
    }


def read(path, size=150, faults=None, named=None, **settings):
    source = Ulog(path=path, channels=named or channels(), **settings)
    return concatenate(list(source.chunks(size, Faults() if faults is None else faults)))


@pytest.fixture
def log(tmp_path):
    return write_ulog(
        tmp_path / "v.ulg", topics(), PARAMETERS, Extras([(40_000_000, 120)], [(30_000_000, "warming up")])
    )


@pytest.mark.parametrize("instance", [0, 2])
def test_the_same_numbers_as_pyulog(log, instance):
    got, oracle = read(log, instance=instance), ULog(str(log))
    gyro, accel = (oracle.get_dataset(name, instance).data for name in ("sensor_gyro", "sensor_accel"))
    np.testing.assert_allclose(got.t, gyro["timestamp_sample"] / 1e6, rtol=1e-14)
    np.testing.assert_array_equal(got["gyro"], np.column_stack([gyro[a] for a in AXES]))
    np.testing.assert_array_equal(got["accel"], np.column_stack([accel[a] for a in AXES]))
    np.testing.assert_array_equal(got["temperature"], gyro["temperature"])


@pytest.mark.parametrize(
    "chosen", [{"device_id": OTHER}, {"device_id": hex(OTHER)}, {"device_id": str(OTHER)}, {"instance": 2}]
)
def test_a_gyro_is_chosen_by_what_it_is_or_where(log, chosen):
    np.testing.assert_array_equal(read(log, **chosen)["gyro"], read(log, instance=2)["gyro"])


def test_which_sensors_were_read_is_said_and_what_the_vehicle_corrects(log):
    faults = Faults()
    read(log, faults=faults)
    said = "\n".join(faults.lines())
    assert f"read are sensor_gyro[0], device_id {ICM} (ICM-42688-P, SPI 1, address 0x00): 400 rows at 10 Hz" in said
    assert f"not read are sensor_gyro[1], device_id {BMI_GYRO}" in said
    assert "TC_G_ENABLE = 1, CAL_GYRO0_XOFF = 0.01; the columns read are without that" in said
    assert "YOFF" not in said  # zero: nothing is corrected
    assert "dropouts, for which the logger wrote nothing (0.12 s in all): 1" in said
    assert sum("bytes" in line for line in faults.lines()) == 0


def test_two_ways_to_choose_are_one_too_many(log):
    with pytest.raises(ValidationError, match="both device_id and instance are given"):
        read(log, device_id=ICM, instance=0)


@pytest.mark.parametrize(("settings", "named"), [({"instance": 7}, "instance 7"), ({"device_id": 5}, "device_id 5")])
def test_a_gyro_that_is_not_there(log, settings, named):
    with pytest.raises(MissingChannel, match=rf"has no gyro of {named}; .*sensor_gyro\[2\], device_id {OTHER}"):
        read(log, **settings)


def test_a_topic_that_is_not_there(log):
    with pytest.raises(MissingChannel, match=r"no rows of sensor_baro .*SDLOG_PROFILE.*sensor_accel\[1\].*10 Hz"):
        read(log, named=channels(temperature="sensor_baro.temperature"))
    with pytest.raises(MissingChannel, match=r"no field 'sensor_gyro.temperatur'.* did you mean 'sensor_gyro.temper"):
        read(log, named=channels(temperature="sensor_gyro.temperatur"))


def test_a_gyro_without_a_thermometer_names_those_that_have_one(log):
    with pytest.raises(
        MissingChannel, match=r"measures no temperature .*path: sensor_accel.temperature, .*sensor_accel\[1\]"
    ):
        read(log, instance=1)
    # BMI088: two dies at two addresses; without PX4's own pairs the other half of the part
    got = read(log, instance=1, named=channels(temperature="sensor_accel.temperature"))
    np.testing.assert_allclose(got["temperature"], 30 + np.arange(400) / 400, rtol=1e-6)


def test_px4s_own_pairs_come_first(tmp_path):
    found = topics()
    found[3].instance, found[5].instance = 2, 1  # the accelerometers in another order than the gyros
    t = found[0].fields["timestamp"][::5]
    pair = ["uint64_t timestamp", "uint32_t accel_device_id", "uint32_t gyro_device_id"]
    rows = {"timestamp": t, "accel_device_id": np.full(len(t), BMI_ACCEL), "gyro_device_id": np.full(len(t), BMI_GYRO)}
    path = write_ulog(tmp_path / "v.ulg", [*found, Topic("vehicle_imu", rows, 1, pair)])
    named = channels(temperature="sensor_accel.temperature")
    got = read(path, instance=1, named=named)
    np.testing.assert_array_equal(got["accel"][:, 0], found[3].fields["x"].astype(np.float32))


def test_a_gyro_named_in_full_brings_what_belongs_to_it(tmp_path):
    found = topics()
    found[3].instance, found[1].instance = 0, 1
    path = write_ulog(tmp_path / "v.ulg", found)
    got = read(path, named=channels("sensor_gyro[1]", temperature="sensor_accel.temperature"))
    np.testing.assert_array_equal(got["accel"][:, 0], found[3].fields["x"].astype(np.float32))  # of the same part


@pytest.mark.parametrize("topic", ["vehicle_imu", "sensor_combined", "vehicle_angular_velocity", "sensor_gyro_fifo"])
def test_what_the_autopilot_has_corrected_is_refused(log, topic):
    with pytest.raises(ValidationError, match=f"is read from {topic}, .*read sensor_gyro"):
        read(log, named=channels() | {"gyro": {"path": [f"{topic}.{a}" for a in AXES]}})


def test_older_firmware_had_taken_the_offsets_off(tmp_path):
    """PX4 1.10: x = (raw - offset) scale, in the driver; the raw value is what a map is fitted to."""
    found = topics(100)[:2]
    old = ["uint64_t timestamp", "uint32_t device_id", "uint64_t error_count", "float x", "float y", "float z",
           "uint32_t integral_dt", "float x_integral", "float temperature"]  # fmt: skip
    raw = found[1].fields["x"].copy()
    parameters = {"CAL_ACC1_ID": ICM, "CAL_ACC1_XOFF": 0.25, "CAL_ACC1_XSCALE": 1.5}
    for topic in found:
        topic.format = old
        kept = ("timestamp", "device_id", *AXES, "temperature")
        topic.fields = {name: topic.fields[name] for name in kept}
    found[1].fields["x"] = (raw - 0.25) * 1.5
    faults = Faults()
    got = read(write_ulog(tmp_path / "v.ulg", found, parameters), faults=faults)
    np.testing.assert_allclose(got["accel"][:, 0], raw, atol=1e-6)
    np.testing.assert_allclose(got.t, found[0].fields["timestamp"] / 1e6, rtol=1e-14)  # there is no timestamp_sample
    assert any("firmware before 1.11" in line for line in faults.lines())


def test_rows_that_change_places_are_put_in_order(tmp_path):
    found = topics()
    gyro = found[0].fields
    stamps = gyro["timestamp_sample"].copy()
    gyro["timestamp_sample"][[50, 51]] = stamps[[51, 50]]
    gyro["timestamp_sample"][200] ^= np.uint64(1 << 40)  # a flipped bit
    faults = Faults()
    path = write_ulog(tmp_path / "v.ulg", found)
    source = Ulog(path=path, channels=channels())
    got = concatenate(list(usable(source.chunks(100, faults), faults, source.name)))
    assert len(got) == 399
    assert got.t[50] == pytest.approx(stamps[50] / 1e6, abs=1e-9)
    assert got["gyro"][50, 0] == np.float32(gyro["x"][51])
    said = "\n".join(faults.lines())
    assert "rows of sensor_gyro[0] that came after a later one, put in order: 1" in said
    assert "rows of sensor_gyro[0] whose time stamp is damaged, left out: 1" in said


def test_two_logs_in_one_are_refused(tmp_path):
    found = topics()
    for name in ("timestamp", "timestamp_sample"):
        found[0].fields[name][200:] -= np.uint64(30_000_000)
    found[0].fields["timestamp"].sort()  # else the writer would put them in order
    # the accelerometer's time went on: rows before it began have none, and 39.9 s is followed by 19.9 s
    source = Ulog(path=write_ulog(tmp_path / "v.ulg", found), channels=channels())
    with pytest.raises(TimeBackwards, match="time runs backwards by 20 s"):
        list(usable(source.chunks(100, Faults()), Faults(), source.name))


def test_what_is_cut_off_is_counted(log, tmp_path, capfd):
    whole, content = read(log), log.read_bytes()
    begin = content.index(struct.pack("<HB", 8, ord("S")))
    for size in np.linspace(begin + 5000, len(content) - 1, 25).astype(int):
        cut = tmp_path / "cut.ulg"
        cut.write_bytes(content[:size])
        faults = Faults()
        got = read(cut, faults=faults)
        np.testing.assert_array_equal(got["gyro"], whole["gyro"][: len(got)])
        lost = sum(f.count for what, f in faults.found.items() if "bytes of the log" in what)
        assert lost == size - last_end(content, size)
    assert capfd.readouterr() == ("", "")


def last_end(content, size):
    """Return where the last message ends that is whole."""
    p = 16
    while p + 3 <= size and p + 3 + struct.unpack_from("<H", content, p)[0] <= size:
        p += 3 + struct.unpack_from("<H", content, p)[0]
    return p


def test_flipped_bits_cost_what_they_hit(log, tmp_path, capfd):
    """Every row is as it was, save one where a flip hit its numbers; few rows go with a flip that hits a header."""
    whole, content = read(log), log.read_bytes()
    begin = content.index(struct.pack("<HB", 8, ord("S")))
    rng = np.random.default_rng(8)
    for _ in range(60):
        damaged = bytearray(content)
        at = int(rng.integers(begin, len(content)))
        damaged[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / "flipped.ulg"
        path.write_bytes(damaged)
        faults = Faults()
        got = read(path, faults=faults)
        lost = sum(f.count for what, f in faults.found.items() if "bytes of the log" in what)
        assert lost <= 400  # a message with its neighbours
        assert len(got) >= 397
        same = np.isin(got["gyro"][:, 1], whole["gyro"][:, 1])
        assert np.sum(~same) <= 1
    assert capfd.readouterr() == ("", "")


def test_damaged_definitions_end_in_words(log, tmp_path, capfd):
    """Formats, parameters and subscriptions; pyulog alone may go round in circles at the end."""
    content = log.read_bytes()
    begin = content.index(struct.pack("<HB", 8, ord("S")))
    rng = np.random.default_rng(9)
    ended = 0
    for _ in range(80):
        damaged = bytearray(content)
        for at in rng.integers(0, begin, int(rng.integers(1, 30))):
            damaged[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / "flipped.ulg"
        path.write_bytes(damaged)
        source = Ulog(path=path, channels=channels())
        try:
            list(usable(source.chunks(150, faults := Faults()), faults, source.name))
        except FusionError as error:
            ended += str(path) in str(error)
        else:
            ended += 1
    assert ended == 80
    assert capfd.readouterr() == ("", "")


def test_a_pressure_is_in_mbar_or_in_pa(tmp_path):
    """Before PX4 1.14 in mbar, since then in Pa, in a field of the same name."""
    for scale in (1.0, 100.0):
        t = np.arange(400) / 10
        stamp = ((20 + t) * 1e6).astype(np.uint64)
        baro = {
            "timestamp": stamp,
            "timestamp_sample": stamp,
            "device_id": np.full(400, 5),
            "pressure": scale * (1000 + t),
        }
        path = write_ulog(tmp_path / "v.ulg", [*topics(), Topic("sensor_baro", baro)])
        got = read(path, named=channels() | {"pressure": {"path": "sensor_baro.pressure"}})
        np.testing.assert_allclose(got["pressure"], 100 * (1000 + t), rtol=1e-6)


def test_blocks_of_nothing_in_the_middle(log, tmp_path):
    """As from a card that lost a cluster: the rows within are gone, and all others are there."""
    content = bytearray(log.read_bytes())
    content[100_000:104_096] = bytes(4096)
    path = tmp_path / "holed.ulg"
    path.write_bytes(content)
    faults = Faults()
    got, whole = read(path, faults=faults), read(log)
    lost = sum(f.count for what, f in faults.found.items() if "bytes of the log" in what)
    assert 4096 <= lost <= 4096 + 200
    assert len(got) == pytest.approx(400 - 4096 / (len(content) / 400), abs=3)
    assert np.isin(got.t, whole.t).all()
    np.testing.assert_array_equal(got["gyro"], whole["gyro"][np.isin(whole.t, got.t)])


def test_messages_of_a_later_format_are_stepped_over(log, tmp_path):
    content = log.read_bytes()
    begin = content.index(struct.pack("<HB", 8, ord("S")))
    path = tmp_path / "later.ulg"
    path.write_bytes(content[:begin] + message("Z", b"what nobody knows yet") + content[begin:])
    faults = Faults()
    np.testing.assert_array_equal(read(path, faults=faults)["gyro"], read(log)["gyro"])
    assert any("bytes" in line and ": 24 " in line for line in faults.lines())


def test_what_was_appended_after_a_crash(log, tmp_path):
    """PX4 appends to a log that ends within a message; the flags say where. (pyulog 1.3 loses the rows behind that.)"""
    content = bytearray(log.read_bytes())
    found = topics(50, begin=60.0)
    tail = write_ulog(tmp_path / "tail.ulg", found).read_bytes()
    tail = tail[tail.index(struct.pack("<HB", 8, ord("S"))) :]
    end = len(content) - 20  # the last row of sensor_accel[2] is cut
    content = content[:end]
    content[16 + 11] |= 1
    content[16 + 19 : 16 + 27] = struct.pack("<Q", end)
    path = tmp_path / "appended.ulg"
    path.write_bytes(content + tail)
    written = np.concatenate([part[0].fields["x"] for part in (topics(), found)]).astype(np.float32)
    np.testing.assert_array_equal(read(path)["gyro"][:, 0], written)
    assert len(ULog(str(path)).get_dataset("sensor_gyro", 0).data["x"]) == 400


@pytest.mark.parametrize(
    "content", [b"ULog\x01\x125", b"ULog\x01\x125\x01" + bytes(8), b"time,x\n1,2\n", b"\x89HDF\r\n"]
)
def test_what_is_no_log(tmp_path, content):
    path = tmp_path / "v.ulg"
    path.write_bytes(content)
    with pytest.raises((UnreadableFile, MissingChannel)) as error:
        read(path)
    assert str(path) in str(error.value)


def test_a_log_that_needs_a_later_reader(log, tmp_path):
    content = bytearray(log.read_bytes())
    content[16 + 11] |= 2
    path = tmp_path / "v.ulg"
    path.write_bytes(content)
    with pytest.raises(UnreadableFile, match="is of a later format, with the flags 0x2 that are not known"):
        read(path)


def test_rows_with_their_padding_are_read_and_so_are_those_beside_them(tmp_path):
    """PX4 leaves the padding at a row's end out; a writer that does not is as good."""
    found = topics(50)
    stamp = found[0].fields["timestamp"]
    types = ["uint64_t timestamp", "float[2] a", "uint8_t[4] _padding0"]
    found.append(Topic("nested", {"timestamp": stamp, "a": np.arange(100.0).reshape(50, 2)}, 0, types))
    faults = Faults()
    got = read(write_ulog(tmp_path / "v.ulg", found), faults=faults, named=channels() | {"a": {"path": "nested.a[1]"}})
    np.testing.assert_array_equal(got["gyro"][:, 0], found[0].fields["x"].astype(np.float32))
    np.testing.assert_array_equal(got["a"], np.arange(1.0, 100.0, 2))
    assert not any("bytes" in line for line in faults.lines())


@pytest.mark.parametrize("rows", [0, 1, 2, 7, 1024, 1025, 5000])
def test_some_rows_are_the_first_and_then_each_so_many_th(rows):
    found = sampled(rows)
    assert set(found) <= set(range(rows))
    assert len(found) <= 12 + rows / 1024
    assert rows == 0 or found[0] == 0


def test_a_number_that_is_subscribed_again_keeps_its_form(log, tmp_path):
    """As in two logs that were joined."""
    again = b"".join(message("A", bytes([0, number, 0]) + b"sensor_mag") for number in range(6))
    magnetometer = message("F", b"sensor_mag:uint64_t timestamp;float[9] field;")
    whole = log.read_bytes()
    (tmp_path / "again.ulg").write_bytes(whole[:16] + magnetometer + whole[16:] + again)
    got, expected = read(tmp_path / "again.ulg"), read(log)
    np.testing.assert_array_equal(got["gyro"], expected["gyro"])
    np.testing.assert_array_equal(got.t, expected.t)


def test_long_names_of_many_numbers_have_a_limit(log, tmp_path):
    form = message("F", b"wide:uint64_t timestamp;uint8_t[60000] " + 9000 * b"n" + b";")
    begin = log.read_bytes()
    (tmp_path / "names.ulg").write_bytes(begin[:16] + form + message("A", b"\0\x09\0wide") + begin[16:])
    with pytest.raises(UnreadableFile, match=r"the list of its numbers takes"):
        read(tmp_path / "names.ulg")
