"""Joint fits of several recordings: generalised least squares by a dense solution, and errors within sigma."""

import numpy as np
import pytest

from driftlab.soak.wander import WanderDesign, WanderNoise, fitted_jointly, wander_of
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

DT = 20.0
WHITE, WALK = 3.2, 0.03  # deg/h/sqrt(Hz), deg/h/sqrt(s)


def body(hours, temperatures, lag=300.0):
    """Return the temperature of a body behind a chamber that goes straight from one to the next."""
    t = np.arange(0.0, 3600 * hours[-1], DT)
    air = np.interp(t, 3600 * np.asarray(hours), temperatures)
    T = np.empty_like(air)
    T[0] = air[0]
    for k in range(1, len(T)):
        T[k] = T[k - 1] + (air[k] - T[k - 1]) * DT / lag
    return T


def ramps(hours=4.0, low=-20.0, high=50.0):
    return body(np.linspace(0, hours, 5), [low, high, low, high, low])


def stairs(hours=14.0):
    begins = np.linspace(0, hours, 16)[:-1]
    ends = begins + hours / 15 - 0.05
    return body(np.stack([begins, ends], axis=1).ravel(), np.repeat(np.linspace(-20, 50, 15), 2))


def curve(T):
    x = (T - 15) / 35
    return np.stack([20 * x + 10 * x**2, 25 * x**3 - 15 * x, 30 * x], axis=1)


def drawn(profiles, seed, turn_on=5.0):
    """Return the bias (N, 3) of recordings with walk, white noise and a level of their own, in deg/h."""
    rng, parts = np.random.default_rng(seed), []
    for T in profiles:
        steps, white = rng.normal(size=(2, len(T), 3))
        walk = np.cumsum(steps, axis=0) * WALK * np.sqrt(DT)
        parts.append(curve(T) + walk + white * WHITE / np.sqrt(DT) + rng.normal(size=3) * turn_on)
    return np.concatenate(parts)


def fitted(settings, profiles, bias, *, jointly=True):
    T, starts = np.concatenate(profiles), np.cumsum([0, *map(len, profiles)])[:-1].tolist()
    return fitted_jointly(settings, T, bias, {}, wander_of(T, bias, starts) if jointly else None)


def errors(found, profiles):
    """Return the rms error (d,) of a map less its mean over the samples, and its own sigma (d,)."""
    T, grid = np.concatenate(profiles), np.linspace(*found.domain, 100)
    error = found.bias(grid) - curve(grid) - np.mean(found.bias(T) - curve(T), axis=0)
    return np.sqrt(np.mean(error**2, axis=0)), np.sqrt(np.mean(found.sigma(grid) ** 2, axis=0))


def test_least_squares_on_what_is_left_are_generalised_least_squares():
    """The curve of least squares on the means less their wander is that of a dense solution with their covariance."""
    profiles = [ramps(2.0), stairs(6.0)]
    T = np.concatenate(profiles)
    design = WanderDesign(T, drawn(profiles, 0), [0, len(profiles[0])])
    noise = WanderNoise(walk=40.0, white=0.3, bends=0.0, levels=25.0, shapes=2.0)
    A, y, n = design.means, design.blocks.y[:, 0], design.blocks.n
    _, levels, shapes = design.kinds
    white = np.diag(0.3 * np.mean(n) / n)
    V = A @ (40.0 * design.contrasts.covariance + 25.0 * levels + 2.0 * shapes + white) @ A.T
    X = A @ design.line
    dense = np.linalg.solve(X.T @ np.linalg.solve(V, X), X.T @ np.linalg.solve(V, A @ y))
    taken, root = design.left(noise)
    W = np.linalg.inv(A @ white @ A.T)
    line = np.linalg.solve(X.T @ W @ X, X.T @ W @ A @ (y - taken @ y))
    assert line[1] == pytest.approx(dense[1], rel=1e-6)
    slope = np.linalg.solve(X.T @ W @ X, X.T @ W @ A)[1]
    variance = np.linalg.inv(X.T @ np.linalg.solve(V, X))[1, 1]
    assert np.sum((slope @ root) ** 2) == pytest.approx(variance, rel=1e-3)
    own = np.abs(np.linalg.lstsq(np.sqrt(n)[:, None] * design.line, np.sqrt(n) * y)[0][1] - dense[1])
    assert own > 10 * np.abs(line[1] - dense[1])  # least squares on the samples are something else


