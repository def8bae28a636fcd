"""Streams with their own time stamps, on the rows of another."""

from pathlib import Path

import numpy as np
import pytest

from fusion_core.chunk import Chunk, concatenate
from fusion_core.faults import Faults
from fusion_plugins.sources.joining import bridged, joined, mapped, records


def test_a_slow_stream_is_drawn_through():
    t, slow = np.arange(0.0, 10, 0.01), np.arange(0.0, 11.0)
    assert joined(t, slow, 3 * slow + 1) == pytest.approx(3 * t + 1)


def test_a_stream_as_fast_as_the_rows_keeps_its_samples_and_so_its_noise():
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 100, 0.01)
    values = rng.normal(size=(len(t), 3))
    found = joined(t, t + 0.004, values)  # as from a sensor beside it that is read out a little later
    np.testing.assert_array_equal(found, values)


def test_a_hole_in_a_stream_is_no_line():
    t, slow = np.arange(0.0, 100, 0.1), np.r_[0:20.0, 60:100.0]
    lacking = np.isnan(joined(t, slow, slow))
    np.testing.assert_array_equal(lacking, (t > 20.5 + 1e-9) & (t < 58.5 - 1e-9))


def test_nothing_is_held_for_long_beyond_the_ends():
    t, slow = np.arange(0.0, 30, 0.5), np.arange(10.0, 21.0)
    found = joined(t, slow, np.column_stack([slow, -slow]))
    assert found.shape == (60, 2)
    assert t[np.isfinite(found[:, 0])][[0, -1]] == pytest.approx([8.5, 21.5])


@pytest.mark.parametrize("M", [0, 1])
def test_a_stream_of_no_sample_or_one(M):
    found = joined(np.arange(3.0), np.ones(M), np.full(M, 7.0))
    assert np.isnan(found).all() if M == 0 else found[1] == 7.0


def table(T, t=None, size=7):
    """The chunks of a table of rows 1/8 s apart, of which few have a temperature."""
    t = np.arange(len(T)) / 8 if t is None else t
    return [Chunk(t[k : k + size], {"temperature": T[k : k + size]}) for k in range(0, len(T), size)]


@pytest.mark.parametrize("size", [1, 7, 64, 10_000])
def test_a_thermometer_of_few_rows_is_drawn_between_its_readings_however_the_rows_are_cut(size):
    row = np.arange(5000)
    read = (row % 10 == 3) & ~((row > 2000) & (row < 2600))
    T = np.where(read, 20 + row / 100, np.nan)
    chunks = list(bridged(table(T, size=size), size, faults := Faults()))
    assert max(map(len, chunks)) <= size
    got = concatenate(chunks)
    np.testing.assert_array_equal(got.t, row / 8)
    # a hole of 610 rows, beyond ten times ten; a reading holds for one and a half intervals towards it, and at the ends
    hole, begin, end = (row > 1993 + 15) & (row < 2603 - 15), row < 3, row > 4993
    np.testing.assert_array_equal(np.isnan(got["temperature"]), hole)
    held = np.where(row < 2300, 39.93, 46.03)
    expected = np.select([(row > 1993) & (row < 2603), begin, end], [held, 20.03, 69.93], 20 + row / 100)
    np.testing.assert_allclose(got["temperature"][~hole], expected[~hole], rtol=0, atol=1e-9)
    assert faults.lines() == [
        "temperature has a reading in 440 of 5,000 rows, every 1.25 s; it is interpolated in time between them, over "
        "1.25 s at most; gaps of more than 12.5 s are left as they are"
    ]


def test_time_counts_between_readings_and_not_rows():
    t = np.cumsum(np.random.default_rng(2).uniform(0.005, 0.015, 900))
    T = np.where(np.arange(900) % 9 == 0, 3 * t, np.nan)
    got = concatenate(bridged(table(T, t), 7, Faults()))
    np.testing.assert_allclose(got["temperature"][:892], 3 * t[:892])


@pytest.mark.parametrize(
    "T",
    [
        np.where(np.random.default_rng(1).random(2000) < 0.2, np.nan, 25.0),  # lost here and there
        np.full(2000, np.nan),
        np.r_[25.0, np.full(1999, np.nan)],
        np.where(np.arange(2000) % 10 == 0, 1e4, np.nan),  # nothing that can be
    ],
)
def test_what_is_no_slow_thermometer_is_passed_on_as_it_is(T):
    got = concatenate(bridged(table(T), 7, faults := Faults()))
    np.testing.assert_array_equal(got["temperature"], T)
    assert not faults.found


def test_rows_that_need_not_wait_are_not_held():
    """A hole of any length takes no memory, and a thermometer of every row is passed on after its first rows."""
    seen = []

    def rows(T):
        for chunk in table(T, size=10):
            seen.append(chunk)
            yield chunk

    next(bridged(rows(np.full(100_000, 25.0)), 10, Faults()))
    assert len(seen) == 2
    T = np.where(np.arange(100_000) % 10 == 0, 25.0, np.nan)
    T[1000:] = np.nan
    passed = 0
    seen.clear()
    for chunk in bridged(rows(T), 10, Faults()):
        passed += len(chunk)
        assert 10 * len(seen) - passed <= 120


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="needs Linux")
def test_memory_in_which_a_mapped_log_is_held_is_given_back(tmp_path):
    path = tmp_path / "log.bin"
    path.write_bytes(np.arange(1 << 21, dtype="<u4").tobytes())
    data = mapped(path)

    def held():
        """Return the kB of the file that are in this process's memory."""
        parts = Path("/proc/self/smaps").read_text().split(str(path))[1:]
        return sum(int(part.split("Rss:")[1].split()[0]) for part in parts)

    at = 4 * np.arange(0, 1 << 21, 7)
    assert data[at].sum() > 0
    assert held() >= 8192
    assert np.array_equal(records(data, at, np.dtype("<u4")), np.arange(0, 1 << 21, 7))
    assert held() < 100
    assert np.array_equal(records(data.tobytes(), at[:9], np.dtype("<u4")), np.arange(0, 63, 7))
