"""White noise and walk of interleaved blocks, against the dense likelihood of their contrasts."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from fusion_core.thermal.soak_noise import Contrasts, blocks_of


@pytest.mark.parametrize("order", [None, 3])
def test_the_likeliest_variances_are_those_of_the_dense_likelihood(order: int | None) -> None:
    """Of all samples, and of what a polynomial leaves of them."""
    rng, N = np.random.default_rng(2), 4000
    T = 20 - 30 * np.cos(6 * np.pi * np.arange(N) / N)
    bias = rng.normal(size=(N, 1)) + 0.03 * np.cumsum(rng.normal(size=(N, 1)), axis=0)
    blocks = blocks_of(T, bias)
    contrasts, left = Contrasts(blocks), np.eye(len(blocks.T))
    if order is not None:
        V = np.polynomial.chebyshev.chebvander(blocks.T / 50, order)
        left -= V @ np.linalg.solve(V.T @ (V * blocks.n[:, None]), V.T * blocks.n)
    y = left @ blocks.y[:, 0]
    A = contrasts.Z.T @ left

    def cost(logs: np.ndarray) -> float:
        walk, white = np.exp(logs)
        S = A @ (walk * contrasts.covariance + white * np.diag(contrasts.white)) @ A.T
        return -float(multivariate_normal.logpdf(A @ blocks.y[:, 0], cov=(S + S.T) / 2, allow_singular=True))

    found = contrasts.noise(y, left)
    best = minimize(cost, np.log([found.walk, found.white]) + 0.3, method="Nelder-Mead", options={"xatol": 1e-6})
    np.testing.assert_allclose([found.walk, found.white], np.exp(best.x), rtol=1e-3)
