"""The reference of the yardsticks against the plain sum."""

import numpy as np

from driftlab.evaluation.scores import moving_average


def test_moving_average_with_gaps_and_motion_is_the_plain_sum():
    rng = np.random.default_rng(1)
    dt = rng.choice([0.1, 0.2, 4.0], p=[0.75, 0.19, 0.06], size=1500)
    t, tau = np.cumsum(dt), np.minimum(dt, 0.2)
    rate, still = rng.normal(size=(1500, 2)) + 5.0, rng.random(1500) > 0.2
    still[700:740] = False  # in the midst of it nothing is left to average
    got = moving_average(t, rate, tau, still, window=6.05)
    for k in range(1500):
        near = (np.abs(t - t[k]) <= 3.025) & still
        enough = still[k] and np.sum(tau[near]) >= 2.0
        expected = np.average(rate[near], axis=0, weights=tau[near]) if enough else [np.nan, np.nan]
        np.testing.assert_allclose(got[k], expected, rtol=1e-12)
    assert 0.1 < np.mean(np.isfinite(got[still])) < 0.99
    assert np.all(np.isnan(got[~still]))


def test_moving_average_is_the_mean_of_the_window():
    t = np.arange(1, 2001) * 0.1
    rate = np.random.default_rng(0).normal(size=(2000, 2))
    got = moving_average(t, rate, np.full(2000, 0.1), np.ones(2000, bool), window=30.0)
    k = 1000
    np.testing.assert_allclose(got[k], rate[k - 150 : k + 151].mean(axis=0), rtol=1e-9)
    # at the ends it is as much of the window as there is
    np.testing.assert_allclose(got[0], rate[:151].mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(got[-1], rate[-151:].mean(axis=0), rtol=1e-9)
