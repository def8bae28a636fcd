"""Rows that cannot be used, and the statistics of innovations."""

import numpy as np
import pytest
import scipy.stats

from fusion_core.chunk import Chunk
from fusion_core.consistency import Whiteness, gate_of, nis_test, whiteness_p
from fusion_core.errors import EmptyRecording, MissingChannel, TimeBackwards
from fusion_core.faults import Faults, usable


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
    assert got[1].previous.t.tolist() == [1]
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


def test_nothing_left_is_an_error():
    with pytest.raises(EmptyRecording, match=r"r\.csv: has no usable row"):
        list(usable(chunks([np.nan, np.nan]), Faults(), "r.csv"))


def test_a_missing_channel_names_those_that_exist():
    with pytest.raises(MissingChannel, match="channel 'accel' is needed and the recording has gyro"):
        Chunk(np.zeros(1), {"gyro": np.zeros((1, 3))})["accel"]


def test_gate_and_bounds_equal_scipy():
    assert gate_of(6, 1e-7) == pytest.approx(scipy.stats.chi2.isf(1e-7, 6))
    bounds = nis_test(np.ones(500) * 6, 6, level=0.99)
    assert bounds.low == pytest.approx(scipy.stats.chi2.ppf(0.005, 3000) / 3000)
    assert bounds.high == pytest.approx(scipy.stats.chi2.ppf(0.995, 3000) / 3000)
    assert bounds.consistent
    assert not nis_test(np.ones(500) * 9, 6).consistent


def test_whiteness_accepts_white_and_refuses_coloured_noise():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(2000, 3))
    coloured = white + 0.3 * np.roll(white, 1, axis=0)
    assert np.all(whiteness_p(white) > 1e-3)
    assert np.all(whiteness_p(coloured) < 1e-9)


@pytest.mark.parametrize("cuts", [(), (7,), (3, 5, 11, 12, 900), tuple(range(1, 60))])
def test_autocorrelation_is_that_of_the_whole_however_it_comes(cuts):
    rng = np.random.default_rng(2)
    white = rng.normal(loc=[0.0, 3.0], size=(1000, 2))
    sums = Whiteness(2, lags=9)
    for part in np.split(white, cuts):
        sums.add(part)
    centred = white - white.mean(axis=0)
    expected = [np.sum(centred[k:] * centred[: len(white) - k], axis=0) for k in range(1, 10)]
    np.testing.assert_allclose(sums.autocorrelation(), expected / np.sum(centred**2, axis=0), rtol=0, atol=1e-12)


def test_whiteness_p_is_uniform_under_white_noise():
    rng = np.random.default_rng(1)
    p = np.concatenate([whiteness_p(rng.normal(size=(500, 6))) for _ in range(60)])
    assert scipy.stats.kstest(p, "uniform").pvalue > 1e-3
