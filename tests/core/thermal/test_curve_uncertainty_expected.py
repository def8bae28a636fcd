"""The error of a map that is foretold, against the same sum over single samples, and against fits."""

import numpy as np
import pytest

from fusion_core.contracts import ThermalMap
from fusion_core.thermal.curve_uncertainty import expected_curve_error, expected_misfit
from fusion_core.thermal.soak_noise import blocks_of, walk_root
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

DEG_H = np.deg2rad(1) / 3600
NOISE, WALK = np.full(3, 3.18 * DEG_H), np.full(3, 0.08 * DEG_H)
GRID = np.linspace(10.5, 44.5, 60)


def triangle(N, cycles, low=10.0, high=45.0):
    """Return T (N,) of ramps that go up and down."""
    phase = np.arange(N) / N * cycles % 1
    return low + (high - low) * (1 - np.abs(2 * phase - 1))


def curve(T):
    return DEG_H * (60 * np.tanh((T - 27) / 12) + 0.02 * (T - 20) ** 2)[:, None] * np.array([1.0, -0.5, 0.7])


def measured(T, dt, seed, walk=WALK, noise=NOISE):
    white, steps = np.random.default_rng(seed).normal(size=(2, len(T), 3))
    return curve(T) + np.cumsum(steps * walk * np.sqrt(dt), axis=0) + white * noise / np.sqrt(dt)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


@pytest.mark.parametrize("cycles", [0.5, 1, 3, 12])
def test_a_walk_over_blocks_has_the_covariance_of_its_samples(cycles):
    """Of samples that were measured in turn too: W min(t, t') W', with W the means over the blocks."""
    N = 3000
    blocks = blocks_of(triangle(N, cycles), np.zeros((N, 1)))
    W = np.zeros((len(blocks.T), N))
    W[blocks.of_sample, np.arange(N)] = 1 / blocks.n[blocks.of_sample]
    t = (np.arange(N) + 0.5) / N
    exact = W @ np.minimum(t[:, None], t) @ W.T
    root = walk_root(blocks)
    np.testing.assert_allclose(root @ root.T, exact, atol=2e-3 * exact.max())


@pytest.mark.parametrize("cycles", [0.5, 1, 4])
@pytest.mark.parametrize("walk", [0.0, 1.0])
def test_least_squares_have_the_sigma_that_single_samples_give(cycles, walk):
    """A (noise^2/dt I + walk^2 dt min(k, k')) A' of the curve less its mean over the soak, A by numpy alone."""
    N, dt, order = 2400, 5.0, 4
    T = triangle(N, cycles)
    x = (T - 27) / 18
    A = np.linalg.pinv(np.vander(x, order + 1))
    centred = np.vander((GRID - 27) / 18, order + 1) @ A - np.mean(np.vander(x, order + 1) @ A, axis=0)
    k = np.arange(1, N + 1)
    S = NOISE[0] ** 2 / dt * np.eye(N) + (walk * WALK[0]) ** 2 * dt * np.minimum(k[:, None], k)
    exact = np.sqrt(np.einsum("gk,kl,gl->g", centred, S, centred))
    smoother = Polynomial(order=order).smoother(T, np.zeros((N, 3)))
    found = expected_curve_error(T, dt, NOISE, walk * WALK, smoother)
    np.testing.assert_allclose(np.sqrt(found.variance(GRID)[:, 0]), exact, rtol=0.05)


def test_what_a_kind_cannot_follow_is_what_it_leaves():
    """It is the misfit without noise, which numpy.polyfit has as well."""
    T = triangle(4000, 1)
    y = curve(T)[:, 0]
    p = np.polyfit(T - 27, y, 3)
    left = np.polyval(p, GRID - 27) - curve(GRID)[:, 0] - np.mean(np.polyval(p, T - 27) - y)
    smoother = Polynomial(order=3).smoother(T, curve(T))
    found = expected_misfit(T, smoother, curve, 3)
    np.testing.assert_allclose(np.sqrt(found.variance(GRID)[:, 0]), np.abs(left), atol=0.01 * rms(left))


class Anyone(Spline):
    """A kind that says nothing of how it answers to noise, but for its basis."""

    def smoother(self, T, bias):
        return ThermalMap.smoother(self, T, bias)


@pytest.mark.parametrize("maps", [Polynomial(order=7), Spline(), Anyone()], ids=["polynomial", "spline", "any other"])
@pytest.mark.parametrize("cycles", [0.5, 3])
def test_what_is_foretold_is_what_fits_are_off_by_and_say(maps, cycles):
    N, dt = 3600, 4.0
    T, seeds = triangle(N, cycles), 10
    off, said, expected = [], [], []
    for seed in range(seeds):
        fitted = maps.fit(T, measured(T, dt, seed), {})
        error = fitted.bias(GRID) - curve(GRID) - np.mean(fitted.bias(T) - curve(T), axis=0)
        off.append(error)
        said.append(rms(fitted.sigma(GRID)))
    for seed in range(3):
        smoother = maps.smoother(T, measured(T, dt, 100 + seed))
        misfit = expected_misfit(T, smoother, curve, 3).variance(GRID)
        expected.append(expected_curve_error(T, dt, NOISE, WALK, smoother).variance(GRID) + misfit)
    foretold = np.sqrt(np.mean(expected))
    assert rms(off) == pytest.approx(foretold, rel=0.3)  # 30 axes of few degrees of freedom each
    assert np.median(said) == pytest.approx(foretold, rel=0.15)
