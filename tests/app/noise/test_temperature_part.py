"""What a bias owes to the temperature is told from walks, ramps and steps of its own."""

import numpy as np
import pytest
from scipy.signal import lfilter

import driftlab
from driftlab.noise.bias_step import block_means
from driftlab.noise.temperature_part import temperature_parts

N, HOUR = 43_200, 3600.0
t = np.arange(N) * 1.0
WHOLE = np.array([[0, N]])
ROOMS = {  # K, over 12 h
    "swings": lambda rng: 0.2 * np.sin(2 * np.pi * t / (6 * HOUR) + rng.uniform(0, 6)),
    "drifts": lambda rng: 0.4 * t / t[-1],
    "wanders": lambda rng: 2e-3 * np.cumsum(rng.normal(size=N)),
}
BIASES = {  # deg/h, beside white noise of 4 deg/h/sqrt(Hz)
    "nothing": lambda rng: 0 * t,
    "walk": lambda rng: 0.02 * np.cumsum(rng.normal(size=N)),
    "large walk": lambda rng: 0.3 * np.cumsum(rng.normal(size=N)),
    "ramp": lambda rng: 1e-3 * t,
    "flicker": lambda rng: sum(
        lfilter([np.sqrt(2 / tau)], [1, 1 / tau - 1], 0.7 * rng.normal(size=N)) for tau in np.logspace(0, 4, 5)
    ),
    "warming up": lambda rng: 10 * np.exp(-t / 2500),
    "step": lambda rng: 10.0 * (t > 0.4 * t[-1]),
}


def parts(bias, T):
    return temperature_parts(block_means(t, bias, WHOLE), T)


@pytest.mark.parametrize("room", ROOMS)
@pytest.mark.parametrize("bias", BIASES)
def test_a_bias_that_does_not_follow_the_room_owes_it_nothing(bias, room):
    rng = np.random.default_rng([len(bias), len(room)])
    rate = np.stack([BIASES[bias](rng) + 4 * rng.normal(size=N) for _ in range(4)], axis=1)
    assert parts(rate, 25 + ROOMS[room](rng) + 0.02 * rng.normal(size=N)) == [None] * 4


def test_a_frozen_thermometer_says_nothing():
    assert parts(np.random.default_rng(0).normal(size=(N, 2)), np.full(N, 25.0)) == [None, None]


@pytest.mark.parametrize("slope", [3.0, 5.0])
@pytest.mark.parametrize("ageing", [0.0, 1e-3])
def test_a_room_that_swings_moves_the_bias_by_its_slope(slope, ageing):
    """The part is that of the variances: slope^2 2^2 / 2 beside a walk of 0.02 deg/h/sqrt(s), with any ramp."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        T = 25 + 2 * np.sin(2 * np.pi * t / (6 * HOUR) + rng.uniform(0, 6))
        walk = 0.02 * np.cumsum(rng.normal(size=N))
        rate = slope * T + walk + ageing * t + 4 * rng.normal(size=N)
        (found,) = parts(rate[:, None], T + 0.02 * rng.normal(size=N))
        assert found.moved == pytest.approx(4.0, abs=0.1)
        assert found.part == pytest.approx(min(np.var(slope * T) / np.var(slope * T + walk), 1.0), abs=0.35)


def analysed(rate, T):
    return driftlab.allan({}, {"time": (t, "s"), "gyro": (rate, "deg/h"), "temperature": (T, "degC")})


def test_the_notes_blame_the_temperature_and_no_step_and_the_lines_are_in_doubt():
    """A soak by two steps over 50 K, and a bias with a switch at 18 degC on x, and nothing of it on y."""
    rng = np.random.default_rng(3)
    T = lfilter([1 / 300], [1, 1 / 300 - 1], np.select([t < N / 3, t < 2 * N / 3], [0.0, 50.0], 20.0))
    curve = np.stack([120 * np.tanh((T - 18) / 3), 0 * T, 3 * T], axis=1)
    rate = curve + np.cumsum(0.02 * rng.normal(size=(N, 3)), axis=0) + 4 * rng.normal(size=(N, 3))
    found = analysed(rate, T)
    text = "\n".join(found.lines())
    assert found.found.warmed == {"gyro": ["x", "z"]}
    assert "gyro x: the temperature moves by" in text
    assert "steps by" not in text
    assert "a rate ramp shows" not in text
    assert "# in doubt: the bias follows the temperature in x, z" in found.config_lines
    alone = analysed(rate[:, [1, 1, 1]] + 0.1 * rng.normal(size=(N, 3)), T)
    assert alone.found.warmed == {"gyro": []}
    assert "in doubt" not in alone.config_lines
