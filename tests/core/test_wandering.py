"""Wandering processes: their covariance beside means of simulated samples, and the limits of their mean square."""

import numpy as np
import pytest

from fusion_core.wandering import BiasWalk, bounds, contrasts, mean_squares, rows_of


@pytest.mark.parametrize("taus", [(), (40.0,), (5.0, 400.0)])
def test_the_covariance_of_means_is_that_of_the_mean_of_samples(taus):
    fine, N = 100, 8
    law = BiasWalk(0.0, 800.0, taus)
    samples = law.covariance((np.arange(fine * N) + 0.5), 1.0)
    means = samples.reshape(N, fine, N, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(law.covariance(100.0 * (np.arange(N) + 0.5), 100.0), means, rtol=2e-3, atol=1e-6)


def test_rows_keep_the_sum_of_squares():
    t, averages = 30.0 * np.arange(101), np.random.default_rng(0).normal(size=(101, 2))
    rows, means = rows_of(t, averages, 30)
    assert rows.size == 4
    n = np.array([4.0] * 24 + [5.0])
    np.testing.assert_allclose(rows.within + n @ means**2, np.sum(averages**2, axis=0))


def test_white_noise_alone_is_between_its_limits_and_they_are_narrow():
    rng, inside, width = np.random.default_rng(1), [], []
    t = 30.0 * np.arange(480)
    for _ in range(40):
        rows, means = rows_of(t, rng.normal(size=(480, 1)), 120)
        P = np.eye(120) - 1 / 120
        each = contrasts(rows, P)
        low, high = bounds(rows, each, means[:, 0], float(rows.within[0]), mean_squares(rows, P))
        inside.append(low <= 479 / 480 <= high)
        width.append(high / low)
    assert np.mean(inside) >= 0.85  # 90 % or more
    assert np.median(width) < 1.5  # of 480 squares: 90 % lie within a factor of 1.24
