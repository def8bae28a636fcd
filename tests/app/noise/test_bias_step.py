"""A step of the bias beside noise and walk: found where there is one, and not in what merely moves."""

import numpy as np
import pytest
from scipy.signal import lfilter

from driftlab.noise.bias_step import bias_steps, block_means

N, DT, AT = 24_000, 0.1, 9_000
T = np.arange(N) * DT
WHOLE = np.array([[0, N]])


def found_in(t, rate, stretches):
    return bias_steps(block_means(t, rate, stretches), rate.shape[1])


def slow(kind, rng):
    """Return a bias (N, 3) without a step, beside white noise of 1 a sample."""
    e = rng.normal(size=(N, 3))
    return {
        "nothing": lambda: 0 * e,
        "small walk": lambda: np.cumsum(e, axis=0) * 1e-3,
        "walk": lambda: np.cumsum(e, axis=0) * 3e-2,
        "gauss_markov": lambda: lfilter([np.sqrt(2 * DT / 200)], [1, DT / 200 - 1], e, axis=0) * 0.2,
        "ramp": lambda: np.outer(T / T[-1], [0.2, 1.0, 3.0]),
        "turn-on": lambda: np.outer(np.exp(-T / 500), [0.2, 0.5, 1.0]),
        "sine": lambda: np.outer(np.sin(T / 100), [0.05, 0.3, 1.0]),
        "burst": lambda: 5 * e * ((T > 800) & (T < 900))[:, None],
        "spike": lambda: np.outer(np.arange(N) == AT, [5.0, 50.0, 500.0]),
    }[kind]()


@pytest.mark.parametrize(
    "kind", ["nothing", "small walk", "walk", "gauss_markov", "ramp", "turn-on", "sine", "burst", "spike"]
)
def test_what_moves_without_a_step_has_none(kind):
    found = []
    for seed in range(4):
        rng = np.random.default_rng([seed, 77])
        found += found_in(T, rng.normal(size=(N, 3)) + slow(kind, rng), WHOLE)
    assert found == [None] * 12


@pytest.mark.parametrize("walk", [0.0, 1e-3])
def test_a_step_is_found_with_its_size_time_and_the_walk_beside_it(walk):
    rng = np.random.default_rng(5)
    rate = rng.normal(size=(N, 3)) + walk * np.cumsum(rng.normal(size=(N, 3)), axis=0)
    rate[AT:, 1] += 1.0
    x, y, z = found_in(T, rate, WHOLE)
    assert (x, z) == (None, None)
    assert abs(y.size - 1.0) < 4 * y.sigma
    assert y.sigma < 0.1
    assert abs(y.t - T[AT]) < 2 * T[-1] / 400
    assert y.walk < 3 * walk / np.sqrt(DT) + 2e-3


def test_a_step_across_a_gap_is_a_step_of_what_is_used():
    """What lies between stretches is motion, and not looked at."""
    rng = np.random.default_rng(6)
    rate = rng.normal(size=(N, 1))
    rate[AT:] += 1.0
    moving = slice(AT - 300, AT + 300)
    rate[moving] = 1e4 * rng.normal(size=(600, 1))
    (step,) = found_in(T, rate, np.array([[0, moving.start], [moving.stop, N]]))
    assert abs(step.size - 1.0) < 4 * step.sigma
    rate[moving.stop :] -= 1.0
    assert found_in(T, rate, np.array([[0, moving.start], [moving.stop, N]])) == [None]


def test_too_short_a_recording_has_none():
    assert found_in(T[:8], np.ones((8, 2)), np.array([[0, 8]])) == [None, None]


def test_thousands_of_stretches_are_not_looked_at():
    rows = np.arange(0, 24_000, 12)
    assert found_in(T, np.ones((N, 1)), np.stack([rows, rows + 10], axis=1)) == [None]
