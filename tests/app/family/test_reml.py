"""The restricted likelihood against statsmodels, against its dense form, and the posterior against least squares."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from driftlab.family.contrasts import OWN, PLACEBOS, _placebos
from driftlab.family.reml import (
    Means,
    UnitsUnderLaw,
    VarianceComponents,
    _log_det,
    change,
    e_step,
    inverse,
    m_step,
    smooth,
)  # fmt: skip


def reml(
    J: np.ndarray, h: np.ndarray, lot: np.ndarray, start: VarianceComponents, *, tolerance: float, most: int = 2000
) -> tuple[VarianceComponents, Means]:
    """Return the law of highest restricted likelihood, every unit's weight 1, and the means under it."""
    w, lots = np.ones(len(J)), int(lot.max()) > 0
    law = start if lots else replace(start, Lambda=np.zeros_like(start.Sigma))
    units = [(J[k : k + 90], h[k : k + 90], lot[k : k + 90]) for k in range(0, len(J), 90)]
    for _ in range(most):
        later = m_step(e_step(UnitsUnderLaw(law, units), w), w, None, lots=lots)
        law, moved = later, change(law, later)
        if moved < tolerance:
            break
    under = UnitsUnderLaw(law, units)
    return law, under.means(w).turned(under.L)


def dense(y: np.ndarray, X: list[np.ndarray], noise: float, Sigma: np.ndarray) -> float:
    """Return the restricted log likelihood of rows of units, by the determinants of its definition."""
    V = np.zeros((len(y), len(y)))
    at = 0
    for own in X:
        part = slice(at, at + len(own))
        V[part, part] = own @ Sigma @ own.T + noise * np.eye(len(own))
        at += len(own)
    Z = np.vstack(X)
    W = np.linalg.inv(V)
    F = Z.T @ W @ Z
    r = y - Z @ np.linalg.solve(F, Z.T @ W @ y)
    return float(-0.5 * (np.linalg.slogdet(V)[1] + np.linalg.slogdet(F)[1] + r @ W @ r))


