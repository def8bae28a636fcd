"""A curve of a soak in stairs is the mean of warming and cooling, where they differ; else nothing is done."""

import numpy as np
import pytest

from driftlab.config import Config
from driftlab.maps.fit import GatheredSoak, fit_gathered
from fusion_plugins.thermal_maps.spline import Spline

DEG_H = np.deg2rad(1) / 3600
DT = 5.0


def play(T, reach):
    """Return the play operator of half width `reach` on a path, the elementary hysteresis of Prandtl and Ishlinskii."""
    y = np.empty_like(T)
    y[0] = T[0] + reach
    for k in range(1, len(T)):
        y[k] = min(max(y[k - 1], T[k] - reach), T[k] + reach)
    return y


def stairs(step=10.0, hold=2400.0, lag=300.0):
    """Return a body's temperature in a chamber that goes up and down in steps of 10 K."""
    up = np.arange(-10.0, 51.0, step)
    air = np.repeat(np.concatenate([up, up[-2::-1]]), int(hold / DT))
    T = np.empty_like(air)
    T[0] = air[0]
    for k in range(1, len(T)):
        T[k] = T[k - 1] + (air[k] - T[k - 1]) * DT / lag
    return T


def soak(loop, seed=0):
    """Return a soak of a smooth curve with a loop of so many deg/h, and the mean of warming and cooling (N, 3)."""
    T, rng = stairs(), np.random.default_rng(seed)
    curve = np.stack([40 * np.sin(T / 25), 30 * np.exp(-T / 40), 1.5 * T], axis=1)
    remembered = np.outer(play(T, 4.0) - T, [loop / 8.0, -loop / 16.0, 0.0])
    bias = curve + remembered + rng.normal(size=curve.shape) * 4.0 / np.sqrt(DT)
    bias += np.cumsum(rng.normal(size=curve.shape), axis=0) * 0.005 * np.sqrt(DT)
    top, grid = int(np.argmax(T)), np.linspace(-5.0, 45.0, 101)
    whole = curve + remembered
    up = np.stack([np.interp(grid, T[:top], column[:top]) for column in whole.T], axis=1)
    down = np.stack([np.interp(-grid, -T[top:], column[top:]) for column in whole.T], axis=1)
    return GatheredSoak(np.arange(len(T)) * DT, T, bias * DEG_H, ["s"], [0], DT), grid, (up + down) / 2


def off(fitted, grid, truth):
    """Return the errors (G, 3) of a map less their mean, in deg/h."""
    error = fitted.bias(grid) / DEG_H - truth
    return error - error.mean(axis=0)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_curve_is_the_mean_of_warming_and_cooling(seed):
    samples, grid, truth = soak(60.0, seed)
    assert samples.memory.answer == "seen"
    plain, both = (fit_gathered(Config(), Spline(), samples, of_both_ways=both) for both in (False, True))
    before, after = (np.sqrt(np.mean(off(fitted, grid, truth)[:, 0] ** 2)) for fitted in (plain, both))
    assert before > 8.0  # it follows the way that stays there longer
    assert after < 1.0
    error, sigma = off(both, grid, truth), both.sigma(grid) / DEG_H
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 2.0
    assert np.all(np.abs(error[:, 2]) < 4.0)  # an axis without it


def test_samples_without_a_memory_are_left_as_they_are():
    samples, *_ = soak(0.0)
    assert samples.memory.answer != "seen"
    plain, both = (fit_gathered(Config(), Spline(), samples, of_both_ways=both) for both in (False, True))
    T = np.linspace(*plain.domain, 50)
    np.testing.assert_array_equal(plain.bias(T), both.bias(T))


def test_levels_of_recordings_are_no_difference_of_the_ways():
    """Of two soaks the second is higher by 100 deg/h and goes down alone: the curve is that of one level."""
    first, *_ = soak(60.0)
    down = slice(int(np.argmax(first.T)), None)
    T = np.concatenate([first.T, first.T[down]])
    bias = np.concatenate([first.bias, first.bias[down] + 100 * DEG_H])
    both = GatheredSoak(np.arange(len(T)) * DT, T, bias, ["a", "b"], [0, len(first.T)], DT)
    way = np.repeat(both.summary.way, np.round(both.summary.span / DT).astype(int))
    taken = (both.bias - both.of_both_ways) / DEG_H * np.where(way == 0, np.nan, way)[:, None]
    inner = (T > 0) & (T < 40)
    np.testing.assert_allclose(np.abs(taken[inner, 0]), 30.0, atol=6.0)  # half of the loop, and of no level
    assert np.all(taken[inner, 2] == 0)
