"""Contrasts of a soak against dense matrices: how uncertain the form of a curve is that follows its input."""

import numpy as np
import pytest

from driftlab.maps.hysteresis.contrasts import RATIOS, FollowingCurves, SoakContrasts
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
