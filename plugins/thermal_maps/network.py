"""A small network of temperature: two hidden layers of h tanh neurons, its derivatives, its training and its integral.

Levenberg-Marquardt trains it::

    minimise  |r(theta)|^2 + ridge^2 |theta|^2,    (J'J + ridge^2 I + lambda diag) step = -(J'r + ridge^2 theta)

The normal equations of some hundred weights are formed by one matrix product, which makes a step an order of
magnitude faster than a QR factorisation; the ridge and the damping keep them solvable. m bins, p packed weights.
Source: Marquardt, J. SIAM 11 (1963) 431; the largest diagonal met so far scales the damping, as in Moré (1978).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Target

Weights = list[tuple[Array, Array]]  # W (inputs, outputs) and a (outputs,) of each layer
Curve = Callable[[Array], Array]  # of T (N,), with d values (N, d)

BINS: dict[Target, int] = {"bias": 600, "slope": 300}  # a node of the slope stands for each gap and half of it
_PRIOR = 3.0  # deviation of a weight of the scaled problem, where the samples leave it free


def forward(network: Weights, T: Array) -> tuple[Array, Array, Array]:
    """Return the values of both hidden layers (N, h) and the output (N, d) at T (N,)."""
    (W_1, a_1), (W_2, a_2), (W_3, a_3) = network
    hidden_1 = np.tanh(T[:, None] * W_1 + a_1)
    hidden_2 = np.tanh(hidden_1 @ W_2 + a_2)
    return hidden_1, hidden_2, hidden_2 @ W_3 + a_3


def tangent(network: Weights, T: Array, domain: tuple[float, float], target: Target) -> Array:
    """Return the derivative (m, p) of the bias at T (m,) with each weight of a network of one output, by its size.

    Where the network gives the slope, its integral from the lower end of the domain answers, and a constant.
    """
    fine = T if target == "bias" else np.linspace(*domain, 2001)
    arrays = [array for layer in network for array in layer]
    sizes = [np.maximum(np.abs(array), max(1e-3 * float(np.abs(array).max()), 1e-300)) for array in arrays]
    theta, scale = (np.concatenate([array.ravel() for array in each]) for each in (arrays, sizes))
    J: Array = jacobian(theta, len(network[0][1]), fine) * scale  # columns of one scale
    if target == "bias":
        return J
    area = np.concatenate([np.zeros((1, J.shape[1])), np.cumsum((J[1:] + J[:-1]) / 2, axis=0)]) * (fine[1] - fine[0])
    at = np.stack([np.interp(T, fine, column) for column in area.T], axis=1)
    return np.column_stack([at, np.full(len(T), float(np.abs(at).max()) or 1.0)])


def answer(
    network: Weights, bins: tuple[Array, Array], grid: Array, domain: tuple[float, float], target: Target
) -> Array:
    """Return the derivative (G, m) of the bias on a grid (G,) with the means of bins, given by T (m,) and weight (m,).

    To first order about the trained weights, without the prior that training has.
    """
    T, root = bins[0], np.sqrt(bins[1])
    J, J_grid = (tangent(network, x, domain, target) for x in (T, grid))
    inverse = np.asarray(np.linalg.pinv(root[:, None] * J, rcond=1e-9), dtype=np.float64)
    return np.asarray(J_grid @ (inverse * root))


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
_MIN_GAIN = 1e-5  # relative gain of a step that counts as none
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
        lower, A_found, gradient_found = normal(theta + step)
        if not lower < cost:
            damping *= 4
            if damping > 1e12:  # no direction leads down
                break
            continue
        idle = idle + 1 if cost - lower < _MIN_GAIN * cost else 0
        theta, cost, A, gradient, damping = theta + step, lower, A_found, gradient_found, max(damping / 5, 1e-12)
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


def side_by_side(networks: list[Weights]) -> Weights:
    """Join networks of one output each into one of d outputs; they share T and nothing else."""
    from scipy.linalg import block_diag

    joined = [
        (block_diag(*(W for W, _ in layer)), np.concatenate([a for _, a in layer]))
        for layer in zip(*networks, strict=True)
    ]
    joined[0] = (joined[0][0].sum(axis=0, keepdims=True), joined[0][1])
    return joined


_GAUSS = np.polynomial.legendre.leggauss(5)
_EXACT = 1e-11  # error of an integral, relative to its largest value
_INTERVALS = (512, 1 << 16)  # first tried, and most


def antiderivative(slope: Curve, domain: tuple[float, float]) -> Curve:
    """Return the integral of a slope from the lower end of the domain.

    Gauss-Legendre sums on an even grid, and between its points the cubic with the slopes at both ends. The grid is
    made finer until the cubics are right half way as well, where they are worst.
    """
    from scipy.interpolate import CubicHermiteSpline

    def sums(left: Array, h: float) -> Array:
        nodes = (left[:, None] + h * (_GAUSS[0] + 1) / 2).ravel()
        values = slope(nodes).reshape(len(left), len(_GAUSS[0]), -1)
        return np.asarray(h / 2 * np.einsum("knd,n->kd", values, _GAUSS[1]), dtype=np.float64)

    count, most = _INTERVALS
    while True:
        grid = np.linspace(*domain, count + 1)
        h = (domain[1] - domain[0]) / count
        first, second = sums(grid[:-1], h / 2), sums(grid[:-1] + h / 2, h / 2)
        values = np.concatenate([np.zeros((1, first.shape[1])), np.cumsum(first + second, axis=0)])
        curve = CubicHermiteSpline(grid, values, slope(grid))
        error = np.abs(curve(grid[:-1] + h / 2) - values[:-1] - first).max(axis=0)
        if np.all(error <= _EXACT * np.abs(values).max(axis=0)) or count >= most:
            return lambda T: np.asarray(curve(T), dtype=np.float64)
        count *= 2
