"""A file of a device's bytes gives what the port would have given; frames are packed in `bench`, by struct and zlib."""

import gzip
import struct

import numpy as np
import pytest
from bench import FRAMING, SIZE, frame
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from recordings_on_disk import read, text

from fusion_core.contracts.framing import DAMAGED, GARBAGE, REPEATED
from fusion_core.errors import UnreadableFile, seconds
from fusion_core.faults import LOST, RESTARTS, Faults
from fusion_core.testing import check_plugin
from fusion_plugins.sources import binary_log
from fusion_plugins.sources.binary_log import BEGUN, BinaryLog

PLAIN = {key: value for key, value in FRAMING.items() if key != "counter"}
CLOCK = {
    "kind": "binary", "sync": "EB 90", "fields": [
        {"name": "stamp", "type": "uint32"}, {"name": "gyro", "type": "int16", "count": 3, "unit": "0.01 deg/s"},
    ],
    "checksum": {"kind": "sum8", "start": 2, "complement": True},
    "counter": {"field": "stamp", "modulo": 2**32, "tick": "1 us"},
}  # fmt: skip


def clocked(stamp, gyro=(1, 2, 3)):
    body = struct.pack("<I3h", stamp % 2**32, *gyro)
    return b"\xeb\x90" + body + bytes([-sum(body) % 256])


def log(path, framing=None, **more):
    framing = FRAMING if framing is None else framing
    return BinaryLog(path=path, framing=framing, **({"interval": 0.01} if framing is FRAMING else {}) | more)


def told(source):
    faults = Faults()
    return read(source, faults=faults), {what: fault.count for what, fault in faults.found.items()}


def test_samples_and_times_come_from_the_frames(tmp_path):
    got = read(log(text(tmp_path, b"".join(frame(k, gyro=(k, 0, -k)) for k in range(65500, 65600)), "a.bin")))
    np.testing.assert_allclose(got.t, np.arange(100) * 0.01)  # across the counter's wrap at 65536
    np.testing.assert_array_equal(got["gyro"][:, 0], np.arange(65500, 65600))
    np.testing.assert_allclose(got["accel"][0], [0, 0, 9.80665])
    np.testing.assert_allclose(got["temperature"], 25.0)


def test_lost_and_damaged_frames_leave_gaps_and_are_counted(tmp_path):
    kept = [k for k in range(60) if k not in (20, 21, 22)]
    frames = [frame(k) for k in kept]
    bad = bytearray(frames[40])
    bad[30] ^= 4
    frames[40] = bytes(bad)
    got, faults = told(log(text(tmp_path, b"xyz" + b"".join(frames) + frame(60)[:-5], "a.bin")))
    expected = [k for k in kept if k != kept[40]]
    np.testing.assert_allclose(got.t, np.array(expected) * 0.01)
    assert faults == {GARBAGE: 3 + SIZE, DAMAGED: 1, LOST: 4}


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.sampled_from(["good", "lost", "torn", "noise"]), min_size=1, max_size=40),
    st.integers(1, 700), st.integers(1, 50),
)  # fmt: skip
def test_any_split_into_blocks_gives_the_same_samples(tmp_path, parts, block, size):
    data = frame(0) + b"".join(
        {"good": frame(k), "lost": b"", "torn": frame(k)[:40], "noise": b"\xa5" * 9}[part]
        for k, part in enumerate(parts, 1)
    )
    source = log(text(tmp_path, data, "a.bin"))
    whole, faults = told(source)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(binary_log, "BLOCK", block)
        again, same = told(source)
        pieces = read(source, size=size)
    assert same == faults
    for other in (again, pieces):
        np.testing.assert_array_equal(other.t, whole.t)
        np.testing.assert_array_equal(other["gyro"], whole["gyro"])


def test_a_clock_in_the_frames_needs_no_interval(tmp_path):
    stamps = 2**32 - 250_000 + np.concatenate([np.arange(100), np.arange(150, 200)]) * 5000
    source = log(text(tmp_path, b"".join(map(clocked, stamps.tolist())), "a.dat"), CLOCK)
    got, faults = told(source)
    np.testing.assert_allclose(got.t, (stamps - stamps[0]) * 1e-6, atol=1e-12)
    assert faults == {LOST: 50}
    assert "time" not in source.channels
    _, faults = told(source.model_copy(update={"interval": 0.006}))
    (what,) = set(faults) - {LOST}
    assert what == (
        "rate not as declared: samples are 5 ms and not 6 ms apart by the device's clock; correct source.interval"
    )


def test_a_clock_that_begins_anew_goes_on(tmp_path):
    stamps = [*range(5_000_000, 5_100_000, 5000), *range(0, 100_000, 5000)]
    got, faults = told(log(text(tmp_path, b"".join(map(clocked, stamps)), "a.dat"), CLOCK))
    np.testing.assert_allclose(np.diff(got.t), 5e-3)
    assert faults == {RESTARTS: 1}


