"""Contrasts of a soak against dense matrices: how uncertain the form of a curve is that follows its input."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from driftlab.maps.hysteresis.contrasts import RATIOS, SIZES, THIN, FollowingCurves, SoakContrasts, log_mean
from driftlab.soak.blocks import brief


@pytest.mark.parametrize("partly", [True, False])
def test_the_form_of_a_curve_is_as_uncertain_as_least_squares_with_its_size_given(partly):
    """Joint least squares of the curve here and the one that is late, or of the one curve that all follows."""
    rng, x = np.random.default_rng(5), np.linspace(0, 1, 2160)
    T = 15 - 35 * np.cos(4 * np.pi * x)
    bias = np.stack([T**2, 3 * T, T**3 / 50], axis=1) + rng.normal(0, 30, (len(x), 3))
    soak = brief(T, bias, [0], 10.0)
    contrasts = SoakContrasts(soak)
    inputs = np.roll(soak.T, 9)[:, None]
    p, d, noise, s2 = contrasts.splines.shape[1], 3, len(RATIOS) + 12, np.array([0.02, 0.1, 0.4])
    a, g = rng.normal(size=(2, 1, p, d))
    made = FollowingCurves(
        a, np.full((1, d), partly), np.zeros((len(soak.T), 1, d)), contrasts.late(inputs)[1][:, :, :p]
    )
    between = np.swapaxes(g, 1, 2)
    found = contrasts.form_variances(made, np.full(d, noise), s2, between)

    own, _ = contrasts.laws[1]
    C = RATIOS[12] / np.mean(own) * contrasts.covariances[1] + np.eye(len(contrasts.y))
    late = contrasts.means(contrasts.curve(inputs[:, 0])) * contrasts.root
    for axis in range(d):
        A = np.column_stack([late, contrasts.X]) if partly else late
        M = A.T @ np.linalg.solve(C, A) / s2[axis]
        M[:p, :p] += np.eye(p)
        cov = np.linalg.pinv(M, rcond=1e-13, hermitian=True)[:p, :p]
        size = np.linalg.solve(cov, a[0, :, axis])  # whose product with the curve is its size, up to a factor
        given = cov - np.outer(cov @ size, cov @ size) / (size @ cov @ size)
        expected = g[0, :, axis] @ given @ g[0, :, axis]
        assert found[0, axis] == pytest.approx(expected, rel=1e-3)


def drawn(seed):
    """Contrasts of a soak up and down twice, and three ways (m, 2, 3) that a bias may go in them."""
    rng = np.random.default_rng(seed)
    T = 15 - 35 * np.cos(4 * np.pi * np.linspace(0, 1, 2160))
    contrasts = SoakContrasts(brief(T, T[:, None] * [1.0, 2.0] + rng.normal(0, 30, (2160, 2)), [0], 10.0))
    return contrasts, rng.normal(size=(len(contrasts.u), 2, 3))


def covariances(contrasts):
    """Each THIN-th covariance of the contrasts, white noise of variance 1, by the covariance of the blocks."""
    for (own, _), C in zip(contrasts.laws, contrasts.covariances, strict=True):
        for ratio in RATIOS[::THIN]:
            yield np.eye(len(own)) + ratio / np.mean(own) * contrasts.Z.T @ C @ contrasts.Z


def dense(y, C):
    """The logarithm of the likelihood of y, of the covariance s^2 C, but for a constant: s^2 by the inverse gamma."""
    unit = multivariate_normal(cov=C).logpdf(y) + y @ np.linalg.solve(C, y) / 2 + len(y) / 2 * np.log(2 * np.pi)
    return unit - len(y) / 2 * np.log(y @ np.linalg.solve(C, y))


def test_curves_that_follow_wholly_are_as_likely_as_by_dense_matrices():
    contrasts, ways = drawn(8)
    z = 0.1 * ways[:, :, :1]
    found = contrasts.followed(np.repeat(z, 2, axis=2), np.repeat(ways[:, :, None], 2, axis=2))
    y, way = contrasts.u[:, 1] - z[:, 0, 0], ways[:, 0]
    expected = [dense(y, C + way @ way.T) for C in covariances(contrasts)]
    np.testing.assert_allclose(found[:, 0, 1], expected, rtol=1e-9)


def test_parts_of_a_curve_that_follow_are_as_likely_as_by_dense_matrices():
    contrasts, ways = drawn(9)
    found, _ = contrasts.parts(np.moveaxis(ways, 1, 0), len(RATIOS) + 12)
    y, way = contrasts.u[:, 1], ways[:, 0]
    expected = [
        log_mean(np.array([dense(y, C + g / np.linalg.eigvalsh(gram)[-1] * way @ way.T) for g in SIZES]))
        for C in covariances(contrasts)
        for gram in [way.T @ np.linalg.solve(C, way)]
    ]
    np.testing.assert_allclose(found[:, 0, 1], expected, rtol=1e-9)
