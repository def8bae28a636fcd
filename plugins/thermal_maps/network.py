"""The network of one axis: two hidden layers of h tanh neurons, its derivative with the weights, and its training.

m bins, p packed weights.
"""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Target
from fusion_plugins.thermal_maps.onnx_graph import Weights, forward
from fusion_plugins.thermal_maps.training import Linear, between, search

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