def problem(n: int, rows: int, seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(seed)
    X = [np.stack([np.ones(rows), rng.uniform(-1, 1, rows)], axis=1) for _ in range(n)]
    root = np.array([[1.5, 0.0], [0.6, 0.8]])
    y = np.concatenate([own @ (np.array([2.0, -1.0]) + root @ rng.normal(size=2)) for own in X])
    return X, y + 0.5 * rng.normal(size=len(y))


def information(X: list[np.ndarray], y: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    at = np.cumsum([0, *map(len, X)])
    J = np.stack([own.T @ own / noise for own in X])
    return J, np.stack([own.T @ y[a:b] / noise for own, a, b in zip(X, at, at[1:], strict=False)])


def test_it_is_the_restricted_maximum_of_statsmodels() -> None:
    import statsmodels.api as sm

    X, y = problem(40, 6, 1)
    group = np.repeat(np.arange(len(X)), 6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = sm.MixedLM(y, np.vstack(X), group, exog_re=np.vstack(X)).fit(reml=True)
    J, h = information(X, y, theirs.scale)
    law, found = reml(
        J, h, np.zeros(len(X), dtype=int), VarianceComponents(np.eye(2), np.zeros((2, 2))), tolerance=1e-9
    )
    assert_allclose(law.Sigma, np.asarray(theirs.cov_re), rtol=2e-3)
    assert_allclose(found.mu, theirs.fe_params, rtol=1e-4)
    assert_allclose(found.covariance, np.asarray(theirs.cov_params())[:2, :2], rtol=2e-3)


def test_it_maximises_the_dense_likelihood_though_a_unit_saw_one_place() -> None:
    X, y = problem(7, 4, 3)
    X[2] = np.repeat(X[2][:1], 4, axis=0)  # one temperature: J of rank 1
    J, h = information(X, y, 0.25)
    law, _ = reml(
        J, h, np.zeros(7, dtype=int), VarianceComponents(np.eye(2), np.zeros((2, 2))), tolerance=1e-10, most=20_000
    )

    def cost(v: np.ndarray) -> float:
        L = np.array([[v[0], 0.0], [v[1], v[2]]])
        return -dense(y, X, 0.25, L @ L.T)

    best = minimize(cost, np.array([1.0, 0.0, 1.0]), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    L = np.array([[best.x[0], 0.0], [best.x[1], best.x[2]]])
    assert_allclose(law.Sigma, L @ L.T, rtol=1e-3, atol=1e-4)


def test_the_mean_without_its_uncertainty_would_make_units_too_alike() -> None:
    """Of c that are known exactly, REML is the sample covariance over n - 1, maximum likelihood over n."""
    rng = np.random.default_rng(0)
    c = rng.normal(size=(5, 2)) @ np.array([[1.0, 0.4], [0.0, 0.7]])
    J = np.repeat(1e12 * np.eye(2)[None], 5, axis=0)
    law, found = reml(
        J, 1e12 * c, np.zeros(5, dtype=int), VarianceComponents(np.eye(2), np.zeros((2, 2))), tolerance=1e-10
    )
    assert_allclose(law.Sigma, np.cov(c.T), rtol=1e-6)
    assert_allclose(found.covariance, np.cov(c.T) / 5, rtol=1e-5)


def test_lots_are_random_effects() -> None:
    """Balanced one-way layout: the classical estimates of Searle, Casella & McCulloch (1992), chapter 3."""
    rng = np.random.default_rng(4)
    lots, each = 40, 6
    lot = np.repeat(np.arange(lots), each)
    y = 3 + 2.0 * rng.normal(size=lots)[lot] + rng.normal(size=lots * each)
    within = np.mean([np.var(y[lot == g], ddof=1) for g in range(lots)])
    between = np.var([y[lot == g].mean() for g in range(lots)], ddof=1) - within / each
    J = np.full((len(y), 1, 1), 1e12)
    law, found = reml(J, 1e12 * y[:, None], lot, VarianceComponents(np.eye(1), np.eye(1)), tolerance=1e-10, most=5000)
    assert_allclose(law.Sigma[0, 0], within, rtol=1e-3)
    assert_allclose(law.Lambda[0, 0], between, rtol=1e-2)
    shrunk = (np.array([y[lot == g].mean() for g in range(lots)]) - y.mean()) * between / (between + within / each)
    assert_allclose(found.shifts[:, 0], shrunk, rtol=2e-2, atol=1e-2)


def covariances(n: int, q: int, condition: float) -> np.ndarray:
    rng = np.random.default_rng(q)
    turned = np.linalg.qr(rng.normal(size=(n, q, q)))[0]
    return np.einsum("nij,j,nkj->nik", turned, np.geomspace(1, condition, q), turned)


def test_inverses_by_sweeps_are_lapacks() -> None:
    for q, condition in ((1, 1.0), (2, 1e2), (35, 1e6)):
        matrices = covariances(7, q, condition)
        scale = np.max(np.abs(np.linalg.inv(matrices)))
        assert_allclose(inverse(matrices), np.linalg.inv(matrices), atol=1e-16 * 50 * condition * scale)
        assert_allclose(inverse(matrices), inverse(np.tril(matrices)))  # the lower triangle is read
        log_det, inverted = _log_det(matrices * 1e-9)
        assert_allclose(log_det, np.linalg.slogdet(matrices * 1e-9)[1], rtol=1e-10)
        assert_allclose(inverted * 1e-9, np.linalg.inv(matrices), atol=1e-16 * 50 * condition * scale)


def test_derivatives_of_the_smooth_prior_are_differences() -> None:
    peaks, numbers = np.linspace(-20.0, 60.0, 9), np.log([1e-6, 2e-6, 3e-6, 15.0, 5e-7])
    Psi, slopes = smooth(peaks, numbers)
    u, apart = (peaks - 20) / 40, np.abs(peaks[:, None] - peaks)
    k = np.sqrt(3) * apart / 30
    curve = 9e-12 * (np.exp(-0.5 * (apart / 15) ** 2) + 1e-9 * np.eye(9))
    tiny = 1e-9 * np.eye(9)
    law = 1e-12 * (1 + tiny) + 4e-12 * (np.outer(u, u) + tiny) + curve + 25e-14 * (1 + k) * np.exp(-k)
    assert_allclose(Psi, law, rtol=1e-12)
    for m, slope in enumerate(slopes):
        step = np.where(np.arange(5) == m, 1e-5, 0.0)
        difference = (smooth(peaks, numbers + step)[0] - smooth(peaks, numbers - step)[0]) / 2e-5
        assert_allclose(slope, difference, atol=1e-8 * np.max(np.abs(Psi)))


def test_placebos_are_waves_of_a_contrast_apart_from_one_another() -> None:
    """By Gram and Schmidt on the rows: e times a wave, less the curve, e itself, and the waves before."""
    rng, R = np.random.default_rng(4), 60
    Q = np.linalg.qr(rng.normal(size=(R, 3)))[0]
    e, r = rng.normal(size=(R, 2)), rng.normal(size=R)
    e -= Q @ (Q.T @ e)
    r -= Q @ (Q.T @ r)
    size = np.sum(e**2, axis=0)
    found = _placebos(Q, r, e.copy(), size, e.T @ r / size)
    for one, own in zip(e.T, found, strict=True):
        base = [*Q.T, one / np.linalg.norm(one)]
        for j in range(PLACEBOS):
            wave = one * np.cos(np.pi * (np.arange(R) + 0.5) / R * (j + 1))
            for vector in base:
                wave = wave - vector * (vector @ wave)
            if wave @ wave > OWN * (one @ one):
                base.append(wave / np.linalg.norm(wave))
                assert_allclose(own[j], base[-1] @ r, atol=1e-10)
            else:
                assert own[j] == 0
