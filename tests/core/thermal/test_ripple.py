"""A ripple over temperature that is narrower than a curve can follow."""

import numpy as np
import pytest

from fusion_core.thermal.ripple import ripple_modes, ripples

N, WIDTH = 14_400, 2.0  # samples, of white noise of 1; K


def up_and_down(rng):
    """Return a temperature, noise and all, that goes 80 K up and back."""
    return np.interp(np.arange(N) / N, [0, 0.03, 0.5, 0.97, 1], [-20, -20, 60, -20, -20]) + 0.02 * rng.normal(size=N)


SHAPES = {
    "steps of a converter": lambda T: 0.8 * np.sign(np.sin(2 * np.pi * T / 0.5)),
    "a wave": lambda T: np.sqrt(1.28) * np.sin(2 * np.pi * T / 0.9),
    "sawteeth": lambda T: 0.8 * np.sqrt(12) * (T / 0.6 % 1 - 0.5),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_what_repeats_from_way_to_way_is_found_with_its_size(shape):
    rng = np.random.default_rng(1)
    T = up_and_down(rng)
    left = rng.normal(size=(N, 2))
    left[:, 1] += shape(T)  # of an rms of 0.8
    alone, with_it = ripples(T, left, WIDTH)
    assert alone is None
    assert with_it.rms == pytest.approx(0.8, rel=0.35)
    assert with_it.chance < with_it.rms / 2


def test_noise_walks_loops_and_coarse_thermometers_have_none():
    false = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        T = up_and_down(rng)
        loop = np.where(np.arange(N) < N / 2, 1.0, -1.0) * np.sin(T / 20)
        left = np.stack([rng.normal(size=N), np.cumsum(0.03 * rng.normal(size=N)), loop + rng.normal(size=N)], axis=1)
        false += sum(ripple is not None for ripple in ripples(np.rint(T * 2) / 2 if seed % 2 else T, left, WIDTH))
    assert false <= 1  # of 180, each by a chance of 1e-3


def test_rare_samples_that_meet_at_the_same_temperatures_have_none():
    """One each minute, three times up and down: a cell may have samples of one pass alone, and between two passes a
    bias walks."""
    false, rows = 0, np.arange(1440)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        T = -10 + 60 * np.abs((rows / 240 + 1) % 2 - 1) + 0.005 * rng.normal(size=len(rows))
        left = rng.normal(size=(len(rows), 3)) / 4 + np.cumsum(0.15 * rng.normal(size=(len(rows), 3)), axis=0)
        false += sum(ripple is not None for ripple in ripples(T, left, WIDTH))
    assert false <= 1  # of 120


def test_one_way_alone_cannot_tell():
    rng = np.random.default_rng(2)
    T = np.linspace(-20, 60, N)
    assert ripples(T, 3 * np.sin(2 * np.pi * T / 0.9)[:, None] + rng.normal(size=(N, 1)), WIDTH) == [None]


def test_its_modes_have_its_variance_everywhere():
    """Also between points of the grid, where modes go straight: less by a sixth at most, on average a tenth."""
    rng = np.random.default_rng(3)
    T = up_and_down(rng)
    (found,) = ripples(T, (SHAPES["a wave"](T) + rng.normal(size=N))[:, None], WIDTH)
    grid = np.linspace(-20, 60, 121)
    at = np.linspace(-20, 60, 5000)
    modes = ripple_modes(found, grid)
    variance = sum(np.interp(at, grid, mode) ** 2 for mode in modes.T)
    assert np.all((variance > found.rms**2 * 0.83) & (variance <= found.rms**2 * (1 + 1e-9)))


def test_a_walk_where_the_temperature_is_slow_is_no_dip():
    """Both ways pass ten kelvin three times as slowly, and a bias walks there for three times as long."""
    false = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        up = np.cumsum(np.where(np.abs(np.linspace(-20, 60, N // 2) - 20) < 5, 1.0, 3.0))
        T = -20 + 80 * np.concatenate([up, up[::-1]]) / up[-1] + 0.02 * rng.normal(size=N)
        left = np.cumsum(rng.normal(size=(N, 3)), axis=0) / 3 + rng.normal(size=(N, 3))
        false += sum(ripple is not None for ripple in ripples(T, left, WIDTH))
    assert false <= 1


def test_noise_that_grows_with_temperature_is_no_dip_and_hides_none_elsewhere():
    false = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        T = up_and_down(rng)
        left = rng.normal(size=(N, 3)) * np.where(T < -5, 8.0, 1.0)[:, None]
        left[:, 1] -= 5.0 * np.exp(-(((T - 31.2) / 0.25) ** 2) / 2)
        without, dip, other = ripples(T, left, WIDTH)
        false += (without is not None) + (other is not None)
        assert dip is not None
        assert dip.dip
        assert abs(dip.T - 31.2) < 0.5
    assert false <= 1  # of 40
