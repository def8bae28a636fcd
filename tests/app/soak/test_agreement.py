"""Recordings of one unit that contradict one another, and those that do not."""

import numpy as np
import pytest

from driftlab.soak.agreement import contradictions

N = 6000
AXES = ("x", "y", "z")


def soak(seed, low=-10.0, high=50.0):
    rng = np.random.default_rng(seed)
    T = low + (high - low) * (1 - np.abs(np.linspace(-1, 1, N)))
    u = (T - 20) / 30
    bias = 60 * np.stack([u, u**2 - u, np.sin(3 * u)], axis=1) + rng.normal(size=3) * 100
    lag = np.where(np.arange(N) < N / 2, 4.0, -4.0)[:, None]
    return T, bias + lag + np.cumsum(0.05 * rng.normal(size=(N, 3)), axis=0) + 10 * rng.normal(size=(N, 3))


def found(*soaks):
    names = [f"{k}.h5" for k in range(len(soaks))]
    return contradictions([T for T, _ in soaks], [bias for _, bias in soaks], names, "gyro", AXES)


def test_recordings_of_a_unit_with_hysteresis_walk_and_other_levels_agree():
    assert found(soak(0)) == []
    assert found(soak(0), soak(1)) == []
    assert found(soak(0), soak(1, 10.0, 30.0), soak(2, -10.0, 60.0)) == []
    assert found(soak(0), soak(1, 70.0, 90.0)) == []  # no temperature in common


@pytest.mark.parametrize(("axis", "factor"), [("x", -1.0), ("y", 1e-3), ("z", 57.3)])
@pytest.mark.parametrize("more", [0, 2])
def test_an_axis_that_is_negated_or_in_another_unit_is_named(axis, factor, more):
    T, bias = soak(9)
    bias[:, AXES.index(axis)] *= factor
    (text,) = found(*(soak(k) for k in range(1 + more)), (T, bias))
    assert text.startswith(f"{1 + more}.h5: gyro {axis} goes with that of the other recordings by a factor of ")
    assert float(text.split("factor of ")[1].split(";")[0]) == pytest.approx(factor, rel=0.1)


@pytest.mark.parametrize("more", [0, 2])
def test_exchanged_axes_are_named(more):
    T, bias = soak(9)
    (text,) = found(*(soak(k) for k in range(1 + more)), (T, bias[:, [1, 0, 2]]))
    assert text.startswith(f"{1 + more}.h5: gyro x and gyro y are exchanged")
