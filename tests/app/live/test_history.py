"""The history of a live run: bounded, and no extreme is lost in it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from driftlab.live.history import History

NAMES = ["t", "v", "v_low", "v_high"]


def rows_of(values, spacing=0.1, start=0.0):
    t = start + spacing * np.arange(len(values))
    return np.column_stack([t, values, values, values])


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=30),
    st.sampled_from([0.01, 0.1, 3.0]),
    st.integers(0, 2**31),
)
def test_the_whole_run_keeps_every_extreme_however_it_came(sizes, spacing, seed):
    values = np.random.default_rng(seed).normal(size=sum(sizes))
    history = History(NAMES, 0.5, "widen", capacity=16)
    all_rows, at = rows_of(values, spacing), 0
    for size in sizes:
        history.add(all_rows[at : at + size])
        at += size
        assert len(history.view.rows) <= 16
    found, width = history.view.rows, history.view.width
    number = np.floor(all_rows[:, 0] / width)
    assert len(found) == len(np.unique(number))
    for row, k in zip(found, np.unique(number), strict=True):
        within = number == k
        assert row[0] == all_rows[within][-1, 0]
        assert row[1] == values[within][-1]
        assert row[2] == values[within].min()
        assert row[3] == values[within].max()


def test_the_last_minutes_are_kept_as_they_were():
    history = History(NAMES, 1.0, "forget", capacity=20)
    values = np.arange(1000.0)
    for start in range(0, 1000, 7):
        history.add(rows_of(values[start : start + 7], 1.0, float(start)))
        found = history.view.rows[:, 1]
        assert len(found) <= 20
        np.testing.assert_array_equal(found, np.arange(found[-1] - len(found) + 1, found[-1] + 1))
    assert len(found) >= 10
    assert history.view.width == 1.0


def test_more_than_fits_at_once_is_thinned_too():
    history = History(NAMES, 0.5, "widen", capacity=16)
    history.add(rows_of(np.arange(10_000.0)))
    assert len(history.view.rows) <= 16
    assert history.view.rows[0, 2] == 0.0
    assert history.view.rows[-1, 3] == 9_999.0
    gone = History(NAMES, 0.5, "forget", capacity=16)
    gone.add(rows_of(np.arange(10_000.0)))
    assert gone.view.rows[-1, 1] == 9_999.0


@pytest.mark.parametrize("full", ["widen", "forget"])
def test_who_asks_for_what_is_new_has_all_of_it(full):
    history, rng = History(NAMES, 0.5, full, capacity=16), np.random.default_rng(4)
    values, at, mine, generation = rng.normal(size=2000), 0, np.empty((0, 4)), 0
    while at < len(values):
        size = int(rng.integers(1, 30))
        history.add(rows_of(values[at : at + size], 0.1, 0.1 * at))
        at += size
        if rng.random() < 0.5:
            start, new = history.view.since(generation, len(mine))
            mine, generation = np.vstack([mine[:start], new]), history.view.generation
            np.testing.assert_array_equal(mine, history.view.rows)


def test_what_is_not_known_does_not_hide_what_is():
    history = History(NAMES, 1.0, "widen")
    history.add(rows_of(np.array([np.nan, 2.0, np.nan])))
    np.testing.assert_array_equal(history.view.rows[0, 2:], [2.0, 2.0])
