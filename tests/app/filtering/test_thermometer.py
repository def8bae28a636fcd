"""A coarse thermometer's effect on a bias that follows a map, against what is said of it."""

from itertools import pairwise

import numpy as np
import pytest
from foreign_soaks import behind
from hypothesis import given, settings
from hypothesis import strategies as st
from readings_at_rest import DEG_H, errors

from driftlab.filtering.coasting import _deviations
from driftlab.filtering.thermometer import ReadingError, ThermometerError
from fusion_core.chunk import Chunk
from fusion_core.thermal.rate_estimators import Regression, with_rate
from fusion_core.thermal.thermometer import NO_STEPS, Steps, sawtooth

# readings


def conditioned(T, q=0.0, dt=1.0):
    t = np.arange(1, len(T) + 1) * dt
    chunk = Chunk(t, {"temperature": T}, Chunk(t[:1] - dt, {"temperature": T[:1]}))
    return with_rate(chunk, Regression(), None, (q, q * q / 12), (0.0, 1e3))[0]


@pytest.mark.parametrize(
    ("q", "noise", "rate"),
    [(1.0, 0, 1 / 60), (1.0, 0.2, 1 / 60), (1.0, 0, 1 / 1800), (0.5, 0.02, 1 / 60), (0.1, 0.0, 1 / 600)],
)
def test_what_smoothing_leaves_of_steps_and_noise(q, noise, rate):
    """On a ramp a reading is off by up to half a step, the smooth temperature by what the average leaves of it."""
    true = 20 + np.arange(28_800) * rate
    raw = np.round((true + noise * np.random.default_rng(0).normal(size=len(true))) / q) * q
    chunk = conditioned(raw, q)
    error = ThermometerError(NO_STEPS, 60.0).look(chunk)
    later = slice(int(3 * q / rate) + 600, None)
    expected = np.var((chunk["temperature"] - true)[later])
    assert np.mean(np.sum(error.variance[later], axis=1)) == pytest.approx(expected, rel=0.3)


def test_steps_that_are_known_beforehand_count_from_the_first_reading():
    error = ThermometerError(Steps(1.0, 0.0), 60.0).look(conditioned(np.full(600, 25.0)))
    np.testing.assert_allclose(error.variance[:, 0], 1 / 12, rtol=0.02)
    assert 0.1 < np.prod(error.left[:, 0]) < 0.9  # it may stand, and so may what it is off by


def test_a_noisy_thermometer_is_as_good_as_its_smoothing():
    """White noise of 0.1 K: what is left at the end of a straight line through exponential weights (Brown)."""
    rng = np.random.default_rng(0)
    chunk = conditioned(25 + 0.1 * rng.normal(size=7200))
    error = ThermometerError(NO_STEPS, 60.0).look(chunk)
    assert np.sum(error.variance[3600:]) / 3600 == pytest.approx(np.var(chunk["temperature"][3600:]), rel=0.2)


def test_a_perfect_thermometer_has_no_error_and_no_lag():
    T = 20 + 5 * np.sin(np.arange(3600) / 200.0)
    chunk = conditioned(T)
    assert np.max(ThermometerError(NO_STEPS, 60.0).look(chunk).variance[60:]) < 0.005**2
    assert np.max(np.abs(chunk["temperature"] - T)[60:]) < 0.01


