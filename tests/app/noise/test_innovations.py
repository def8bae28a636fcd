"""Inflation of noise and walk: factors that are known are found, and 95 % is 95 %."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from driftlab.errors import SingularFit
from driftlab.noise.innovations import SensorReadings, inflation

NOISE, WALK = np.array([0.5, 2.0]), np.array([0.01, 0.02])


def readings(rng, N, white, walk, tau=1.0, ramp=0.0):
    """N readings of two axes at their noise and walk times factors, each `tau` s long."""
    steps = walk * WALK * np.sqrt(tau) * rng.normal(size=(N, 2))
    d = np.cumsum(steps, axis=0) + white * NOISE / np.sqrt(tau) * rng.normal(size=(N, 2))
    t = np.arange(N) * tau
    return SensorReadings(t, np.full(N, tau), d + ramp * t[:, None], np.zeros(N, dtype=bool))


@pytest.mark.parametrize("tau", [1.0, 4.0])
def test_factors_are_found_as_often_as_their_interval_says(tau):
    rng, inside, refused = np.random.default_rng(5), [], 0
    for _ in range(40):
        found = inflation(readings(rng, 4000, 1.6, np.array([2.5, 0.7]), tau), NOISE, WALK)
        inside += [(found.of_noise.low <= 1.6) & (found.of_noise.high >= 1.6)]
        inside += [(found.of_walk.low <= [2.5, 0.7]) & (found.of_walk.high >= [2.5, 0.7])]
        refused += sum(int(np.sum(lag.ratio > lag.high)) for lag in found.lags)
    share = np.mean(inside)  # of 160: 95 % has a deviation of 1.7 %
    assert 0.90 <= share <= 0.995
    assert refused <= 3  # of 240 or more, at 0.1 % each


def test_the_likelihood_is_that_of_the_joint_distribution():
    """The maximum is that of the normal density of all readings at once, their common level unknown."""
    rng = np.random.default_rng(8)
    few = readings(rng, 400, 1.3, np.array([2.0, 2.0]))
    found = inflation(few, NOISE, WALK)
    lower = np.tril(np.ones((400, 400)))[:, 1:]
    D = np.diff(np.eye(400), axis=0)  # differences know no level

    def density(axis, white, walk):
        P = (white * NOISE[axis]) ** 2 * np.eye(400) + (walk * WALK[axis]) ** 2 * lower @ lower.T
        return multivariate_normal.logpdf(D @ few.d[:, axis], cov=D @ P @ D.T)

    for axis in range(2):
        best = found.of_noise.value[axis], found.of_walk.value[axis]
        here = density(axis, *best)
        for more in (0.97, 1.03):
            assert density(axis, best[0] * more, best[1]) < here
            assert density(axis, best[0], best[1] * more) < here


def test_where_no_walk_is_seen_an_upper_limit_is_told():
    found = inflation(readings(np.random.default_rng(2), 1500, 1.0, np.zeros(2)), NOISE, WALK)
    assert np.all(found.of_walk.low == 0)
    assert np.all(found.of_walk.high > found.of_walk.value)
    assert np.all(found.of_walk.high < 3)


def test_a_walk_covers_a_ramp_over_the_horizon_and_no_more():
    """A bias of a steady rate r moves r L in a lag L: a walk that does so is r sqrt(L) times sqrt(3/2)."""
    rate = 3e-3
    found = inflation(readings(np.random.default_rng(3), 20_000, 1.0, np.ones(2), ramp=rate), NOISE, WALK)
    short, long = found.of_walk_up_to(10.0), found.of_walk_up_to(600.0)
    assert np.all(long > 2 * short)
    expected = np.sqrt(1.5) * rate * np.sqrt(600) / WALK
    np.testing.assert_allclose(long, np.hypot(expected, 1.0), rtol=0.15)


def test_what_is_missing_and_what_starts_anew_costs_nothing():
    rng = np.random.default_rng(7)
    whole = readings(rng, 12_000, 1.4, np.array([3.0, 3.0]))
    d, fresh = whole.d.copy(), whole.fresh.copy()
    d[rng.random(12_000) < 0.05] = np.nan
    d[6000:] += 100.0  # aligned again at another level
    fresh[6000] = True
    found = inflation(SensorReadings(whole.t, whole.tau, d, fresh), NOISE, WALK)
    np.testing.assert_allclose(found.of_noise.value, 1.4, rtol=0.05)
    np.testing.assert_allclose(found.of_walk.value, 3.0, rtol=0.25)
    assert all(np.all(lag.ratio < lag.high) for lag in found.lags)


def test_too_little_says_nothing():
    rng = np.random.default_rng(1)
    with pytest.raises(SingularFit, match="only 200 updates at rest count, at least 300 are needed; use a run"):
        inflation(readings(rng, 200, 1.0, np.ones(2)), NOISE, WALK)
    with pytest.raises(SingularFit, match="noise or walk is declared zero; declare both"):
        inflation(readings(rng, 400, 1.0, np.ones(2)), NOISE, np.array([0.0, 1.0]))
