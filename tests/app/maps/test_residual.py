"""The residual of averages after a map: white noise leaves little of itself, what is slow all."""

import numpy as np
import pytest

from driftlab.maps.residual import residual_of
from fusion_plugins.thermal_maps.polynomial import Polynomial

T = np.linspace(0, 40, 60_000)
NOTHING = Polynomial(order=1).fit(T, np.zeros((len(T), 2)), {})


def residual(bias, starts=(0,), interval=0.1):
    return tuple(whole(bias, starts, interval).rms)


def whole(bias, starts=(0,), interval=0.1):
    return residual_of(NOTHING, Polynomial(order=1), T[: len(bias)], bias, starts, interval)


def test_white_noise_is_averaged_and_what_is_slow_is_not():
    white = np.random.default_rng(0).normal(size=len(T))
    slow = np.sqrt(2) * np.sin(np.arange(len(T)) * 2 * np.pi / 20_000)
    found = residual(np.stack([white, slow], axis=1))
    assert found[0] == pytest.approx(1 / np.sqrt(300), rel=0.15)  # of 200 averages: 5 %
    assert found[1] == pytest.approx(1, rel=0.01)


def test_no_average_reaches_over_two_recordings():
    level = np.where(np.arange(1050) < 450, 1.0, -1.0)  # 1.5 averages of one recording, then two of another
    assert residual(np.stack([level, 2 * level], axis=1), starts=(0, 450)) == (1.0, 2.0)


def test_a_recording_shorter_than_an_average_is_one():
    alternating = np.tile([1.0, -1.0], 10)
    assert residual(np.stack([alternating, np.ones(20)], axis=1)) == (0.0, 1.0)


def test_the_mean_of_many_soaks_is_between_the_limits_of_one():
    """White noise and a walk of which a cubic takes what it can; the truth is the mean over the soaks."""
    rng, N, settings = np.random.default_rng(1), 5400, Polynomial(order=3)
    cycle = 20 - 20 * np.cos(4 * np.pi * np.arange(N) / N)
    soaks = []
    for _ in range(60):
        bias = 4 * rng.normal(size=(N, 2)) + 0.03 * np.cumsum(rng.normal(size=(N, 2)), axis=0)
        soaks.append(residual_of(settings.fit(cycle, bias, {}), settings, cycle, bias, (0,), 2.0))
    true = np.sqrt(np.mean([soak.rms**2 for soak in soaks]))
    assert np.mean([soak.high >= true for soak in soaks]) >= 0.88  # 95 %, of 120
    assert np.mean([soak.low <= true for soak in soaks]) >= 0.88
    assert np.mean([soak.high / soak.rms for soak in soaks]) < 2


def test_of_few_averages_nothing_is_said():
    few = whole(np.ones((1000, 2)))
    assert few.as_record(100.0)["averaged_bounds"] is None