@given(st.lists(st.integers(0, 2000), max_size=8), st.sampled_from([1.0, 0.1]), st.sampled_from([0.0, 0.02]))
@settings(max_examples=30)
def test_any_split_gives_the_same_thermometer_to_the_last_bit(cuts, q, noise):
    rng = np.random.default_rng(1)
    true = 20 + 5 * np.sin(np.arange(2000) / 300)
    chunk = conditioned(np.round((true + noise * rng.normal(size=2000)) / q) * q)
    whole, split = ThermometerError(NO_STEPS, 60.0), ThermometerError(NO_STEPS, 60.0)
    one = whole.look(chunk)
    parts = [split.look(chunk.part(a, b)) for a, b in pairwise(sorted({0, 2000, *cuts}))]
    for k in range(2):
        np.testing.assert_array_equal(np.concatenate([part[k] for part in parts]), one[k])
    for a, b in zip(split.snapshot(), whole.snapshot(), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("still", [False, True])
def test_an_error_turns_within_a_step_where_the_temperature_goes_on(still):
    """On a ramp the error has the other sign half a step later; in a chamber that stays it is as it was."""
    seconds = np.arange(1200)
    true = 20.2 + np.minimum(seconds, 650 if still else 1200) / 100
    error = ThermometerError(NO_STEPS, 60.0).look(conditioned(np.round(true), 1.0))
    rho = error.left[:, 0] + 1j * error.left[:, 2]
    half = np.prod(rho[900:950])
    assert (0.8 < half.real < 1.0 and half.imag == 0) if still else (-0.6 < half.real < -0.4)


# what a filter makes of them


def test_the_part_in_an_estimate_is_that_of_all_errors_together():
    """Against the covariance of all errors at once; and it does not grow, however long the run."""
    rng = np.random.default_rng(0)
    N = 60
    kept, angle = rng.uniform(0.5, 1, (N, 2)), rng.uniform(-0.5, 0.5, N)  # of which the sawtooth turns
    left = np.column_stack([kept[:, 0] * np.cos(angle), kept[:, 1], kept[:, 0] * np.sin(angle)])
    error = ReadingError(rng.uniform(0, 2, (N, 2)), left)
    slope, gain = rng.normal(size=(N, 1)), rng.uniform(0, 0.3, (N, 1))
    gain[0] = 1.0
    at, sigma, one = np.arange(N, dtype=float), np.empty((N, 1)), np.ones(1)
    small = 1e-15  # the variance of the states, beside the thermometer's
    variances = small * gain, small * gain, np.full(N, 1 / small), one, 0 * one, 0 * one
    tables = 0.0, 1.0, slope, np.zeros((N, 0, 1)), np.zeros((N, 1))
    memory = np.zeros((3, 2, 1)), np.zeros((3, 2, 1)), np.array([[np.nan], [0.0], [0.0]])
    _deviations(at, *error, *variances, *tables, *memory, sigma, np.empty((N, 1)))
    found = sigma[:, 0] ** 2
    expected = np.zeros(N)
    filtered = np.zeros((N, N))  # what is left of the errors up to each epoch
    learnt = np.zeros(N)
    for k in range(N):
        learnt = (1 - gain[k]) * learnt
        learnt[k] += gain[k, 0]
        filtered[k] = -learnt
        filtered[k, k] += 1
    for i in range(2):
        steps = np.concatenate([[0], np.cumsum(np.log(kept[1:, i]))])
        turns = np.concatenate([[0], np.cumsum(angle[1:])]) * (i == 0)
        root = slope[:, 0] * np.sqrt(error.variance[:, i])
        covariance = np.outer(root, root) * np.exp(-np.abs(steps[:, None] - steps)) * np.cos(turns[:, None] - turns)
        expected += np.diag(filtered @ covariance @ filtered.T)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=2 * small)


@pytest.mark.parametrize(("step", "noise", "interval"), [(0.5, 0.02, 1.0), (1.0, 0.0, 1.0), (1.0, 0.2, 1.0)])
def test_the_bands_hold_under_a_coarse_thermometer(step, noise, interval):
    """Ten readings a second of a steep unit: errors over sigma of 24 axes, running and coasting."""
    for z in np.concatenate([errors(seed, step, noise, interval) for seed in range(8)], axis=1):
        assert np.mean(np.abs(z) < 1) > 0.45
        assert np.mean(np.abs(z) < 1.96) > 0.85
        assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4


def test_a_long_update_does_not_lag_behind():
    """Its means are of its middle, and its estimate is of its end: 10 s at 1 K/min are 0.08 K."""
    running, _ = errors(0, 0.0, 0.0, 10.0, sizes=True)
    assert np.sqrt(np.mean(running**2)) < 0.04 * DEG_H


@pytest.mark.parametrize(("q", "noise"), [(0.5, 0.2), (0.0, 0.2), (0.5, 0.02)])
def test_the_lag_where_the_rate_changes_is_a_part_of_the_error(q, noise):
    """A chamber of 2 K/min that turns each half hour: deviations are those of the error, whatever it is made of."""
    t = np.arange(14_400.0)
    true = behind(25 + 15 * np.interp(t % 3600, [0, 900, 1800, 2700, 3600], [0, 1, 1, 0, 0]), 150.0, 1.0)
    rng = np.random.default_rng(1)
    raw = true + 0.3 * noise * rng.normal(size=len(t))
    if q:
        raw = np.mean([np.round((true + noise * rng.normal(size=len(t))) / q) * q for _ in range(10)], axis=0)
    steps = Steps(q, noise) if q else NO_STEPS
    chunk = Chunk(t, {"temperature": raw}, Chunk(t[:1] - 1, {"temperature": raw[:1]}))
    chunk, _ = with_rate(chunk, Regression(), None, (q, float(np.sum(sawtooth(*steps)))), (0.0, 1e3))
    error = ThermometerError(steps, 60.0).look(chunk)
    z = (chunk["temperature"] - true)[600:] / np.sqrt(np.sum(error.variance, axis=1)[600:])
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.15
    assert np.mean(np.abs(z) < 3) > 0.99
