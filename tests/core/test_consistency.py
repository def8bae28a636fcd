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


def local_level(seed, declared, R=1.0, N=20_000):
    """White innovations (N, 1) of a Kalman filter of one state, written out, on a walk of 0.02 under white noise of 1.

    Its steady gain K is that of P = (q + sqrt(q^2 + 4 q R)) / 2 before an update, q the variance of the declared step.
    """
    rng, q = np.random.default_rng(seed), declared**2
    b, P = np.cumsum(0.02 * rng.normal(size=N)), (q + np.sqrt(q**2 + 4 * q * R)) / 2
    y, x, white = b + rng.normal(size=N), b[0], np.empty((N, 1))
    for k in range(N):
        white[k] = (y[k] - x) / np.sqrt(P + R)
        x += P / (P + R) * (y[k] - x)
    return white


def test_a_walk_that_is_declared_too_small_adds_up_though_no_update_shows_it():
    """At a third of the walk the error has e^2 = K / (2 - K) + (0.02 / K)^2 / (2 / K - 1), K the steady gain."""
    q = (0.02 / 3) ** 2
    K = (P := (q + np.sqrt(q**2 + 4 * q)) / 2) / (P + 1)
    error = K / (2 - K) + 0.02**2 / (K * (2 - K))
    for seed in range(4):
        white = local_level(seed, 0.02 / 3)
        sums = Whiteness(1)
        for part in np.array_split(white, [1, 20, 6_000, 6_001]):
            sums.add(part)
        ratio, rows, p, square = (float(column[0]) for column in sums.slow())
        assert nis_test(white[:, 0] ** 2, 1).mean < 1.06
        assert p < 1e-6
        assert (ratio - 1) / rows * square * (P + 1) == pytest.approx(error - P, rel=0.5)


def test_with_noise_declared_too_large_the_sums_say_the_error_that_there_is():
    """Nine times the variance: the gain is too small, and the error far below the deviation P that the filter has."""
    R, q = 9.0, 0.02**2
    K = (P := (q + np.sqrt(q**2 + 4 * q * R)) / 2) / (P + R)
    error = K / (2 - K) + 0.02**2 / (K * (2 - K))
    for seed in range(4):
        sums = Whiteness(1)
        sums.add(local_level(seed, 0.02, R))
        ratio, rows, _, square = (float(column[0]) for column in sums.slow())
        assert square * (P + (ratio - 1) / rows * (P + R)) == pytest.approx(error, rel=0.4)
        assert error < 0.6 * P


def test_white_innovations_add_up_as_often_as_they_may():
    """Of 400 the p-values lie below 5 % in 20 or so; with several sizes tried, in fewer."""
    sums = Whiteness(400)
    sums.add(np.random.default_rng(1).normal(size=(10_000, 400)))
    assert np.sum(sums.slow()[2] < 0.05) <= 28


def test_sums_of_blocks_are_those_of_the_rows_however_they_come():
    white = np.random.default_rng(2).normal(size=(70_001, 2))
    whole, parts = Whiteness(2), Whiteness(2)
    whole.add(white)
    for part in np.array_split(white, 37):
        parts.add(part)
    blocks = white[: 70_001 // 32 * 32].reshape(-1, 32, 2).sum(axis=1)
    for sums in (whole, parts):
        np.testing.assert_allclose(sums._sums, blocks, atol=1e-10)
