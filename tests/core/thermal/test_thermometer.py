"""Steps of a thermometer as its readings show them, and what a mean reading is off by."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_core.thermal.thermometer import noise_before, readings, sawtooth, started, steps_of


def stairs(seconds=18_000, dt=0.5):
    """Return a body of 150 s in a chamber that stays at every fifth degree."""
    t = np.arange(0, seconds, dt)
    chamber = np.concatenate([np.arange(-10, 50, 5.0), np.arange(50, -11, -5.0)])[(t / seconds * 25).astype(int)]
    T, share = np.empty_like(t), 1 - np.exp(-dt / 150)
    T[0] = chamber[0]
    for k in range(1, len(t)):
        T[k] = T[k - 1] + share * (chamber[k - 1] - T[k - 1])
    return T + 0.137


TRUE = stairs()


def shown(T, step, noise, mean=1, seed=0):
    """Return readings of a thermometer, `mean` of them averaged to one."""
    seen = T + noise * np.random.default_rng(seed).normal(size=len(T))
    seen = np.round(seen / step) * step if step else seen
    return seen[: len(T) // mean * mean].reshape(-1, mean).mean(axis=1)


@pytest.mark.parametrize("mean", [1, 2, 10])
@pytest.mark.parametrize(("step", "noise"), [(0.25, 0.0), (0.5, 0.02), (1.0, 0.0), (1.0, 0.02), (1.0, 0.2)])
def test_steps_are_seen_through_noise_and_averages(step, noise, mean):
    found = steps_of(shown(TRUE, step, noise, mean))
    assert found.size == pytest.approx(step, rel=0.01)
    # as large as the sawtooth that is left of them
    left = np.sqrt([np.sum(sawtooth(step, each)) for each in (found.noise, noise)])
    assert left[0] == pytest.approx(left[1], rel=0.3)


@pytest.mark.parametrize("mean", [1, 10])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("step", [0.25, 2.0, 5.0])
def test_coarse_steps_are_seen_on_a_slow_ramp(step, noise, mean):
    """Passing a border takes some seconds: means of ten readings then show several levels between two steps."""
    if noise > 0.1 * step:
        return
    T = 20 - 40 * np.abs(np.linspace(-1, 1, 14_400 * mean)) + 0.137
    found = steps_of(shown(T, step, noise, mean))
    assert found.size == pytest.approx(step, rel=1e-6)
    assert found.noise < max(1.2 * noise, 0.02 * step)


def test_steps_are_seen_through_long_averages():
    """Epochs of 10 s of means of ten, from -10 to 50 and back in six hours: a seventh of the sawtooth is left."""
    t = np.arange(0, 21_600, 0.1)
    T = 20 - 30 * np.cos(2 * np.pi * t / 21_600)
    assert steps_of(shown(T, 1.0, 0.2, 100)).size == pytest.approx(1.0, rel=0.01)
    assert steps_of(shown(T, 0.0, 0.2, 100)).size == 0.0


@pytest.mark.parametrize("mean", [1, 10])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.2])
def test_a_fine_thermometer_has_no_steps_where_the_chamber_stays_at_whole_degrees(noise, mean):
    assert steps_of(shown(TRUE, 0.0, noise, mean)).size == 0.0


def test_noise_that_rounds_the_steps_off_leaves_none():
    """0.2 K before steps of 0.5 K: a mean reading is off by hundredths of a step."""
    found = steps_of(shown(TRUE, 0.5, 0.2))
    assert np.sqrt(np.sum(sawtooth(found.size, found.noise))) < 0.03
    assert steps_of(shown(TRUE, 0.5, 0.2, 10)).size < 0.1


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2, 0.5])
def test_mean_and_flicker_of_readings_are_those_of_many_draws(noise):
    at = np.linspace(20, 21, 401)[:-1]
    drawn = np.round(at[:, None] + noise * np.random.default_rng(1).normal(size=(len(at), 4000)))
    away = np.mean(drawn, axis=1) - at
    assert np.sqrt(np.sum(sawtooth(1.0, noise))) == pytest.approx(np.sqrt(np.mean(away**2)), abs=0.01)
    assert noise_before(1.0, float(np.mean(np.var(drawn, axis=1)))) == pytest.approx(noise, abs=0.01)


def test_the_step_of_single_readings_is_what_all_changes_are_multiples_of():
    for T, expected in (
        (shown(TRUE, 0.1, 0.02), 0.1),
        (shown(TRUE, 0.0625, 0.2).astype(np.float32).astype(float), 0.0625),
        (np.array([20, 20, 21, 21.0]), 1.0),  # as far as one can tell
        (np.array([20, 22, 25, 27, 30, 32, 34.0]), 1.0),  # no two next to one another: as Euclid has it
        (np.array([20, 20, 45, 45.0]), 0.0),  # a jump is no step
        (np.full(50, 20.0), 0.0),
        (shown(TRUE, 0.0, 0.02), 0.0),
    ):
        assert readings(T, started()).step[-1] == pytest.approx(expected, abs=1e-3)


@given(st.lists(st.integers(0, 3000), max_size=8), st.sampled_from([1.0, 0.1, 0.0]), st.sampled_from([0.0, 0.02]))
@settings(max_examples=30)
def test_any_split_shows_the_same_to_the_last_bit(cuts, step, noise):
    T = shown(TRUE[:3000], step, noise)
    whole, memory = readings(T, started()), started()
    parts = [readings(T[a:b], memory) for a, b in pairwise(sorted({0, 3000, *cuts}))]
    for k in range(2):
        np.testing.assert_array_equal(np.concatenate([part[k] for part in parts]), whole[k])


def test_the_short_ramps_of_a_long_staircase_are_no_steps():
    """Steps of 5 K in two minutes and a half, held for two hours and a half: readings to a hundredth of a kelvin."""
    hold, ramp = np.zeros(4500), np.linspace(0, 5, 75, endpoint=False)
    up = np.concatenate([[*(hold + level), *(ramp + level)] for level in np.arange(-20.0, 50.0, 5.0)])
    T = np.concatenate([up, up[::-1]]) + 0.137
    assert steps_of(shown(T, 0.01, 0.02)).size == 0.0
    assert steps_of(shown(T, 1.0, 0.02)).size == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("height", [1.0, 2.0, 3.0, 4.0, 5.0, 10.0])
@pytest.mark.parametrize(("noise", "resolution"), [(0.02, 0.01), (0.1, 0.0), (0.005, 0.001)])
def test_set_points_of_a_chamber_are_no_steps_of_its_thermometer(height, noise, resolution):
    """Long holds at places that are alike, with short ramps between them: readings do not jump, and do not flicker."""
    rng = np.random.default_rng(int(height))
    levels = np.arange(-20, 50, height) + 0.137
    n = int(height / 5 * 30)
    T = np.concatenate([np.r_[np.full(1800, a), np.linspace(a, b, n, endpoint=False)] for a, b in pairwise(levels)])
    T = T + noise * rng.normal(size=len(T))
    assert steps_of(np.round(T / resolution) * resolution if resolution else T).size <= 5 * resolution
