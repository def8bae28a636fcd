"""Streams with their own time stamps, on the rows of another."""

from pathlib import Path

import numpy as np
import pytest

from fusion_plugins.sources.joining import joined, mapped, records


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
