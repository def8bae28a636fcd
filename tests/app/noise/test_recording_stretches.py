"""Gaps, rows that are not usable, and motion cut a recording into stretches."""

import numpy as np
import pytest

from driftlab.noise.recording import NEVER, RestWindows, limits, pieces


def times(*spans):
    return np.concatenate([np.arange(start, stop) for start, stop in spans]) * 0.1


def test_gaps_cut_and_what_is_too_short_is_left_out():
    cut = pieces(times((0, 50), (60, 200), (300, 302), (400, 450)))
    assert cut.rows.tolist() == [[0, 50], [50, 190], [190, 192], [192, 242]]
    assert cut.missing.tolist() == [10, 100, 98]
    assert cut.spans.tolist() == [[0, 190], [192, 242]]
    assert (cut.samples, cut.places.tolist(), cut.enough) == (240, [200, 50], True)
    for few in (times((0, 1)), times((0, 2)), times((0, 0)), times((0, 1), (4, 5))):
        assert pieces(few).spans.tolist() == []
        assert not pieces(few).enough


def test_a_lost_sample_is_a_gap():
    cut = pieces(times((0, 50), (51, 99)))
    assert (cut.rows.tolist(), cut.missing.tolist()) == ([[0, 50], [50, 98]], [1])


def test_stamps_that_jitter_are_no_gaps():
    """Stamps late and early by up to 45 % of the interval: steps of 0.1 to 1.9 of it, and none is lost."""
    jitter = np.random.default_rng(1).uniform(-0.045, 0.045, 5_000)
    t = np.arange(5_000) * 0.1 + jitter
    whole = pieces(t)
    assert whole.places.tolist() == [5_000]
    assert whole.dt == pytest.approx(0.1, rel=1e-4)
    lossy = pieces(np.delete(t, range(3_000, 3_020)))
    assert (lossy.missing.max(), lossy.missing.sum()) == (20, 20)
    assert lossy.dt == pytest.approx(0.1, rel=1e-4)


def test_rows_that_are_not_usable_cut_too_and_are_not_bridged():
    t = times((0, 100), (120, 220))
    usable = np.ones(200, dtype=bool)
    usable[20:22] = usable[90:110] = False
    cut = pieces(t, usable)
    assert cut.rows.tolist() == [[0, 20], [22, 90], [110, 200]]
    assert cut.missing.tolist() == [NEVER, NEVER]
    assert cut.spans.tolist() == cut.rows.tolist()
    assert pieces(t, ~usable).rows.tolist() == [[20, 22], [90, 100], [100, 110]]


def test_steps_are_those_within_stretches():
    t = times((0, 50), (60, 200))
    t[20] += 0.01
    low, high = limits(t, pieces(t).rows)
    assert (low, high) == (pytest.approx(0.09), pytest.approx(0.11))
    assert limits(t, np.array([[30, 50], [50, 190]])) == (pytest.approx(0.1), pytest.approx(0.1))


def test_windows_hold_rows_where_there_are_some():
    """After a gap of many windows the numbers go on; a year without samples is no year of windows."""
    rest = RestWindows(10.0, 60.0, np.array([0, 1, 500_000]), np.array([True, False, True]))
    t = np.array([9.0, 10.0, 69.0, 70.0, 129.0, 130.0, 10.0 + 60 * 500_000, 10.0 + 60 * 500_002])
    assert rest.rows(t).tolist() == [True, True, True, False, False, False, True, True]
    assert rest.moving.tolist() == [70.0]
    assert rest.longest == (10.0, 70.0)
    assert not rest.doubtful
    assert RestWindows(0.0, 60.0, np.arange(3), np.array([True, False, False])).doubtful
    assert RestWindows(0.0, 60.0, np.arange(2), np.zeros(2, dtype=bool)).longest is None
