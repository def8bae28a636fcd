"""Turning points: each way goes on until it is back by as much as a turn."""

import numpy as np
import pytest

from fusion_core.thermal.sweeps import directions, rise_and_fall, sweeps_of, turning_points

T = np.array([0, 5, 10, 9, 10, 4, 0, 1, 0, 6, 10], dtype=float)


def test_a_turn_is_at_the_last_sample_of_the_extreme():
    assert turning_points(T, 3.0) == [0, 4, 8, 10]
    np.testing.assert_array_equal(sweeps_of(T, 3.0), [0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2])
    np.testing.assert_array_equal(directions(T, 3.0), [1, 1, 1, 1, -1, -1, -1, -1, 1, 1, 1])
    assert rise_and_fall(T, 3.0) == (20.0, 10.0)


def test_upside_down_everything_is_the_other_way():
    assert turning_points(-T, 3.0) == turning_points(T, 3.0)
    np.testing.assert_array_equal(directions(-T, 3.0), -directions(T, 3.0))
    assert rise_and_fall(-T, 3.0) == (10.0, 20.0)


@pytest.mark.parametrize("values", [np.full(5, 3.0), 3 + 0.1 * np.arange(5.0)])
def test_what_hardly_moves_goes_no_way(values):
    for turn in (1.0, 0.0):
        assert turning_points(values, turn) == []
        assert not directions(values, turn).any()
        assert not sweeps_of(values, turn).any()
        assert rise_and_fall(values, turn) == (0.0, 0.0)


def test_before_it_begins_to_go_a_way_it_goes_none():
    np.testing.assert_array_equal(directions(np.array([2.0, 1.0, 0.0, 4.0, 8.0]), 3.0), [0, 0, 1, 1, 1])
