"""The network of one axis: two hidden layers of h tanh neurons, its derivative with the weights, and its training.

m bins, p packed weights.

What a small network is trained with: Levenberg-Marquardt, and the integral of what it gives.

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
from fusion_core.contracts import Target
from fusion_plugins.thermal_maps.onnx_graph import Weights, forward

BINS: dict[Target, int] = {"bias": 600, "slope": 300}  # a node of the slope stands for each gap and half of it
_PRIOR = 3.0  # deviation of a weight of the scaled problem, where the samples leave it free


def train(
    T: Array, y: Array, variance: Array, neurons: int, starts: int, seed: int, target: Target = "bias"
) -> Weights:
    """Train the network of one axis by Levenberg-Marquardt from several random starts.

    T and y are scaled to the order of 1, and the weights have a normal prior there: without it a neuron may
    switch within a fraction of a kelvin to follow a few noisy samples, and the slope has a spike.

    Parameters
    ----------
    T, y, variance : (m,) arrays
        Temperature in degC, ascending; bias in rad/s, and the variance of the bias.
    neurons, starts, seed : int
        Size of each hidden layer, starts to try, and what makes them the same each time.
    target : "bias" or "slope"
        What the network gives.

    Returns
    -------
    Weights of the best start, from degC to rad/s (slope: to rad/s/K).
    """
    w = variance.min() / variance
    p, sigma = w / w.sum(), np.sqrt(variance.min() / w.sum())  # of the mean
    centre, half, mean = (T.max() + T.min()) / 2, np.ptp(T) / 2, p @ y
    deviation = max(np.sqrt(p @ (y - mean) ** 2), sigma)
    ridge = max(sigma / (deviation * _PRIOR), 1e-6)
    linearise = _problem((T - centre) / half, (y - mean) / deviation, p, neurons, target)
    rng = np.random.default_rng(seed)
    theta = search(linearise, [_start(rng, neurons) for _ in range(starts)], ridge)
    (W_1, a_1), hidden, (W_3, a_3) = unpack(theta, neurons)
    scale, shift = (deviation, mean) if target == "bias" else (deviation / half, 0.0)
    return [(W_1 / half, a_1 - W_1[0] * (centre / half)), hidden, (W_3 * scale, a_3 * scale + shift)]


def _problem(x: Array, y: Array, p: Array, h: int, target: Target) -> Linear:
    """Return the residuals (m,) and their derivative (m, p) as a function of the packed weights."""
    root = np.sqrt(p)
    nodes, integrate = between(x, 2 / BINS["slope"])

    def linearise(theta: Array) -> tuple[Array, Array]:
        if target == "bias":
            J = jacobian(theta, h, x)
        else:
            J = integrate(jacobian(theta, h, nodes))
            J = J - p @ J  # the constant that fits best
        J *= root[:, None]
        return J[:, -h - 1 :] @ theta[-h - 1 :] - root * y, J  # the last layer is linear

    return linearise


def _start(rng: np.random.Generator, h: int) -> Array:
    """Draw weights whose first neurons switch somewhere inside the range, some slowly and some abruptly."""
    steep = 10 ** rng.uniform(-0.3, 1.0, h) * rng.choice([-1.0, 1.0], h)
    return np.concatenate([steep, -steep * rng.uniform(-1, 1, h), rng.normal(size=h * (h + 2)), np.zeros(1)])


def unpack(theta: Array, h: int) -> Weights:
    """Return the layers of the packed weights (p,)."""
    W_1, a_1, W_2, a_2, W_3, a_3 = np.split(theta, np.cumsum([h, h, h * h, h, h]))
    return [(W_1.reshape(1, h), a_1), (W_2.reshape(h, h), a_2), (W_3.reshape(h, 1), a_3)]


def jacobian(theta: Array, h: int, x: Array) -> Array:
    """Return the derivative of the output with the packed weights (m, p), by back-propagation."""
    network = unpack(theta, h)
    hidden_1, hidden_2, _ = forward(network, x)
    J = np.ones((len(x), len(theta)))
    of_W_1, of_a_1, of_W_2, of_a_2, of_W_3, _ = np.split(J, np.cumsum([h, h, h * h, h, h]), axis=1)
    of_W_3[:] = hidden_2
    np.multiply(1 - hidden_2**2, network[2][0][:, 0], out=of_a_2)
    np.multiply(1 - hidden_1**2, of_a_2 @ network[1][0].T, out=of_a_1)
    np.multiply(x[:, None], of_a_1, out=of_W_1)
    of_W_2[:] = (hidden_1[:, :, None] * of_a_2[:, None, :]).reshape(len(x), h * h)
    return J


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
