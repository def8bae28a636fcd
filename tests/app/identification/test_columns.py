"""Normal equations against dense least squares, and their compiled twin against them."""

import numpy as np
import pytest

from driftlab.identification.columns import NormalEquations, free_starts, left_with_starts


def problem(seed=0, n=200, k=6):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, k)), rng.normal(size=n)


def of(Z, y):
    both = np.column_stack([Z, y])
    return NormalEquations.of(both.T @ both)


def test_a_solution_is_that_of_least_squares():
    Z, y = problem()
    x, (left,), *_ = np.linalg.lstsq(Z, y, rcond=None)
    np.testing.assert_allclose(of(Z, y).solution, x, rtol=1e-6)
    assert of(Z, y).left == pytest.approx(left, rel=1e-6)
    np.testing.assert_allclose(of(Z, y).variances, np.diag(np.linalg.inv(Z.T @ Z)), rtol=1e-6)


def test_rows_add_up_and_columns_are_chosen():
    Z, y = problem()
    whole = of(Z[:80], y[:80]) + of(Z[80:], y[80:])
    np.testing.assert_allclose(whole.A, of(Z, y).A)
    keep = np.array([0, 3, 4])
    np.testing.assert_allclose(
        whole.restricted(keep).solution, np.linalg.lstsq(Z[:, keep], y, rcond=None)[0], rtol=1e-6
    )


def test_a_ridge_is_that_of_more_rows():
    Z, y = problem()
    ridge = np.array([2.0, 5.0])
    more = np.vstack([Z, np.diag(np.sqrt([*ridge, 0, 0, 0, 0]))])
    x = np.linalg.lstsq(more, np.append(y, np.zeros(6)), rcond=None)[0]
    np.testing.assert_allclose(of(Z, y).raised(ridge).solution, x, rtol=1e-6)
    np.testing.assert_allclose(of(Z, y).raised(np.diag(ridge)).solution, x, rtol=1e-6)


def test_given_coefficients_are_taken_off_the_signal():
    Z, y = problem()
    theta = np.array([0.3, -2.0])
    mine, dense = of(Z, y).given(theta), of(Z[:, :4], y - Z[:, 4:] @ theta)
    np.testing.assert_allclose(mine.b, dense.b)
    np.testing.assert_allclose(mine.solution, dense.solution)
    assert mine.left == pytest.approx(dense.left)


def test_columns_explain_the_products_that_residuals_lack():
    Z, y = problem()
    both = np.column_stack([Z, y])
    cols = np.array([1, 2])
    left = both - both[:, cols] @ np.linalg.lstsq(both[:, cols], both, rcond=None)[0]
    G = both.T @ both
    V = of(Z[:, cols], y).explained(G[cols])
    np.testing.assert_allclose(G - V @ V.T, left.T @ left, atol=1e-5)


def test_what_the_rows_do_not_determine_stays_small():
    Z, y = problem(k=2)
    twice = np.column_stack([Z, Z])
    assert np.linalg.norm(of(twice, y).solution) < np.linalg.norm(of(Z, y).solution)
    assert of(twice, y).left == pytest.approx(of(Z, y).left, rel=1e-6)


@pytest.mark.parametrize("size", [0.0, 3.0])
def test_the_compiled_twin_leaves_the_same(size):
    """With starts of some size, and with none: then they are out of the model."""
    Z, y = problem()
    y = y - Z @ np.linalg.lstsq(Z, y, rcond=None)[0] + Z[:, 4:] @ np.array([size, -size])
    both = np.column_stack([Z, y])
    sizes = np.array([2])
    equations, starts = of(Z, y), [np.array([4, 5])]
    (sd,), slow = free_starts(equations, 4, starts, len(y), 1.0)
    if sd > 0:
        expected = equations.raised(np.append(np.zeros(4), np.full(2, slow / sd**2))).left
    else:
        expected = equations.restricted(np.arange(4)).left
    found = left_with_starts(both.T @ both, np.zeros((7, 0)), 6, np.arange(6), sizes, len(y), 1.0)
    assert found == pytest.approx(expected, rel=1e-6)
    assert (sd > 0) == (size > 0)