def test_frames_that_are_sent_twice_are_one_sample(tmp_path):
    """Every one twice from the fifth on, also a clock's, whose usual step is then still that of samples."""
    for pack, framing, more in (
        (frame, FRAMING, {"interval": 0.01}),
        (lambda k: clocked(5000 * k), CLOCK, {}),
    ):
        data = b"".join(pack(k) * (1 + (k >= 5)) for k in range(100))
        source = log(text(tmp_path, data, "a.bin"), framing, **more)
        faults = Faults()
        got = read(source, faults=faults)
        np.testing.assert_allclose(np.diff(got.t), got.t[1])
        assert (len(got), list(faults.found)) == (100, [REPEATED])
        fault = faults.found[REPEATED]
        assert (fault.count, fault.first) == (95, f"after {seconds(got.t[5])}")


def test_a_counter_of_frames_at_its_beginning_may_have_restarted(tmp_path):
    """62,536 samples are lost by the counter; that it is at zero behind them, one in 65,536 losses would bring."""
    data = b"".join(frame(k % 3000) for k in range(3010))
    faults = Faults()
    got = read(log(text(tmp_path, data, "a.bin")), faults=faults)
    assert got.t[-1] == pytest.approx((65536 + 9) * 0.01)
    assert {what: (fault.count, fault.first) for what, fault in faults.found.items()} == {
        LOST: (62536, "after 29.99 s"), BEGUN: (1, "after 29.99 s")
    }  # fmt: skip
    lost = b"".join(frame(k) for k in [*range(65000, 65500), *range(65540, 65600)])
    assert told(log(text(tmp_path, lost, "b.bin")))[1] == {LOST: 40}


def test_a_time_in_the_frames_is_the_time(tmp_path):
    framing = {"kind": "binary", "sync": "AA", "byte_order": "big", "fields": [
        {"name": "time", "type": "float64", "unit": "ms"},
        {"name": "gyro", "type": "float32", "unit": "deg/s"}]}  # fmt: skip
    data = b"".join(b"\xaa" + struct.pack(">df", t, 1.0) for t in (7000, 7010, 7025))
    got = read(log(text(tmp_path, data, "a.raw"), framing))
    np.testing.assert_allclose(got.t, [7.0, 7.01, 7.025])
    with pytest.raises(ValidationError, match="both a field time and an interval are given; remove the interval"):
        log(tmp_path / "a.raw", framing, interval=0.01)


def test_a_part_and_an_archive(tmp_path):
    data = b"".join(frame(k) for k in range(300))
    packed = tmp_path / "a.bin.gz"
    packed.write_bytes(gzip.compress(data))
    plain = log(text(tmp_path, data, "a.bin"))
    np.testing.assert_array_equal(read(log(packed)).t, read(plain).t)
    np.testing.assert_allclose(read(log(packed, start=1.0, stop=1.5)).t, 1 + np.arange(50) * 0.01)
    check_plugin(BinaryLog, [plain, log(packed)])


def test_channels_are_the_framings_unless_some_are_named(tmp_path):
    path = text(tmp_path, b"".join(map(frame, range(10))), "a.bin")
    assert list(log(path).channels) == ["gyro", "accel", "temperature"]
    again = BinaryLog.model_validate(log(path).model_dump())
    assert read(again).channels.keys() == read(log(path)).channels.keys()
    few = read(log(path, channels={"gyro": {"path": "gyro"}, "board": {"path": "temperature"}}))
    assert list(few.channels) == ["gyro", "board"]


@pytest.mark.parametrize(("framing", "what"), [(PLAIN, "no counter"), (FRAMING, "a counter of frames")])
def test_without_a_clock_an_interval_is_needed(tmp_path, framing, what):
    with pytest.raises(ValidationError, match=f"the framing has {what} and no clock; write interval: 10 ms"):
        BinaryLog(path=tmp_path / "a.bin", framing=framing)


def test_without_a_counter_samples_are_an_interval_apart(tmp_path):
    path = text(tmp_path, frame(7) + frame(9) + frame(7), "a.bin")
    np.testing.assert_allclose(read(log(path, PLAIN, interval=0.5)).t, [0, 0.5, 1.0])


def test_what_has_no_frame_is_refused(tmp_path):
    with pytest.raises(
        UnreadableFile, match=r"has no whole frame of kind binary in 90 bytes, and 1 damaged ones; correct "
        r"source\.framing, or name another file",
    ):  # fmt: skip
        read(log(text(tmp_path, b"\xa5" * 29 + b"\0" + frame(1)[:-1] + b"xyz", "a.bin")))
    with pytest.raises(UnreadableFile, match="is an HDF5 file, a file of kind binary_log was expected; use kind: hdf5"):
        read(log(text(tmp_path, b"\x89HDF\r\n\x1a\n" + bytes(100), "a.bin")))
