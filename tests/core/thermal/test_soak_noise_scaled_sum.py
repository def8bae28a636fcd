"""Inner products by three diagonals, against dense matrices."""

import numpy as np
import pytest

from fusion_core.thermal.soak_noise import ScaledSum


@pytest.mark.parametrize("m", [1, 2, 3, 40])
@pytest.mark.parametrize("ratio", [0.0, 1e-3, 1.0, 1e5])
def test_inner_products_are_those_of_the_whole_matrix(m: int, ratio: float) -> None:
    rng = np.random.default_rng(m)
    A, B = rng.normal(size=(m, m)), rng.normal(size=(m, 3))
    M = A @ A.T
    sums = ScaledSum(M, B)
    X, log_det = sums.solved(ratio)
    S = ratio * M + np.eye(m)
    np.testing.assert_allclose(sums.B.T @ X, B.T @ np.linalg.solve(S, B), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(S)[1], rtol=1e-9, atol=1e-9)


def test_a_matrix_that_is_not_whole_is_taken() -> None:
    line = np.arange(1.0, 6.0)
    sums = ScaledSum(np.outer(line, line), line[:, None])
    np.testing.assert_allclose(np.sum(sums.B * sums.solved(2.0)[0]), line @ line / (1 + 2 * line @ line))
