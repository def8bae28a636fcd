"""A loop, and a dip, within a kelvin: each is seen, or nothing is said of it."""

import numpy as np
import pytest

from driftlab.maps.hysteresis.memory import memory_of
from driftlab.soak.blocks import brief
from fusion_core.thermal.ripple import ripple_modes, ripples

N = 21_600  # s
HERE = 23.0  # degC


def soak(seed, passes):
    """Return a temperature that goes up and down so many times, and white noise with a walk."""
    rng = np.random.default_rng(seed)
    T = 20 + 40 * np.sin(2 * np.pi * passes * np.arange(N) / N - np.pi / 2) + 0.02 * rng.normal(size=N)
    return T, rng.normal(size=(N, 3)) + np.cumsum(0.01 * rng.normal(size=(N, 3)), axis=0) + 0.5 * T[:, None]


@pytest.mark.parametrize("passes", [1, 3])
@pytest.mark.parametrize("width", [0.5, 1.0])
def test_a_loop_that_is_narrower_than_a_block_is_not_denied(passes, width):
    T, bias = soak(1, passes)
    cooling = np.gradient(20 + 40 * np.sin(2 * np.pi * passes * np.arange(N) / N - np.pi / 2)) < 0
    bias[:, 0] += 20 * cooling * np.exp(-(((T - HERE) / width) ** 2) / 2)
    found = memory_of(brief(T, bias, [0], 1.0))
    assert found.answer in ("seen", "undecided")
    if found.answer == "undecided":
        assert f"near {HERE:.2g}" in found.why or f"near {HERE - 1:.2g}" in found.why
        assert "on axis x" in found.why
        assert np.all(np.isinf(found.none_larger_than)), "no limit is passed by it"


def test_no_loop_is_none_and_the_width_that_was_looked_for_is_said():
    for seed in range(4):
        found = memory_of(brief(*soak(seed, 3), [0], 1.0))
        assert found.answer == "none"
        assert found.over == pytest.approx(80 * 9 / 120, rel=0.01)


def test_a_dip_is_a_misfit_where_it_is_as_deep_as_beside_it():
    T, bias = soak(5, 1)
    left = bias - 0.5 * T[:, None]
    left[:, 1] -= 5 * np.exp(-(((T - HERE) / 0.4) ** 2) / 2)
    no, dip, none = ripples(T, left, 2.0)
    assert no is none is None
    assert dip.dip
    assert pytest.approx(HERE, abs=0.5) == dip.T
    assert 1 < dip.rms < 5
    grid = np.linspace(-20, 60, 121)
    (mode,) = ripple_modes(dip, grid).T
    assert abs(grid[np.argmax(mode)] - HERE) < 1
    assert np.max(mode[np.abs(grid - HERE) > 5]) < 0.01 * dip.rms, "elsewhere the map is as good as before"
