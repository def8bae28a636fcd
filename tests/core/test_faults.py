"""Rows that cannot be used."""

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_core.errors import EmptyRecording, MissingChannel, TimeBackwards
from fusion_core.faults import Faults, advice_backwards, usable


def chunks(t, size=4, **channels):
    for k in range(0, len(t), size):
        yield Chunk(
            np.array(t[k : k + size], float), {n: np.array(v[k : k + size], float) for n, v in channels.items()}
        )


def test_what_cannot_be_used_is_left_out_and_counted():
    faults = Faults()
    t = [0, 1, 1, 2, np.nan, 4, 5, 6, 7, 7]
    gyro = [[0.0], [1], [1], [np.nan], [4], [5], [np.inf], [6], [7], [7]]
    valid = [1, 1, 1, 1, 1, np.nan, 1, 1, 1, 1]
    got = list(usable(chunks(t, gyro=gyro, valid=valid), faults, "r.csv"))
    assert np.concatenate([c.t for c in got]).tolist() == [0, 1, 6, 7]
    assert all("valid" not in c.channels for c in got)
    lines = "\n".join(faults.lines())
    for text in (
        "rows that repeat a time stamp, left out: 2 (first at 1.0 s)",
        "rows where gyro is not a finite number, left out: 2 (first at 2.0 s)",
        "rows with a time stamp that is not a number, left out: 1",
        "rows flagged as not valid, left out: 1 (first at 4.0 s)",
    ):
        assert text in lines


def test_time_that_runs_backwards_is_refused_also_across_chunks():
    with pytest.raises(TimeBackwards, match=r"r\.csv: time runs backwards by 1 s at 2\.0 s; sort the rows, or cut"):
        list(usable(chunks([0, 1, 2, 3, 2, 5]), Faults(), "r.csv"))


def test_what_no_sensor_shows_is_left_out_and_counted():
    faults = Faults()
    accel = [0, 1, 1e150, 3, -1e31, 5]
    got = list(usable(chunks(range(6), accel=accel), faults, "r.csv"))
    assert np.concatenate([c.t for c in got]).tolist() == [0, 1, 3, 5]
    assert faults.lines() == ["rows where accel is beyond 1e+30, left out: 2 (first at 2.0 s)"]
    with pytest.raises(EmptyRecording, match=r"no usable row \(rows where accel is beyond 1e\+30, left out: 3 .*units"):
        list(usable(chunks(range(3), accel=[1e150] * 3), Faults(), "r.csv"))


@pytest.mark.parametrize("largest", [1e30, -1e30, 5.0])
@pytest.mark.parametrize("count", [1, 3, 5000])
def test_the_largest_that_a_sensor_shows_is_used_and_the_next_number_is_not(count, largest):
    for value, used in ((largest, count), (np.nextafter(largest, 2 * largest), count - (abs(largest) > 5))):
        accel = [*[0.0] * (count - 1), value]
        got = list(usable(chunks(range(count + 1), size=count, accel=[*accel, 0.0]), Faults(), "r.csv"))
        assert sum(map(len, got)) == used + 1


def test_nothing_left_is_an_error():
    with pytest.raises(EmptyRecording, match=r"r\.csv: has no usable row"):
        list(usable(chunks([np.nan, np.nan]), Faults(), "r.csv"))


def test_a_missing_channel_names_those_that_exist():
    with pytest.raises(MissingChannel, match="channel 'accel' is needed and the recording has gyro"):
        Chunk(np.zeros(1), {"gyro": np.zeros((1, 3))})["accel"]


def test_a_note_is_said_once_and_is_no_reason_why_nothing_is_left():
    faults = Faults()
    for _ in range(2):
        faults.note("unit 7 was read")
    faults.add("torn rows", 2, "line 3")
    assert faults.lines() == ["unit 7 was read", "torn rows: 2 (first line 3)"]
    with pytest.raises(EmptyRecording, match=r"has no usable row \(torn rows: 2 \(first line 3\)\);"):
        list(usable([], faults, "r"))


@pytest.mark.parametrize(
    ("whole", "usual", "said"),
    [
        (86_400.0, 1.0, "add 86,400 s to the rows behind each midnight"),
        (2**32 * 1e-3, 0.01, "counter of 32 bits began again: add 4,294,967,296 ms"),
        (2**32 * 1e-6, 1.0, "counter of 32 bits began again: add 4,294,967,296 µs"),
        (2**16 * 1e-3, 0.1, "counter of 16 bits began again: add 65,536 ms"),
        (7.0, 1.0, "sort the rows"),
        (3600.0, 1.0, "sort the rows"),
    ],
)
def test_a_time_that_begins_again_is_not_to_be_sorted(whole, usual, said):
    steps = np.full(50, usual)
    steps[30] = usual - whole
    assert said in advice_backwards(steps, 30)
