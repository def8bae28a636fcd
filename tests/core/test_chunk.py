"""The steps of a chunk: constant where the time stamps say so, and the same wherever a recording is cut."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_core.chunk import Chunk, every


@pytest.mark.parametrize("start", [0.0, 1e5, 1.7e9])
@pytest.mark.parametrize("step", [0.01, 1 / 3, 0.0025, 1 / 128, 0.1, 2.5, 60.0, 3600.0])
def test_regular_time_stamps_have_one_step(start, step):
    t = start + np.arange(20_000) * step
    dt = Chunk(t).part(1, len(t)).dt
    assert dt.ndim == 0
    assert float(dt) == pytest.approx(step, rel=0, abs=4 * np.spacing(t[-1]))
    if start == 0.0:
        assert len(np.unique(np.diff(t))) > 1 or float(step * 1024).is_integer()
        assert float(dt) == step
    whole = Chunk(t).dt
    assert whole[0] == 0.0
    assert np.all(whole[1:] == dt)


@given(cuts=st.lists(st.integers(1, 4999), max_size=6), step=st.sampled_from([0.01, 1 / 300, 0.0123, 7.5]))
@settings(max_examples=60)
def test_steps_do_not_depend_on_where_a_recording_is_cut(cuts, step):
    whole = Chunk(1000.0 + np.arange(5000) * step)
    edges = sorted({0, 5000, *cuts})
    parts = [whole.part(a, b) for a, b in pairwise(edges)]
    steps = np.concatenate([np.full(len(part), part.dt) for part in parts])
    np.testing.assert_array_equal(steps, np.full(5000, whole.dt))


def test_what_is_not_rounding_is_not_taken_for_it():
    t = np.cumsum(np.r_[0.0, 0.01 + 1e-9 * np.arange(50)])
    np.testing.assert_array_equal(Chunk(t).part(1, 51).dt, np.diff(t))
    gap = np.r_[np.arange(10) * 0.01, 5 + np.arange(10) * 0.01]
    assert Chunk(gap).part(1, 20).dt.shape == (19,)
    assert float(Chunk(np.zeros(5)).dt) == 0.0
    assert Chunk(np.empty(0)).dt.shape == (0,)


def test_a_channel_more_leaves_the_steps_as_they_are_unless_it_is_them():
    chunk = Chunk(np.array([0.0, 0.01, 0.02])).part(1, 3)
    assert chunk.dt == chunk.having(gyro=np.zeros(2)).dt == 0.01
    assert chunk.having(dt=np.full(2, 0.5)).dt == 0.5
    with pytest.raises(ValueError, match="read-only"):
        chunk.having(gyro=np.zeros(2))["gyro"][0] = 1.0


@given(flags=st.lists(st.booleans(), max_size=9), step=st.sampled_from([1, 2, -1]))
def test_every_flag_is_looked_at_in_any_layout(flags, step):
    assert every(np.array(flags, dtype=bool)[::step]) == all(flags[::step])
    assert every(np.array([flags, flags], dtype=bool).T[::step]) == all(flags[::step])
