"""What a small network is trained with: Levenberg-Marquardt, and the integral of what it gives.

::

    minimise  |r(theta)|^2 + ridge^2 |theta|^2,    (J'J + ridge^2 I + lambda diag) step = -(J'r + ridge^2 theta)

The normal equations of some hundred weights are formed by one matrix product, which makes a step an order of
magnitude faster than a QR factorisation; the ridge and the damping keep them solvable. m residuals, p weights.
Source: Marquardt, J. SIAM 11 (1963) 431; the largest diagonal met so far scales the damping, as in Moré (1978).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from fusion_core.chunk import Array

Linear = Callable[[Array], tuple[Array, Array]]  # theta (p,) to r (m,) and its derivative J (m, p)

_FIRST = 40  # steps of every start
_LAST = (120, 600)  # of the best ones: fewest and most; where there are many weights, all that many steps find is noise
_WORK = 15_000  # steps times weights
_FINALISTS = 2
_ENOUGH = 1e-5  # relative gain of a step that counts as none
_IDLE = 3  # steps without gain that end the search


def minimise(linearise: Linear, theta: Array, ridge: float, steps: int) -> tuple[Array, float]:
    """Return weights (p,) that make the sum of squares small, and that sum, after at most `steps` steps."""

    def normal(theta: Array) -> tuple[float, Array, Array]:
        r, J = linearise(theta)
        A = J.T @ J
        A[np.diag_indices_from(A)] += ridge**2
        return float(r @ r + ridge**2 * (theta @ theta)), A, J.T @ r + ridge**2 * theta

    cost, A, gradient = normal(theta)
    scale, damping, idle = A.diagonal().copy(), 1e-2, 0
    for _ in range(steps):
        scale = np.maximum(scale, A.diagonal())
        step = -np.linalg.solve(A + np.diag(damping * scale), gradient)
        found, A_found, gradient_found = normal(theta + step)
        if not found < cost:
            damping *= 4
            if damping > 1e12:  # no direction leads down
                break
            continue
        idle = idle + 1 if cost - found < _ENOUGH * cost else 0
        theta, cost, A, gradient, damping = theta + step, found, A_found, gradient_found, max(damping / 5, 1e-12)
        if idle == _IDLE:
            break
    return theta, cost


def between(x: Array, width: float) -> tuple[Array, Callable[[Array], Array]]:
    """Return the nodes of a two-point Gauss rule over the gaps of x (m,), and the integral from x_0 to each x.

    Gaps much wider than `width` are divided. The integral takes values (q, p) at the q nodes to (m, p).
    """
    gaps = np.diff(x)
    pieces = np.ceil(gaps / (1.5 * width)).astype(np.intp)
    step = np.repeat(gaps / pieces, pieces)
    last = np.cumsum(pieces) - 1
    left = x[0] + np.cumsum(step) - step
    nodes = (left[:, None] + step[:, None] * (0.5 + np.array([-0.5, 0.5]) / np.sqrt(3))).ravel()

    def integrate(values: Array) -> Array:
        area = (values[::2] + values[1::2]) * (step / 2)[:, None]
        return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(area, axis=0)[last]])

    return nodes, integrate


def search(linearise: Linear, starts: Iterable[Array], ridge: float) -> Array:
    """Return the best weights: every start is followed for some steps, the best ones to the end."""
    tried = [minimise(linearise, theta, ridge, _FIRST) for theta in starts]
    best = sorted(tried, key=lambda result: result[1])[:_FINALISTS]
    steps = int(np.clip(_WORK // len(best[0][0]), *_LAST))
    finished = [minimise(linearise, theta, ridge, steps) for theta, _ in best]
    return min(finished, key=lambda result: result[1])[0]
