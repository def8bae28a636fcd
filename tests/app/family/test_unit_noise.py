"""White noise and walk about a free curve: against the dense likelihood, and against what was planted."""

from dataclasses import replace

import family
import numpy as np
import pytest
from scipy.linalg import block_diag, null_space
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from driftlab.family.basis import SplineBasis
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import common_walk, densities_of, walk_from_repeated_sweeps
from driftlab.soak.blocks import SoakRows

STEP = 2.5


def rows(seed, *, R=300, white=2.0, walk=0.02, swing=60.0, curve=lambda T: 0.05 * T**2, start=0.0):
    """Rows of 10 s on an even way up and down: white noise a row of white / sqrt(10), and a walk."""
    rng = np.random.default_rng(seed)
    t = start + 10.0 * np.arange(R)
    T = -10 + swing * (1 - np.abs(1 - 2 * np.arange(R) / (R - 1)))
    level = np.cumsum(walk * np.sqrt(10) * rng.normal(size=(R, 1)), axis=0)
    bias = curve(T)[:, None] + level + white / np.sqrt(10) * rng.normal(size=(R, 1))
    return SoakRows(t, T, bias, np.full(R, 10.0), {})


def dense(own, white, walk):
    """The covariance of rows as a matrix, the level that of the curve at the first one."""
    since = own.t - own.t[0]
    return walk**2 * np.minimum.outer(since, since) + np.diag(white**2 / own.span)


def test_the_likeliest_densities_are_those_of_the_dense_restricted_likelihood() -> None:
    own = rows(3)
    T, y = own.T, own.bias[:, 0]
    U, s, _ = np.linalg.svd(SplineBasis.covering(T.min(), T.max(), STEP).values(T), full_matrices=False)
    U = U[:, s > 1e-5 * s[0]]

    def cost(logs):
        S = dense(own, *np.exp(logs))
        weighted = np.linalg.solve(S, np.column_stack([U, y]))
        A = U.T @ weighted[:, :-1]
        left = y @ weighted[:, -1] - (U.T @ weighted[:, -1]) @ np.linalg.solve(A, U.T @ weighted[:, -1])
        return np.linalg.slogdet(S)[1] + np.linalg.slogdet(A)[1] + left

    found = densities_of([own], STEP)
    best = minimize(cost, np.log([2.0, 0.02]), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9})
    np.testing.assert_allclose([found.white[0], found.walk[0]], np.exp(best.x), rtol=3e-3)
    step = 0.05 * np.eye(2)
    x = best.x

    def bend(a, b):
        return (cost(x + a + b) - cost(x + a - b) - cost(x - a + b) + cost(x - a - b)) / 0.01

    curvature = np.array([[bend(a, b) for a in step] for b in step])
    deviations = np.sqrt(np.diag(np.linalg.inv(curvature / 2)))
    np.testing.assert_allclose(
        [found.white_sigma[0] / found.white[0], found.walk_sigma[0] / found.walk[0]], deviations, rtol=0.05
    )


def test_a_curve_that_levels_can_make_is_theirs():
    """The second recording shares no temperature with the first: how far apart their curves are, nobody knows."""
    first, other = rows(4, R=120, swing=15.0), rows(5, R=120, swing=15.0, start=1e5)
    own = [first, replace(other, T=other.T + 45)]
    T, y = np.concatenate([part.T for part in own]), np.concatenate([part.bias[:, 0] for part in own])
    level = np.repeat([0.0, 1.0], 120)[:, None]
    K = null_space(np.hstack([SplineBasis.over(T, STEP).values(T), level]).T, rcond=1e-5)

    def cost(logs):
        S = K.T @ block_diag(*(dense(part, *np.exp(logs)) for part in own)) @ K
        return -multivariate_normal.logpdf(K.T @ y, cov=(S + S.T) / 2)

    found = densities_of(own, STEP)
    best = minimize(cost, np.log([2.0, 0.02]), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9})
    np.testing.assert_allclose([found.white[0], found.walk[0]], np.exp(best.x), rtol=3e-3)


@pytest.mark.parametrize("walk", [0.0, 0.02, 0.5])
def test_the_likely_walk_is_the_mean_under_the_dense_restricted_likelihood(walk) -> None:
    own = rows(6, R=80, walk=walk)
    U, s, _ = np.linalg.svd(SplineBasis.covering(own.T.min(), own.T.max(), STEP).values(own.T), full_matrices=False)
    U, y, nu = U[:, s > 1e-5 * s[0]], own.bias[:, 0], 80 - int(np.sum(s > 1e-5 * s[0]))
    at, costs, white = np.arange(-18.0, 14.01, 0.2), [], []  # of the variances of walk and of white noise in a row
    logs = (at - np.log(10.0 * np.ptp(own.t))) / 2  # of the densities
    for log in logs:
        inverse = np.linalg.inv(dense(own, 1.0, np.exp(log)))
        A, b = U.T @ inverse @ U, U.T @ inverse @ y
        white.append((y @ inverse @ y - b @ np.linalg.solve(A, b)) / nu)
        costs.append(nu * np.log(white[-1]) - np.linalg.slogdet(inverse)[1] + np.linalg.slogdet(A)[1])
    weight = np.exp(-(np.array(costs) - np.min(costs)) / 2 + logs)  # even in the walk
    mean = np.trapezoid(weight * np.array(white) * np.exp(2 * logs)) / np.trapezoid(weight)
    assert densities_of([own], STEP).likely[0] == pytest.approx(np.sqrt(mean), rel=2e-3)


