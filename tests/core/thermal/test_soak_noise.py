"""White noise and walk of interleaved blocks, against the dense likelihood of their contrasts."""

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

from fusion_core.thermal.soak_noise import Complement, Contrasts, blocks_of, walk_covariance


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


@pytest.mark.parametrize("cycles", [1, 60])
def test_the_walk_of_blocks_is_the_double_sum_over_their_stretches(cycles: int) -> None:
    """Of blocks that follow one another, and of those that were measured in turn."""
    T = 20 - 30 * np.cos(2 * np.pi * cycles * np.arange(5000) / 5000)
    blocks = blocks_of(T, np.zeros((5000, 1)))
    during, r = blocks.during.toarray(), np.arange(blocks.during.shape[1])
    walk = (np.minimum.outer(r, r) + 0.5 - np.eye(len(r)) / 6) / len(r)
    np.testing.assert_allclose(walk_covariance(blocks), during @ walk @ during.T, rtol=0, atol=1e-14)


def test_the_complement_is_orthonormal_and_free_of_its_columns() -> None:
    rng = np.random.default_rng(4)
    columns, x, C = rng.normal(size=(30, 7)), rng.normal(size=(30, 2)), np.cov(rng.normal(size=(30, 90)))
    free = Complement(columns)
    np.testing.assert_allclose(free.Z.T @ np.column_stack([free.Z, columns]), np.eye(23, 30), atol=1e-12)
    np.testing.assert_allclose(free.of(x), free.Z.T @ x, atol=1e-12)
    np.testing.assert_allclose(free.both(C), free.Z.T @ C @ free.Z, atol=1e-12)


@pytest.mark.parametrize("followed", [0.5, 1 - 1e-5])
def test_what_a_map_leaves_is_turned_as_all_of_its_contrasts_are(followed: float) -> None:
    """With and without an inverse of what it leaves, beside a root of the covariance: likelihoods are the same."""
    rng = np.random.default_rng(6)
    blocks = blocks_of(20 - 30 * np.cos(6 * np.pi * np.arange(4000) / 4000), rng.normal(size=(4000, 1)))
    contrasts = Contrasts(blocks)
    shape = contrasts.Z[:, :3]
    left = np.eye(len(blocks.T)) - followed * shape @ shape.T
    y = left @ blocks.y[:, 0]
    walk, u = contrasts._turned(y, left)
    A = contrasts.Z.T @ left
    root = np.linalg.cholesky((A * contrasts.white) @ A.T)
    white, dense = np.linalg.solve(root, contrasts.Z.T @ y), np.linalg.solve(root, A @ contrasts.covariance @ A.T)
    dense = np.linalg.solve(root, dense.T)
    if followed < 0.9:  # of the other, three shapes are left out
        np.testing.assert_allclose(np.linalg.eigvalsh(walk), np.linalg.eigvalsh(dense), atol=1e-10)
        np.testing.assert_allclose([u @ u, u @ walk @ u], [white @ white, white @ dense @ white], rtol=1e-9)
    assert len(u) == len(white) - 3 * (followed > 0.9)
