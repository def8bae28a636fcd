"""White noise and walk of interleaved blocks, against the dense likelihood of their contrasts."""

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

from fusion_core.thermal.soak_noise import Contrasts, blocks_of


@pytest.mark.parametrize("order", [None, 3])
def test_the_variances_are_the_means_over_the_dense_likelihood(order: int | None) -> None:
    """Of all samples, and of what a polynomial leaves of them; on a grid of both deviations, in their own units."""
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
    values, V = np.linalg.eigh(A @ A.T)
    A = V[:, values > 1e-6 * values[-1]].T @ A  # of the rest the polynomial leaves nothing
    walks, whites = A @ contrasts.covariance @ A.T, (A * contrasts.white) @ A.T

    def log_likelihood(walk: float, white: float) -> float:
        factor, u = cho_factor(walk**2 * walks + white**2 * whites), A @ blocks.y[:, 0]
        return -float(np.sum(np.log(np.diagonal(factor[0]))) + u @ cho_solve(factor, u) / 2)

    found = contrasts.noise(y, left)
    walk = np.sqrt(found.walk) * np.linspace(0.02, 3, 41)[:, None]
    white = np.sqrt(found.white) * np.linspace(0.7, 1.4, 29)
    logs = np.vectorize(log_likelihood)(walk, white)
    density = np.exp(logs - logs.max()) / white**2  # uniform in walk / white and in log white
    density /= density.sum()
    assert max(density[0].sum(), density[-1].sum(), density[:, 0].sum(), density[:, -1].sum()) < 1e-4, (
        "the grid is wide"
    )
    expected = [np.sum(density * walk**2), np.sum(density * white**2)]
    np.testing.assert_allclose([found.walk, found.white], expected, rtol=2e-3)


def test_a_walk_that_the_likelihood_denies_by_chance_is_not_none() -> None:
    """Of a soak that only warms, the likeliest walk is often none; its mean is in proportion on average."""
    rng, N, means = np.random.default_rng(8), 2000, []
    for _ in range(40):
        walk = np.cumsum(rng.normal(size=(N, 1)), axis=0) * 0.02
        blocks = blocks_of(np.linspace(0, 50, N), walk + rng.normal(size=(N, 1)))
        means.append(Contrasts(blocks).noise(blocks.y[:, 0], np.eye(len(blocks.T))).walk / (N * 0.02**2))
    assert min(means) > 0.02
    assert 0.7 < np.median(means) < 3


def test_a_map_that_leaves_one_contrast_leaves_no_walk() -> None:
    """As a network that follows all but one shape of the samples: two variances do not follow from one number."""
    rng = np.random.default_rng(3)
    blocks = blocks_of(20 - 30 * np.cos(6 * np.pi * np.arange(4000) / 4000), rng.normal(size=(4000, 1)))
    contrasts = Contrasts(blocks)
    v = contrasts.Z[:, 0]
    found = contrasts.noise(v * (v @ blocks.y[:, 0]), np.outer(v, v))
    assert found.walk == 0
    assert found.white > 0
    assert np.all(np.isfinite(found.root))