def test_the_densities_of_a_family_are_within_their_deviations() -> None:
    white, walk = [], []
    for seed in range(60):
        found = densities_of([rows(seed), rows(seed + 1000, R=150, swing=30.0, start=1e5)], STEP)
        white.append(np.log(found.white[0] / 2.0) / (found.white_sigma[0] / found.white[0]))
        if found.walk[0]:
            walk.append(np.log(found.walk[0] / 0.02) / (found.walk_sigma[0] / found.walk[0]))
    assert len(walk) > 40
    for scores in (white, walk):
        assert 0.5 < np.mean(np.square(scores)) < 1.7
        assert abs(np.mean(scores)) < 0.5


def test_a_walk_that_does_not_show_has_an_upper_limit() -> None:
    beyond = 0
    for seed in range(20):
        found = densities_of([rows(seed, walk=0.0)], STEP)
        assert 0 < found.walk_sigma[0] < 0.05
        assert 0 < found.likely[0] < 0.05
        beyond += found.walk[0] > 0
    assert beyond <= 4  # of 20, where one in 20 is expected


def test_information_is_that_of_dense_generalised_least_squares() -> None:
    recordings = [rows(1), rows(2, R=120, swing=20.0, start=5e4)]
    soaked = UnitInformation.of("a", ("x",), recordings, np.array([2.0]), np.array([0.02]), STEP)
    W = np.zeros((420, 420))
    first, second = (np.linalg.inv(dense(own, 2.0, 0.02)) for own in recordings)
    W[:300, :300] = first
    W[300:, 300:] = second - second.sum(axis=1)[:, None] * second.sum(axis=0) / second.sum()  # a level of its own
    B = soaked.knots.values(np.concatenate([own.T for own in recordings]))
    y = np.concatenate([own.bias[:, 0] for own in recordings])
    np.testing.assert_allclose(soaked.J[0], B.T @ W @ B, rtol=1e-9, atol=1e-9 * soaked.J.max())
    np.testing.assert_allclose(soaked.h[0], B.T @ W @ y, rtol=1e-9, atol=1e-9 * np.abs(soaked.h).max())


def test_passes_that_agree_leave_the_walk_as_it_is() -> None:
    larger = 0
    for seed in range(40):
        own = [rows(seed)]
        found = densities_of(own, STEP)
        larger += walk_from_repeated_sweeps(own, found.white, found.likely, STEP)[0] > found.likely[0]
    assert larger <= 3  # one in 100 is expected


def test_passes_that_differ_ask_for_a_larger_walk() -> None:
    own = rows(1)
    bumpy = own.bias + np.where(np.arange(300) < 150, 0.0, 15 * np.sin(own.T / 6))[:, None]
    own = SoakRows(own.t, own.T, bumpy, own.span, {})
    given = np.array([0.05])
    larger = walk_from_repeated_sweeps([own], np.array([2.0]), given, STEP)
    assert larger[0] > 3 * given[0]


@pytest.mark.parametrize("law", ["mixed", "gaussian"])
def test_two_soaks_of_one_unit_differ_as_their_information_says(law: str) -> None:
    """Chi-square of the difference, a degree of freedom."""
    from soaked_units import compared, soaked

    ratios = []
    for unit in family.deal(12, seed=41, law=law):
        ratios += compared(soaked(family.soak(unit, seed=1)), soaked(family.soak(unit, seed=2)))
    assert 0.75 < np.mean(ratios) < 1.2
    assert max(ratios) < 2.5


@pytest.mark.parametrize("walk", [0.0, 0.005, 0.02])
def test_units_together_say_what_walk_they_have_where_one_alone_cannot(walk):
    """White noise of 2: a walk of 0.005 hardly shows in one soak, and what is likely of none is far more than none."""
    units = [[rows(900 + k, walk=walk)] for k in range(16)]
    common, likely = common_walk(units, STEP)
    np.testing.assert_allclose(likely[3], densities_of(units[3], STEP).likely)
    together, alone = 2.0 * common[0], np.median(likely)
    assert abs(together - walk) < max(0.3 * walk, 0.003)
    assert walk or together < 0.6 * alone
