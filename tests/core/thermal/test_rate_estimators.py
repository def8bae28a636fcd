"""Temperature rates against ramps that are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_core.thermal.rate_estimators import Kalman, Regression


@pytest.mark.parametrize("estimator", [Regression(window="60 s"), Kalman()], ids=lambda e: e.kind)
def test_a_steady_ramp_is_followed_without_lag(estimator):
    t = np.arange(0, 3000, 0.1)
    T = 20 + t / 30.0  # 2 K/min
    smooth, rate, _ = estimator.run(np.full(len(t), 0.1), T, estimator.start(T[0]))
    late = t > 600
    np.testing.assert_allclose(smooth[late], T[late], atol=2e-3)
    np.testing.assert_allclose(rate[late], 1 / 30.0, rtol=2e-3)


@pytest.mark.parametrize(
    "estimator", [Regression(window="120 s"), Kalman(noise="0.3 K", walk="5e-5 K/s/sqrt(s)")], ids=lambda e: e.kind
)
def test_a_sensor_with_steps_of_one_degree_still_gives_a_rate(estimator):
    t = np.arange(0, 1800, 0.1)
    T = np.round(20 + t / 30.0)
    smooth, rate, _ = estimator.run(np.full(len(t), 0.1), T, estimator.start(T[0]))
    late = t > 900
    assert np.abs(rate[late] - 1 / 30).max() < 0.5 / 30
    assert np.abs(smooth[late] - (20 + t[late] / 30.0)).max() < 0.5


@pytest.mark.parametrize("estimator", [Regression(), Kalman()], ids=lambda e: e.kind)
def test_a_temperature_that_stalls_has_no_rate(estimator):
    dt, T = np.full(5000, 0.1), np.full(5000, 25.0)
    dt[2000] = 5000.0  # a gap
    smooth, rate, _ = estimator.run(dt, T, estimator.start(25.0))
    np.testing.assert_allclose(smooth, 25.0, atol=1e-9)
    np.testing.assert_allclose(rate, 0.0, atol=1e-9)


@given(cut_at=st.integers(1, 499))
@settings(max_examples=20)
@pytest.mark.parametrize("estimator", [Regression(), Kalman()], ids=lambda e: e.kind)
def test_a_rate_estimator_can_be_cut_anywhere(estimator, cut_at):
    rng = np.random.default_rng(0)
    dt, T = rng.uniform(0.05, 0.2, 500), 20 + np.cumsum(rng.normal(size=500)) * 0.01
    whole = estimator.run(dt, T, estimator.start(T[0]))
    first = estimator.run(dt[:cut_at], T[:cut_at], estimator.start(T[0]))
    second = estimator.run(dt[cut_at:], T[cut_at:], first[2])
    np.testing.assert_array_equal(whole[0], np.concatenate([first[0], second[0]]))
    np.testing.assert_array_equal(whole[1], np.concatenate([first[1], second[1]]))
