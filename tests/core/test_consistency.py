"""The statistics of innovations."""

import numpy as np
import pytest
import scipy.stats

from fusion_core.consistency import Whiteness, gate_of, nis_test, whiteness_p


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
