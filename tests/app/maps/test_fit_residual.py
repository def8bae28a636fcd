"""What a map leaves of averages: white noise leaves little of itself, what is slow all."""

import numpy as np
import pytest

from driftlab.maps.fit import Gathered, averaged_residual
from fusion_plugins.thermal_maps.polynomial import Polynomial

T = np.linspace(0, 40, 60_000)
NOTHING = Polynomial(order=1).fit(T, np.zeros((len(T), 2)), {})


def residual(bias, starts=(0,), interval=0.1):
    return averaged_residual(NOTHING, Gathered(T[: len(bias)], bias, ["a"] * len(starts), list(starts), interval))


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
