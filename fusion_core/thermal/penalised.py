"""Penalised least squares whose smoothing the samples choose.

::

    minimise  sum_k w_k (y_k - (B c)_k)^2 + lambda c' P c

lambda has the least generalised cross-validation, with the trace counted INFLATED times so that chance is not taken for
the curve. m values, n coefficients.

Source: Kim and Gu, Smoothing spline Gaussian regression: more scalable computation via efficient approximation, J. R.
Stat. Soc. B 66 (2004) 337.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array
from fusion_core.thermal.soak_noise import Blocks, Smoother, cells_of

LAMBDAS = np.logspace(-7, 7, 85)  # relative to what makes both terms of the criterion alike
INFLATED = 1.4
RIDGE = 1e-10  # of the mean diagonal: what neither values nor penalty determine is zero


@dataclass(frozen=True, eq=False)
class Penalised:
    """A fit."""

    coefficients: Array  # (n,): that of the least criterion
    operator: Array  # (n, m): takes y to the coefficients
    # (n, n): root root' is the covariance of the coefficients, where the values differ from a curve by noise of
    # variance 1 / w, up to one factor, which is found from them, and the curve is as smooth as the penalty has it
    root: Array


def penalised(B: Array, y: Array, w: Array, penalty: Array, lambdas: Array = LAMBDAS) -> Penalised:
    """Fit values y (m,) of weights w (m,) by columns B (m, n), and a penalty (n, n); the undetermined are zero."""
    (m, n), w = B.shape, w / np.mean(w)
    weighted = w[:, None] * B
    N = B.T @ weighted
    N[np.diag_indices(n)] += RIDGE * np.trace(N) / n
    P = penalty * (np.trace(N) / (np.trace(penalty) or 1.0))
    # with G'(N + P)G = I and G'PG = diag(e) every N + lambda P is diagonal: no more matrices to factor
    inverse = np.linalg.inv(np.linalg.cholesky(N + P))
    e, U = np.linalg.eigh(inverse @ P @ inverse.T)
    e, G = np.clip(e, 0.0, 1.0), inverse.T @ U
    gain = 1 / (1 - e + lambdas[:, None] * e)  # (lambdas, n)
    trace = gain @ (1 - e)
    coefficients = G @ (gain * (G.T @ (B.T @ (w * y)))).T  # (n, lambdas)
    squares = w @ (y[:, None] - B @ coefficients) ** 2
    free = m - INFLATED * trace
    best = int(np.argmin(np.where(free > 0, squares / np.where(free > 0, free, 1.0) ** 2, np.inf)))
    variance = squares[best] / max(m - trace[best], 1.0)
    operator = (G * gain[best]) @ (weighted @ G).T
    return Penalised(coefficients[:, best], operator, G * np.sqrt(variance * gain[best]))


@dataclass(frozen=True)
class Basis:
    """Curves whose combination c is a map: values(T (N,)) -> (N, q), and penalty (q, q) of roughness c' penalty c."""

    values: Callable[[Array], Array]
    penalty: Array


def smooth_lines(domain: tuple[float, float]) -> Basis:
    """Return straight lines between knots 1 K apart, at most 150 pieces, whose bends are penalised."""
    count = int(np.clip(np.ceil(domain[1] - domain[0]), 4, 150)) + 1
    knots = np.linspace(*domain, count)
    bends = np.diff(np.eye(count), n=2, axis=0)
    return Basis(lambda T: np.stack([np.interp(T, knots, row) for row in np.eye(count)], axis=1), bends.T @ bends)


def penalised_smoother(basis: Basis, T: Array, bias: Array) -> Smoother:
    """Return the response of penalised least squares to the noise of T (N,) and bias (N, d), by cross-validation."""
    cells = cells_of(T, bias)
    B = basis.values(cells.T)
    operators = [penalised(B, y, cells.n, basis.penalty).operator for y in cells.y.T]

    def smoother(blocks: Blocks, grid: Array, axis: int) -> Array:
        return np.asarray(basis.values(grid) @ (operators[axis] @ blocks.shares(cells.of_sample, len(cells.T))))

    return smoother