def test_stairs_beside_ramps_do_not_make_the_curve_worse():
    alone, both, plain, sure = [], [], [], []
    for seed in range(5):
        profiles = [ramps(), stairs()]
        bias, n = drawn(profiles, seed), len(profiles[0])
        alone.append(errors(fitted(Spline(), profiles[:1], bias[:n], jointly=False), profiles[:1])[0])
        plain.append(errors(fitted(Spline(), profiles, bias, jointly=False), profiles)[0])
        error, sigma = errors(fitted(Spline(), profiles, bias), profiles)
        both.append(error)
        sure.append(error / sigma)
    alone, both, plain, z = (np.sqrt(np.mean(np.square(values))) for values in (alone, both, plain, sure))
    assert both < alone
    assert plain > 2 * alone  # by the number of samples the stairs outweigh the ramps
    assert 0.6 < z < 1.4


def test_the_level_of_a_recording_is_no_part_of_the_curve():
    profiles = [ramps(high=20.0), ramps(low=10.0)]
    z = []
    for seed in range(4):
        bias = drawn(profiles, seed, turn_on=30.0)
        error, sigma = errors(fitted(Polynomial(order=3), profiles, bias), profiles)
        z.append(error / sigma)
        assert np.all(error < 3.0)
    assert np.sqrt(np.mean(np.square(z))) < 1.6


def test_white_noise_alone_is_weighed_by_the_number_of_samples():
    profiles, rng = [ramps(), ramps(6.0)], np.random.default_rng(1)
    T = np.concatenate(profiles)
    bias = curve(T) + rng.normal(size=(len(T), 3))
    joint, plain = (fitted(Polynomial(order=3), profiles, bias, jointly=jointly) for jointly in (True, False))
    grid = np.linspace(-19, 46, 50)
    assert np.all(np.abs(joint.bias(grid) - plain.bias(grid)) < 2 * plain.sigma(grid))


def test_an_axis_without_noise_is_fitted_as_it_is():
    profiles = [ramps(), stairs()]
    bias = drawn(profiles, 0)
    bias[:, 1] = 0.0
    found = fitted(Polynomial(order=3), profiles, bias)
    grid = np.linspace(-19, 46, 50)
    np.testing.assert_allclose(found.bias(grid)[:, 1], 0.0, atol=1e-9)
    assert np.all(found.sigma(grid)[:, 1] < 1e-6)


def test_recordings_too_short_are_fitted_together_as_they_are():
    T = np.linspace(0.0, 10.0, 24)
    assert wander_of(T, np.random.default_rng(0).normal(size=(24, 1)), [0, 12]) is None


def test_soaks_at_two_temperatures_alone_are_left_to_the_kind_of_map():
    T = np.repeat([10.0, 40.0], 600) + np.random.default_rng(0).normal(size=1200) * 1e-3
    assert wander_of(T, np.random.default_rng(1).normal(size=(1200, 1)), [0, 600]) is None


def test_the_variances_are_those_of_the_largest_likelihood():
    """Of twice and half of each, by determinants written out, none is likelier by more than the search resolves."""
    for seed in range(4):
        profiles = [ramps(2.0) + 0.3 * k for k in range(6)]
        T, starts = np.concatenate(profiles), np.cumsum([0, *map(len, profiles)])[:-1].tolist()
        bias = drawn(profiles, seed, turn_on=8.0)[:, :1]
        design = WanderDesign(T, bias - bias.mean(axis=0), starts)
        A, y, noise = design.means, design.blocks.y[:, 0], design.noise(design.blocks.y[:, 0])
        X = A @ design.line

        def likelihood(sizes, A=A, y=y, X=X, noise=noise, design=design):
            white = np.diag(noise.white * design.contrasts.white)
            own = sum(size * C for size, C in zip(sizes, design.kinds, strict=True))
            V = A @ (noise.walk * design.contrasts.covariance + white + own) @ A.T
            inside = X.T @ np.linalg.solve(V, X)
            left = A @ y - X @ np.linalg.solve(inside, X.T @ np.linalg.solve(V, A @ y))
            logs = np.linalg.slogdet(V)[1] + np.linalg.slogdet(inside)[1]
            return -0.5 * (logs + left @ np.linalg.solve(V, left))

        sizes = np.array([noise.bends, noise.levels, noise.shapes])
        best = likelihood(sizes)
        for k in range(3):
            for times in (0.5, 2.0):
                other = sizes * np.where(np.arange(3) == k, times, 1.0)
                least = noise.walk / design.R if k == 1 else 0.0  # what the walk makes in a recording
                assert other[k] < least or likelihood(other) < best + 0.02
