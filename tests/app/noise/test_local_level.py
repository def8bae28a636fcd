"""The noise of what is left, against a state-space likelihood and laws."""

import numpy as np
import pytest
from scipy.linalg import block_diag, null_space
from scipy.stats import multivariate_normal

from driftlab.noise.local_level import LevelLikelihood, effective, fit_local_level, one_step


def test_the_restricted_likelihood_is_that_of_the_dense_distribution_of_all_contrasts():
    """Two recordings with rows that were not read, a level that begins anew, and columns free beside."""
    rng, parts, covariances, free, signals = np.random.default_rng(8), [], [], [], []
    for n, unknown in ((60, [20]), (45, [0])):
        w, dt, X, y = rng.uniform(0.5, 2, n), rng.uniform(1, 4, n), rng.normal(size=(n, 3)), rng.normal(size=(n, 2))
        missing, dt[0] = rng.random(n) < 0.2, 0.0
        level = np.cumsum(np.isin(np.arange(n), unknown))
        together = level[:, None] == level
        since = np.cumsum(dt)
        walk = np.where(together, np.minimum.outer(since, since), 0.0)
        levels = (level[:, None] == np.unique(level[np.isin(np.arange(n), unknown)])).astype(float)
        read = ~missing
        covariances.append((np.diag(w[read]), walk[np.ix_(read, read)]))
        free.append((X[read], levels[read]))
        signals.append(y[read])
        dt[unknown] = np.inf
        parts.append((np.where(missing[:, None], np.nan, np.hstack([X, y])), np.where(missing, np.inf, w), dt))
    white, walk = (block_diag(*each) for each in zip(*covariances, strict=True))
    columns = np.hstack([np.concatenate([X for X, _ in free]), block_diag(*(levels for _, levels in free))])
    K = null_space(columns.T)
    u = K.T @ np.concatenate(signals)
    likelihood, costs, dense = LevelLikelihood(parts, 3), [], []
    for ratio in (0.0, 1e-3, 0.1, 5.0):
        cost, s2, nu = likelihood.at(ratio)
        S = K.T @ (white + ratio * walk) @ K
        assert nu == len(u)
        np.testing.assert_allclose(s2, np.sum(u * np.linalg.solve(S, u), axis=0) / nu, rtol=1e-9)
        costs.append(cost)
        dense.append([-2 * multivariate_normal.logpdf(v, cov=s * S) for v, s in zip(u.T, s2, strict=True)])
    np.testing.assert_allclose(np.diff(costs, axis=0), np.diff(dense, axis=0), rtol=1e-8)


@pytest.mark.parametrize(("walk", "white"), [(0.05, 1.0), (0.3, 1.0), (2.0, 1.0)])
def test_the_noise_is_that_of_a_local_level(walk, white):
    """statsmodels' maximum likelihood of a local level: the same steady gain and one-step variance."""
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    rng = np.random.default_rng(5)
    x = np.cumsum(walk * rng.normal(size=2000)) + white * rng.normal(size=2000)
    likelier = structural.UnobservedComponents(x, level="local level").fit(disp=False)
    r, q = likelier.params
    P = (q + np.sqrt(q**2 + 4 * q * r)) / 2  # steady prediction of the level
    found = fit_local_level([x])
    assert found.gain == pytest.approx(P / (P + r), rel=0.1)
    assert found.variance == pytest.approx(P + r, rel=0.01)
    assert found.white == pytest.approx(r, rel=0.1)
    assert found.walk == pytest.approx(q, rel=0.25)


@pytest.mark.parametrize("walking", [False, True])
def test_white_noise_has_as_many_independent_rows_as_rows(walking):
    rng, n = np.random.default_rng(6), 4000
    ratios = [effective(rng.normal(size=n), np.sin(np.arange(n) / tau), walking=walking) / n for tau in (5, 20, 80) * 4]
    assert np.mean(ratios) == pytest.approx(1, abs=0.15)


def test_a_walk_has_few_independent_rows_for_what_is_slow():
    rng, n = np.random.default_rng(7), 4000
    walk = np.cumsum(rng.normal(size=n))
    assert effective(walk, np.sin(2 * np.pi * np.arange(n) / n), walking=False) < 10
    assert effective(walk, rng.normal(size=n), walking=False) > n / 3


def test_the_variance_is_the_mean_square_of_the_errors_at_the_gain():
    rng = np.random.default_rng(5)
    parts = [np.cumsum(rng.normal(0, 0.1, n)) + rng.normal(0, 1, n) for n in (900, 1400)]
    found = fit_local_level(parts)
    errors = np.concatenate(one_step(parts, found.gain))
    assert found.variance == pytest.approx(np.mean(errors**2), rel=1e-12)
