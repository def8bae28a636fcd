"""Penalised least squares against the criterion itself, each lambda solved on its own."""

import numpy as np
import pytest

from fusion_core.thermal.penalised import INFLATED, LAMBDAS, RIDGE, penalised

m, n = 300, 41
KNOTS = np.linspace(0, 40, n)
ROUGH = np.diff(np.eye(n), n=2, axis=0)


def by_hand(B, y, w, penalty, lambdas):
    """Return coefficients and operator of the lambda with the least criterion."""
    w = w / np.mean(w)
    N = B.T @ (w[:, None] * B)
    N += RIDGE * np.trace(N) / n * np.eye(n)
    P = penalty * np.trace(N) / np.trace(penalty)
    tried = []
    for weight in lambdas:
        operator = np.linalg.solve(N + weight * P, B.T * w)
        free = len(y) - INFLATED * np.trace(B @ operator)
        left = y - B @ (operator @ y)
        tried.append((w @ left**2 / free**2 if free > 0 else np.inf, operator))
    best = min(tried, key=lambda item: item[0])[1]
    return best @ y, best


@pytest.mark.parametrize("hole", [0.0, 15.0])
@pytest.mark.parametrize("curve", [np.sin, lambda T: 0.2 * T, lambda T: np.tanh(T - 8)])
def test_it_is_the_least_of_the_criterion(curve, hole):
    """In a hole of the samples the penalty alone decides: the equations without it are singular there."""
    rng = np.random.default_rng(0)
    T = np.sort(rng.uniform(0, 40, m))
    T = T[np.abs(T - 20) > hole / 2]
    w = rng.uniform(0.2, 3, len(T))
    y = curve(T) + rng.normal(size=len(T)) / (3 * np.sqrt(w))
    B = np.stack([np.interp(T, KNOTS, row) for row in np.eye(n)], axis=1)
    fit, (coefficients, operator) = penalised(B, y, w, ROUGH.T @ ROUGH), by_hand(B, y, w, ROUGH.T @ ROUGH, LAMBDAS)
    np.testing.assert_allclose(fit.coefficients, coefficients, atol=1e-8)
    np.testing.assert_allclose(fit.operator, operator, atol=1e-8)


def test_a_penalty_of_nothing_is_least_squares():
    rng = np.random.default_rng(0)
    B, y, w = rng.normal(size=(m, 4)), rng.normal(size=m), rng.uniform(0.5, 2, m)
    fit = penalised(B, y, w, np.zeros((4, 4)))
    root = np.sqrt(w)
    expected, squares, *_ = np.linalg.lstsq(root[:, None] * B, root * y)
    np.testing.assert_allclose(fit.coefficients, expected, atol=1e-8)
    covariance = np.linalg.inv(B.T @ (w[:, None] * B)) * squares / (m - 4)
    np.testing.assert_allclose(fit.root @ fit.root.T, covariance, rtol=1e-6)
