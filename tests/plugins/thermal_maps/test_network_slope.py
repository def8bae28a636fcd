"""Networks of the derivative, against curves whose derivative is known and against scipy's quadrature."""

import json

import numpy as np
import pytest
from scipy.integrate import quad

from fusion_core.errors import MapError, OutsideDomain
from fusion_plugins.thermal_maps.network import antiderivative, between, minimise, search
from fusion_plugins.thermal_maps.onnx_graph import KEY
from fusion_plugins.thermal_maps.onnx_network import OnnxNetwork

NOISE = 3e-5  # rad/s, of a sample
SLOPE = OnnxNetwork(target="slope", neurons=3)


def curve(T):
    """Two axes made of tanh, rad/s."""
    return np.stack([2e-3 + 4e-4 * np.tanh((T - 20) / 6), 5e-4 * np.tanh((T + 5) / 30) - 2e-4 * np.tanh(T / 9)], axis=1)


def derivative(T):
    x, y, z = 4e-4 / 6 / np.cosh((T - 20) / 6) ** 2, 5e-4 / 30 / np.cosh((T + 5) / 30) ** 2, np.cosh(T / 9) ** -2
    return np.stack([x, y - 2e-4 / 9 * z], axis=1)


def soak(N=40_000, noise=NOISE, seed=0):
    rng = np.random.default_rng(seed)
    T = rng.uniform(-20, 50, N)
    return T, curve(T) + noise * rng.normal(size=(N, 2))


def rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


@pytest.fixture(scope="module")
def fitted():
    return SLOPE.fit(*soak(), {"recording": "soak.csv"})


def test_the_derivative_is_found(fitted):
    T = np.linspace(-19.5, 49.5, 300)
    assert np.all(rms(fitted.slope(T) - derivative(T)) < 0.02 * np.ptp(derivative(T), axis=0))
    # 40,000 samples, 28 weights and a constant: noise * sqrt(29 / 40,000) = 0.027 noise
    assert np.all(rms(fitted.bias(T) - curve(T)) < 0.04 * NOISE)


def test_the_mean_residual_is_zero_and_the_record_holds_the_rms(fitted):
    T, bias = soak()
    left = bias - fitted.bias(T)
    np.testing.assert_allclose(left.mean(axis=0), 0, atol=1e-12 * np.abs(bias).max())
    np.testing.assert_allclose(fitted.record.residual, rms(left), rtol=1e-9)


def test_the_graph_gives_the_slope_itself(fitted):
    import onnxruntime

    T = np.linspace(-19, 49, 50)
    session = onnxruntime.InferenceSession(fitted.graph, providers=["CPUExecutionProvider"])
    found = session.run(None, {"temperature": T[:, None]})[0]
    np.testing.assert_allclose(fitted.slope(T), found, rtol=0, atol=1e-12 * np.abs(found).max())


