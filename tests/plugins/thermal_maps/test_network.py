import numpy as np
import pytest
from soaks import smooth, soak

from fusion_plugins.thermal_maps import network
from fusion_plugins.thermal_maps.onnx_network import OnnxNetwork


@pytest.mark.parametrize("h", [1, 2, 5])
def test_the_jacobian_of_the_training_is_the_derivative(h):
    from scipy.optimize import approx_fprime

    rng = np.random.default_rng(h)
    x, theta = np.linspace(-1, 1, 7), rng.normal(size=h * h + 4 * h + 1)

    def output(theta):
        return network.forward(network.unpack(theta, h), x)[-1][:, 0]

    expected = approx_fprime(theta, output, 1e-7)
    np.testing.assert_allclose(network.jacobian(theta, h, x), expected, atol=1e-5)


def test_the_training_is_the_same_each_time_for_a_seed():
    T, bias = soak(smooth, N=2000)
    first, second = (OnnxNetwork(starts=1, seed=5).fit(T, bias, {}) for _ in range(2))
    assert first.graph == second.graph