def test_the_bias_is_the_integral_of_the_slope_by_adaptive_quadrature(fitted):
    low, high = fitted.domain
    at = np.linspace(low, high, 9)
    found = fitted.bias(at) - fitted.bias(at[:1])
    for axis in range(2):
        expected = [
            quad(lambda T, k=axis: fitted.slope(np.array([T]))[0, k], low, stop, epsrel=1e-13, limit=200)[0]
            for stop in at
        ]
        np.testing.assert_allclose(found[:, axis], expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("width", [20.0, 0.3])
def test_an_abrupt_slope_is_integrated_as_well(width):
    integral = antiderivative(lambda T: np.cosh((T[:, None] - 7) / width) ** -2.0, (-20.0, 50.0))
    T = np.random.default_rng(0).uniform(-20, 50, 1000)
    expected = width * (np.tanh((T - 7) / width) - np.tanh(-27 / width))
    np.testing.assert_allclose(integral(T)[:, 0], expected, rtol=0, atol=1e-9 * expected.max())


def test_slope_and_bias_belong_together(fitted):
    T, h = np.linspace(-19, 49, 301), 1e-3
    difference = (fitted.bias(T + h) - fitted.bias(T - h)) / (2 * h)
    np.testing.assert_allclose(fitted.slope(T), difference, atol=1e-6 * np.max(np.abs(difference)))


def test_a_file_comes_back_as_it_was(fitted, tmp_path):
    fitted.save(tmp_path / "map.onnx")
    found = OnnxNetwork().read(tmp_path / "map.onnx")  # the file says what it is, not the settings
    T = np.linspace(*fitted.domain, 77)
    assert found.target == "slope"
    assert found.record == fitted.record
    np.testing.assert_array_equal(found.bias(T), fitted.bias(T))
    np.testing.assert_array_equal(found.slope(T), fitted.slope(T))
    with pytest.raises(OutsideDomain):
        found.bias(np.array([60.0]))
    held = OnnxNetwork(outside="clamp").read(tmp_path / "map.onnx")
    np.testing.assert_array_equal(held.bias(np.array([99.0])), fitted.bias(np.array([fitted.domain[1]])))
    np.testing.assert_array_equal(held.slope(np.array([99.0])), 0)


def change(fitted, path, update):
    import onnx

    model = onnx.load_model_from_string(fitted.graph)
    entry = next(entry for entry in model.metadata_props if entry.key == KEY)
    content = json.loads(entry.value) | update
    entry.value = json.dumps({key: value for key, value in content.items() if value is not None})
    path.write_bytes(model.SerializeToString())
    return path


def test_a_file_without_a_target_gives_the_bias(tmp_path):
    fitted = OnnxNetwork(neurons=1, starts=1).fit(*soak(2000), {})
    path = change(fitted, tmp_path / "old.onnx", {"target": None})
    found = OnnxNetwork(target="slope").read(path)
    assert found.target == "bias"
    np.testing.assert_array_equal(found.bias(np.array([20.0])), fitted.bias(np.array([20.0])))


@pytest.mark.parametrize(
    ("update", "match"),
    [
        ({"constant": None}, r"target slope has None constants, not 2"),
        ({"constant": [0.0]}, r"target slope has 1 constants, not 2"),
        ({"target": "bias"}, r"target bias has 2 constants, not None"),
        ({"target": "curve"}, r"is damaged at target"),
        ({"constant": [0.0, "x"]}, r"is damaged at constant.1"),
    ],
)
def test_a_damaged_record_is_refused(fitted, update, match, tmp_path):
    path = change(fitted, tmp_path / "map.onnx", update)
    with pytest.raises(MapError, match=f"^onnx_network: map file .*map.onnx .*{match}.*; refit it"):
        OnnxNetwork().read(path)


def test_the_training_is_the_same_each_time_for_a_seed():
    T, bias = soak(3000)
    first, second = (SLOPE.model_copy(update={"starts": 2, "seed": 4}).fit(T, bias, {}) for _ in range(2))
    assert first.graph == second.graph


@pytest.mark.parametrize("value", [0.0, 1e-4])
def test_a_constant_bias_has_no_slope(value):
    T = np.linspace(0, 40, 400)
    found = SLOPE.fit(T, np.full((400, 1), value), {})
    np.testing.assert_allclose(found.bias(T), value, atol=1e-12)
    np.testing.assert_allclose(found.slope(T), 0, atol=1e-12)


def test_steps_of_a_thermometer_and_holes_are_bridged():
    T, bias = soak()
    keep = (T < 2) | (T > 12)
    found = SLOPE.fit(np.round(T[keep]), bias[keep], {})
    at = np.concatenate([np.linspace(-18, 0, 40), np.linspace(13, 48, 60)])
    assert np.all(rms(found.slope(at) - derivative(at)) < 0.05 * np.ptp(derivative(at), axis=0))


# The parts


def test_gaps_are_integrated_whatever_their_width():
    x = np.array([-1.0, -0.99, -0.9, 0.0, 1.0])
    nodes, integrate = between(x, 0.01)
    found = integrate(np.stack([np.exp(nodes), nodes**3], axis=1))
    np.testing.assert_allclose(found, np.stack([np.exp(x) - np.exp(-1), (x**4 - 1) / 4], axis=1), atol=1e-9)


def test_minimise_solves_a_ridge_regression_and_rosenbrock():
    rng = np.random.default_rng(0)
    A, y = rng.normal(size=(30, 4)), rng.normal(size=30)
    theta, cost = minimise(lambda theta: (A @ theta - y, A), np.zeros(4), 0.7, 100)
    expected = np.linalg.solve(A.T @ A + 0.49 * np.eye(4), A.T @ y)
    np.testing.assert_allclose(theta, expected, rtol=1e-6)
    assert cost == pytest.approx(np.sum((A @ expected - y) ** 2) + 0.49 * expected @ expected)

    def rosenbrock(theta):
        a, b = theta
        return np.array([10 * (b - a**2), 1 - a]), np.array([[-20 * a, 10.0], [-1.0, 0.0]])

    found = search(rosenbrock, [np.array([-1.2, 1.0]), np.array([9.0, -7.0])], 1e-9)
    np.testing.assert_allclose(found, 1, atol=1e-6)


def test_a_record_that_is_there_twice_is_refused(tmp_path):
    import onnx

    model = onnx.load_model_from_string(OnnxNetwork(neurons=1, starts=1).fit(*soak(2000), {}).graph)
    model.metadata_props.add(key=KEY, value=next(entry.value for entry in model.metadata_props if entry.key == KEY))
    (tmp_path / "twice.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(MapError, match="has a key of its metadata_props twice"):
        OnnxNetwork().read(tmp_path / "twice.onnx")
