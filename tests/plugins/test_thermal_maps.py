import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from fusion_core.contracts import MapFile, MapRecord
from fusion_core.errors import (
    BadValue,
    EmptyRecording,
    MapError,
    OutsideDomain,
    SingularFit,
    SwingTooSmall,
)
from fusion_plugins.thermal_maps import common, network, onnx_graph
from fusion_plugins.thermal_maps.onnx_network import OnnxMap, OnnxNetwork
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

NOISE = 1e-4  # rad/s, of a sample
DEG_H = np.degrees(1) * 3600
ALL = [Polynomial(), Spline(), OnnxNetwork(starts=3)]
kinds = pytest.mark.parametrize("maps", ALL, ids=lambda maps: maps.kind)


def smooth(T):
    """A curve of 3 axes that all kinds can follow, about 1e-3 rad/s over -20 to 50 degC."""
    x = (T - 15) / 35
    return 1e-3 * np.stack([0.3 + x - 0.5 * x**2, 0.8 * x**3 - x, 0.2 * x + 0.4 * x**2], axis=1)


def abrupt(T):
    """A smooth curve with a change by 6e-4 rad/s within about 2 K at 22 degC."""
    return (1e-5 * T + 3e-4 * np.tanh((T - 22) / 1.0))[:, None]


def soak(curve, N=20_000, seed=0, noise=NOISE, low=-20.0, high=50.0):
    rng = np.random.default_rng(seed)
    T = rng.uniform(low, high, N)
    bias = curve(T)
    return T, bias + noise * rng.normal(size=bias.shape)


def rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


@pytest.fixture(scope="module")
def fitted():
    return {maps.kind: maps.fit(*soak(smooth), {"recording": "soak.csv"}) for maps in ALL}


# Recovery


@pytest.mark.parametrize("order", [1, 2, 3, 7, 15])
def test_a_polynomial_is_recovered(order):
    rng = np.random.default_rng(order)
    truth = np.polynomial.Chebyshev(rng.normal(size=order + 1), domain=[-25, 60])
    T = np.linspace(-20, 50, 500)
    found = Polynomial(order=order).fit(T, truth(T)[:, None], {})
    np.testing.assert_allclose(found.bias(T)[:, 0], truth(T), atol=1e-10 * np.ptp(truth(T)))
    np.testing.assert_allclose(found.slope(T)[:, 0], truth.deriv()(T), atol=1e-9 * np.ptp(truth.deriv()(T)))


def test_least_squares_and_its_deviation_are_those_of_numpy():
    T, bias = soak(smooth, N=150_000)  # more than one slab
    found = Polynomial(order=3).fit(T, bias, {})
    at, T_0 = np.linspace(*found.domain, 50), 15.0
    for axis in range(3):
        c, covariance = np.polyfit(T, bias[:, axis], 3, cov=True)
        np.testing.assert_allclose(found.bias(at)[:, axis], np.polyval(c, at), atol=1e-12)
        V = np.vander(at, 4) - np.vander([T_0], 4)
        spread = np.einsum("Nm,mn,Nn->N", V, covariance, V)
        # estimated from blocks of samples, beside a walk that is not there
        np.testing.assert_allclose(found.sigma(at, T_0)[:, axis], np.sqrt(spread), rtol=0.2, atol=1e-9)


@kinds
def test_a_smooth_curve_is_found_far_below_the_noise(maps, fitted):
    T = np.linspace(-19.9, 49.9, 400)
    # 20,000 samples, at most 15 free parameters: noise * sqrt(15 / 20,000) = 0.027 noise
    assert np.all(rms(fitted[maps.kind].bias(T) - smooth(T)) < 0.04 * NOISE)


@kinds
def test_the_residual_is_the_rms_over_all_samples(maps, fitted):
    T, bias = soak(smooth)
    record = fitted[maps.kind].record
    np.testing.assert_allclose(record.residual, rms(bias - fitted[maps.kind].bias(T)), rtol=1e-9)
    np.testing.assert_allclose(record.residual, NOISE, rtol=0.02)
    assert record.samples == len(T)
    assert record.domain == (T.min(), T.max())
    assert record.unit == "rad/s"
    assert record.provenance == {"recording": "soak.csv"}


def test_the_network_recovers_a_network():
    def network(T):
        x = (T - 15) / 35
        hidden = np.tanh(np.stack([3 * x - 1, -2 * x - 0.5], axis=1))
        return 1e-3 * (np.tanh(hidden @ [[1.5, -0.7], [0.6, 1.2]] + [0.2, -0.3]) @ [[0.8], [-1.1]] + 0.4)

    T, bias = soak(network, noise=0.0)
    found = OnnxNetwork(starts=6).fit(T, bias, {})
    assert rms(found.bias(T) - bias) < 2e-3 * np.ptp(bias)  # the bins are 0.12 K wide
    T, bias = soak(network)
    found = OnnxNetwork(starts=6).fit(T, bias, {})
    at = np.linspace(*found.domain, 300)
    assert rms(found.bias(at) - network(at)) < 0.04 * NOISE


@pytest.mark.parametrize("maps", [Spline(), OnnxNetwork(starts=6)], ids=lambda maps: maps.kind)
def test_an_abrupt_change_is_followed_where_a_cubic_cannot(maps):
    T, bias = soak(abrupt, N=100_000)
    at = np.linspace(-19.9, 49.9, 700)
    error = rms(maps.fit(T, bias, {}).bias(at) - abrupt(at))
    assert error < 0.05 * NOISE
    assert rms(Polynomial().fit(T, bias, {}).bias(at) - abrupt(at)) > 10 * error


def test_a_spline_without_noise_follows_the_change_closely():
    T, bias = soak(abrupt, noise=0.0)
    at = np.linspace(-19.9, 49.9, 700)
    assert rms(Spline().fit(T, bias, {}).bias(at) - abrupt(at)) < 0.01 * np.ptp(bias)


def test_a_spline_passes_a_hole_in_the_soak_smoothly_and_says_so():
    T, bias = soak(smooth)
    keep = (T < 10) | (T > 25)
    found = Spline().fit(T[keep], bias[keep], {})
    inside, beside = np.linspace(12, 23, 50), np.linspace(-15, 8, 50)
    assert np.all(rms(found.bias(inside) - smooth(inside)) < NOISE)
    assert np.all(found.sigma(inside).mean(axis=0) > 2 * found.sigma(beside).mean(axis=0))
    ((low, high),) = found.record.error.holes
    assert (low, high) == (T[T < 10].max(), T[T > 25].min())


def test_a_spline_smoothed_without_end_is_the_weighted_straight_line():
    T, bias = soak(smooth)
    found = Spline(smoothing=1e9).fit(T, bias, {})
    at = np.linspace(*found.domain, 50)
    assert np.all(np.ptp(found.slope(at), axis=0) < 2e-3 * np.ptp(np.gradient(smooth(at), at, axis=0), axis=0))
    line = Polynomial(order=1).fit(T, bias, {})
    np.testing.assert_allclose(found.bias(T), line.bias(T), atol=0.05 * NOISE)


def test_a_long_stay_does_not_outweigh_the_rest():
    """The bias wanders by 2e-5 rad/s between bins: a hundred times more samples make no bin that much better."""
    rng = np.random.default_rng(3)
    count, sigma_b = 100, 2e-5
    centres = np.arange(count) + 0.5
    n = np.where(np.arange(count) % 7 == 0, 20_000, 200)
    wander = sigma_b * rng.normal(size=count)
    T = np.repeat(centres, n)
    T[0], T[-1] = 0.0, float(count)
    bias = np.repeat(wander, n) + NOISE * rng.normal(size=len(T))
    bins = common.bin_samples(T, bias[:, None], count)
    expected = NOISE**2 / n + sigma_b**2
    assert np.all(bins.variance[:, 0] / expected < 2)
    assert np.all(bins.variance[:, 0] / expected > 0.5)


@kinds
def test_a_thermometer_in_whole_degrees_is_enough(maps):
    T, bias = soak(smooth)
    found = maps.fit(np.round(T), bias, {})
    at = np.arange(-18.0, 49.0)
    # within a whole degree the curve bends by less than 1e-6 rad/s
    assert np.all(rms(found.bias(at) - smooth(at)) < 0.05 * NOISE)
    step = 1e-3 / 35 * np.max(np.abs(np.diff(smooth(at), axis=0) / 1e-3 * 35), axis=0)
    slope = (smooth(at + 0.5) - smooth(at - 0.5)) / 1.0
    assert np.all(rms(found.slope(at) - slope) < 0.1 * step)


# Laws


@kinds
def test_slope_is_the_derivative(maps, fitted):
    low, high = fitted[maps.kind].domain
    T, h = np.linspace(low + 0.1, high - 0.1, 301), 1e-3
    found = fitted[maps.kind]
    difference = (found.bias(T + h) - found.bias(T - h)) / (2 * h)
    np.testing.assert_allclose(found.slope(T), difference, atol=1e-6 * np.max(np.abs(difference)))


@settings(max_examples=30, deadline=None)
@given(
    order=st.integers(1, 15),
    low=st.floats(-60, 20),
    swing=st.floats(3, 150),
    seed=st.integers(0, 1000),
)
def test_slope_is_the_derivative_of_any_polynomial(order, low, swing, seed):
    rng = np.random.default_rng(seed)
    T = np.linspace(low, low + swing, 200)
    found = Polynomial(order=order).fit(T, rng.normal(size=(200, 2)), {})
    h = swing * 1e-5
    at = T[5:-5]
    difference = (found.bias(at + h) - found.bias(at - h)) / (2 * h)
    np.testing.assert_allclose(found.slope(at), difference, atol=1e-5 * np.max(np.abs(difference)))


@kinds
def test_the_order_of_the_samples_does_not_matter(maps, fitted):
    T, bias = soak(smooth)
    k = np.random.default_rng(9).permutation(len(T))
    found = maps.fit(T[k], bias[k], {})
    at = np.linspace(*found.domain, 200)
    np.testing.assert_allclose(found.bias(at), fitted[maps.kind].bias(at), atol=1e-4 * NOISE)


@kinds
@pytest.mark.parametrize("axes", [[0], [2, 1], [0, 1, 2]])
def test_each_axis_is_fitted_by_itself(maps, axes, fitted):
    T, bias = soak(smooth)
    found = maps.fit(T, bias[:, axes], {})
    at = np.linspace(*found.domain, 100)
    for of_map in (found.bias, found.slope, found.sigma):
        assert of_map(at).shape == (100, len(axes))
    np.testing.assert_allclose(found.bias(at), fitted[maps.kind].bias(at)[:, axes], atol=1e-4 * NOISE)


@kinds
def test_any_split_of_the_samples_gives_the_same(maps, fitted):
    T = np.linspace(-19.9, 49.9, 101)
    for of_map in (fitted[maps.kind].bias, fitted[maps.kind].slope, fitted[maps.kind].sigma):
        whole = of_map(T)
        parts = np.concatenate([of_map(T[:1]), of_map(T[1:1]), of_map(T[1:38]), of_map(T[38:])])
        np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-12 * np.max(np.abs(whole)))


@kinds
def test_beyond_the_domain_a_map_refuses_or_holds(maps, fitted, tmp_path):
    found = fitted[maps.kind]
    low, high = found.domain
    for of_map in (found.bias, found.slope):
        with pytest.raises(OutsideDomain, match=rf"{maps.kind}: T = 60 degC .* set outside: clamp or tangent"):
            of_map(np.array([20.0, 60.0]))
    # how sure the curve is can be told anywhere: less and less
    assert np.all(np.diff(found.sigma(high + np.array([0.0, 1.0, 10.0])), axis=0) > 0)
    found.save(tmp_path / "map")
    held = maps.model_copy(update={"outside": "clamp"}).read(tmp_path / "map")
    np.testing.assert_array_equal(held.bias(np.array([-80.0, 99.0])), found.bias(np.array([low, high])))
    np.testing.assert_array_equal(held.slope(np.array([-80.0, 99.0])), 0)


# Files


@kinds
def test_a_saved_map_is_the_same_map(maps, fitted, tmp_path):
    path = tmp_path / f"map{maps.suffix}"
    fitted[maps.kind].save(path)
    found = maps.model_copy(update={"path": path}).load()
    T = np.linspace(*found.domain, 1000)
    for method in ("bias", "slope", "sigma"):
        np.testing.assert_array_equal(getattr(found, method)(T), getattr(fitted[maps.kind], method)(T))
    assert found.record == fitted[maps.kind].record
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_the_numbers_in_a_polynomials_file_are_si(fitted, tmp_path):
    fitted["polynomial"].save(tmp_path / "map.json")
    data = json.loads((tmp_path / "map.json").read_text())
    T = np.linspace(-19, 49, 30)
    assert data["record"]["unit"] == "rad/s"
    for axis, c in enumerate(np.transpose(data["coefficients"])):
        curve = np.polynomial.Chebyshev(c, domain=data["record"]["domain"])
        np.testing.assert_allclose(curve(T), smooth(T)[:, axis], atol=0.1 * NOISE)


def test_the_numbers_in_a_splines_file_are_si(fitted, tmp_path):
    from scipy.interpolate import splev

    fitted["spline"].save(tmp_path / "map.json")
    data = json.loads((tmp_path / "map.json").read_text())
    T = np.linspace(-19, 49, 30)
    low, high = data["record"]["domain"]
    n = len(data["coefficients"])
    knots = low + (high - low) / (n - 3) * np.arange(-3, n + 1)
    for axis, c in enumerate(np.transpose(data["coefficients"])):
        np.testing.assert_allclose(splev(T, (knots, c, 3)), smooth(T)[:, axis], atol=0.1 * NOISE)


def test_the_onnx_file_runs_anywhere_in_degc_and_rad_s(fitted, tmp_path):
    import onnx
    import onnxruntime

    fitted["onnx_network"].save(tmp_path / "map.onnx")
    model = onnx.load(tmp_path / "map.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert [d.dim_value for d in model.graph.output[0].type.tensor_type.shape.dim][1:] == [3]
    record = json.loads({p.key: p.value for p in model.metadata_props}["driftlab_map"])["record"]
    assert record["unit"] == "rad/s"
    assert record["provenance"] == {"recording": "soak.csv"}
    session = onnxruntime.InferenceSession(tmp_path / "map.onnx", providers=["CPUExecutionProvider"])
    T = np.linspace(-19, 49, 30)
    (result,) = session.run(None, {"temperature": T[:, None]})
    assert result.dtype == np.float64
    np.testing.assert_allclose(result, smooth(T), atol=0.1 * NOISE)


def test_the_axes_of_the_onnx_file_do_not_hear_of_each_other(fitted):
    import onnx

    graph = onnx.load_model_from_string(fitted["onnx_network"].graph).graph
    W = {i.name: onnx.numpy_helper.to_array(i) for i in graph.initializer}
    hidden = next(w for w in W.values() if w.shape == (6, 6))
    last = next(w for w in W.values() if w.shape == (6, 3))
    assert not np.any(hidden[np.kron(np.eye(3), np.ones((2, 2))) == 0])
    assert not np.any(last[np.kron(np.eye(3), np.ones((2, 1))) == 0])


# The network's own parts


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_graph_agrees_with_scikit_learn(d):
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    T = np.linspace(-2, 2, 80)
    y = np.stack([np.sin(T + axis) for axis in range(d)], axis=1)
    mlp = MLPRegressor(hidden_layer_sizes=(5, 4), activation="tanh", solver="lbfgs", max_iter=15, random_state=0)
    with pytest.warns(ConvergenceWarning):
        mlp.fit(T[:, None], y if d > 1 else y[:, 0])
    record = MapRecord(kind="onnx_network", domain=(-2.0, 2.0), residual=(0.1,) * d, samples=80)
    weights = list(zip(mlp.coefs_, mlp.intercepts_, strict=True))
    found = OnnxMap(record, onnx_graph.export(weights, record), "a map")
    np.testing.assert_allclose(found.bias(T), mlp.predict(T[:, None]).reshape(80, d), rtol=0, atol=1e-14)
    h = 1e-4
    difference = (mlp.predict(T[:, None] + h) - mlp.predict(T[:, None] - h)).reshape(80, d) / (2 * h)
    np.testing.assert_allclose(found.slope(T), difference, atol=1e-7)


@pytest.mark.parametrize("h", [1, 2, 5])
def test_the_jacobian_of_the_training_is_the_derivative(h):
    from scipy.optimize import approx_fprime

    rng = np.random.default_rng(h)
    x, theta = np.linspace(-1, 1, 7), rng.normal(size=h * h + 4 * h + 1)

    def output(theta):
        return onnx_graph.forward(network.unpack(theta, h), x)[-1][:, 0]

    expected = approx_fprime(theta, output, 1e-7)
    np.testing.assert_allclose(network.jacobian(theta, h, x), expected, atol=1e-5)


def test_the_training_is_the_same_each_time_for_a_seed():
    T, bias = soak(smooth, N=2000)
    first, second = (OnnxNetwork(starts=1, seed=5).fit(T, bias, {}) for _ in range(2))
    assert first.graph == second.graph


def test_the_network_makes_one_session(fitted):
    found = fitted["onnx_network"]
    found.bias(np.array([20.0]))
    session = found._session
    found.bias(np.array([21.0]))
    assert found._session is session


# ONNX files of other hands


def of_other_hands(path, nodes, initializers, *, dtype=np.float64, inputs=1, d=3, record=True):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    element = {np.float64: TensorProto.DOUBLE, np.float32: TensorProto.FLOAT, np.int64: TensorProto.INT64}[dtype]
    graph = helper.make_graph(
        nodes,
        "other",
        [helper.make_tensor_value_info(f"T{k or ''}", element, [None, 1]) for k in range(inputs)],
        [helper.make_tensor_value_info("b", element, [None, None])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in initializers.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if record:
        text = MapFile(
            record=MapRecord(kind="onnx_network", domain=(-10.0, 50.0), residual=(1e-5,) * d, samples=9)
        ).model_dump_json()
        model.metadata_props.add(key="driftlab_map", value=text)
    path.write_bytes(model.SerializeToString())
    onnx.checker.check_model(model)
    return path


def gemm_chain(dtype=np.float64):
    from onnx import helper

    rng = np.random.default_rng(1)
    W, a, V, c = (
        rng.normal(size=size).astype(dtype) * scale
        for size, scale in [((4, 1), 0.05), (4, 1), ((4, 3), 1e-3), (3, 1e-3)]
    )
    nodes = [
        helper.make_node("Gemm", ["T", "W", "a"], ["g"], transB=1, beta=0.5),
        helper.make_node("Tanh", ["g"], ["h"]),
        helper.make_node("MatMul", ["h", "V"], ["m"]),
        helper.make_node("Add", ["c", "m"], ["b"]),
    ]
    arrays = {name: np.asarray(v, dtype=dtype) for name, v in zip("WaVc", (W, a, V, c), strict=True)}

    def expected(T):
        return np.tanh(T[:, None] @ W.T + 0.5 * a) @ V + c

    return nodes, arrays, expected


@pytest.mark.parametrize(("dtype", "atol"), [(np.float64, 1e-15), (np.float32, 1e-8)])
def test_a_chain_of_other_hands_gives_bias_and_slope(dtype, atol, tmp_path):
    nodes, arrays, expected = gemm_chain(dtype)
    found = OnnxNetwork().read(of_other_hands(tmp_path / "other.onnx", nodes, arrays, dtype=dtype))
    T, h = np.linspace(-9, 49, 40), 1e-3
    np.testing.assert_allclose(found.bias(T), expected(T), rtol=0, atol=atol)
    np.testing.assert_allclose(found.slope(T), (expected(T + h) - expected(T - h)) / (2 * h), atol=1e-9)


def test_a_graph_that_gives_3n_by_1_is_reshaped(tmp_path):
    from onnx import helper

    nodes, arrays, expected = gemm_chain()
    nodes[-1].output[0] = "before"
    nodes.append(helper.make_node("Reshape", ["before", "shape"], ["b"]))
    path = of_other_hands(tmp_path / "other.onnx", nodes, {**arrays, "shape": np.array([-1, 1])})
    T = np.linspace(-9, 49, 40)
    np.testing.assert_allclose(OnnxNetwork().read(path).bias(T), expected(T), rtol=0, atol=1e-15)
    assert OnnxNetwork().read(path).slope(T).shape == (40, 3)


def test_a_graph_that_is_no_chain_has_a_bias_and_no_slope(tmp_path):
    from onnx import helper

    nodes, arrays, _ = gemm_chain()
    nodes[1] = helper.make_node("Sigmoid", ["g"], ["h"])
    found = OnnxNetwork().read(of_other_hands(tmp_path / "other.onnx", nodes, arrays))
    assert found.bias(np.array([20.0])).shape == (1, 3)
    with pytest.raises(MapError, match=r"other.onnx has the node Sigmoid\(g\), expected a chain .* export it"):
        found.slope(np.array([20.0]))


def test_a_hidden_reshape_does_not_make_a_wrong_slope(tmp_path):
    from onnx import helper

    nodes, arrays, _ = gemm_chain()
    nodes.insert(1, helper.make_node("Cast", ["g"], ["i"], to=7))  # rounds to whole numbers
    nodes.insert(2, helper.make_node("Cast", ["i"], ["j"], to=11))
    nodes[3].input[0] = "j"
    found = OnnxNetwork().read(of_other_hands(tmp_path / "other.onnx", nodes, arrays))
    with pytest.raises(MapError, match="is not the chain of its layers"):
        found.slope(np.array([20.0]))


# Errors

T_ok = np.linspace(0, 40, 400)
b_ok = np.stack([1e-4 * np.sin(T_ok / 9), 1e-6 * T_ok], axis=1)


@kinds
@pytest.mark.parametrize(
    ("T", "bias", "error", "match"),
    [
        (T_ok[:0], b_ok[:0], EmptyRecording, "has no sample to fit; check"),
        (T_ok, b_ok[:-1], BadValue, r"has T \(400,\) and bias \(399, 2\), expected .*; give one row"),
        (T_ok, b_ok[:, 0], BadValue, r".*bias \(400,\), expected"),
        (np.where(T_ok > 39, np.nan, T_ok), b_ok, BadValue, "T has 10 samples that are not finite.* sample 390 of 400"),
        (T_ok, np.where(b_ok == 0, np.inf, b_ok), BadValue, "bias has 1 samples .* sample 0 of 400.*; leave"),
        (T_ok / 100, b_ok, SwingTooSmall, "T moves by only 0.40 K, .* needs at least 2 K; fit it on a wider soak"),
        (np.full(400, 20.0), b_ok, SwingTooSmall, "T moves by only 0.00 K"),
        (np.round(T_ok / 20) * 20, b_ok, SwingTooSmall, "T takes only 3 distinct values, .* needs at least .*; fit"),
    ],
)
def test_samples_that_cannot_be_fitted_are_refused(maps, T, bias, error, match):
    with pytest.raises(error, match=f"^{maps.kind}: {match}"):
        maps.fit(T, bias, {})


def test_the_polynomial_says_what_it_needs():
    with pytest.raises(SwingTooSmall, match="a cubic needs at least 5 K; fit it on a wider soak or lower min_swing"):
        Polynomial(min_swing="5 K").fit(T_ok / 10, b_ok, {})
    with pytest.raises(SwingTooSmall, match=r"only 11 distinct .* order 15 needs at least 16; .* lower order"):
        Polynomial(order=15).fit(np.round(T_ok / 4), b_ok, {})


def test_two_temperatures_and_their_rounding_do_not_determine_a_cubic():
    T = np.where(np.arange(400) % 2, 40.0, 0.0) + 1e-10 * np.arange(400)
    with pytest.raises(SingularFit, match=r"determine only 2 of 4 coefficients, a cubic needs all .* lower order"):
        Polynomial().fit(T, b_ok, {})


@pytest.mark.parametrize("maps", [Spline(), OnnxNetwork(starts=2)], ids=lambda maps: maps.kind)
def test_a_constant_bias_and_few_temperatures_stay_finite(maps):
    T = np.round(T_ok / 2) * 2
    found = maps.fit(T, np.full((400, 1), 1e-4), {})
    at = np.linspace(0, 40, 77)
    np.testing.assert_allclose(found.bias(at), 1e-4, atol=1e-9)
    np.testing.assert_allclose(found.slope(at), 0, atol=1e-9)
    assert np.all(np.isfinite(found.sigma(at)))


@pytest.mark.parametrize(
    "wrong",
    [{"order": 0}, {"order": 16}, {"min_swing": -2}, {"min_swing": "0 K"}],
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValidationError):
        Polynomial(**wrong)


@kinds
def test_a_file_that_is_not_there(maps, tmp_path, fitted):
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*none cannot be read .*; name a file"):
        maps.read(tmp_path / "none")
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*map cannot be written .*; name a file in a folder"):
        fitted[maps.kind].save(tmp_path / "none" / "map")


def _set(data, keys, value):
    for key in keys[:-1]:
        data = data[key]
    data[keys[-1]] = value


@pytest.mark.parametrize("maps", [Polynomial(), Spline()], ids=lambda maps: maps.kind)
@pytest.mark.parametrize(
    ("keys", "value", "match"),
    [
        (["driftlab_map"], 2, "is of version 2, expected version 1; refit it, or use the driftlab that wrote it$"),
        (["record", "kind"], "onnx_network", "kind 'onnx_network', expected '.*'; set kind: onnx_network, or refit"),
        (["record"], None, "is damaged at record"),
        (["record", "domain"], [40.0, -20.0], r"has the domain \(40.0, -20.0\)"),
        (["record", "residual"], [1e-5], r"is damaged at content \(Value error, coefficients has the shape"),
        (["coefficients", 0], [1.0], r"is damaged at content"),
        (["coefficients", 0, 0], "one", "is damaged at coefficients.0.0"),
        (["record", "domain"], [-20.0, 1e308], r"is damaged or not JSON \(the number 1e\+308 is beyond 1e\+30\)"),
        (["record", "residual", 0], -1.0, r"has the residual"),
        (["coefficients", 0, 0], 1e308, r"is damaged or not JSON \(the number 1e\+308 is beyond 1e\+30\)"),
        (["coefficients", 0, 0], float("nan"), r"is damaged or not JSON \(NaN is not a number\)"),
        (["coefficients"], [], "is damaged"),
        (["colour"], "red", "is damaged at colour"),
    ],
)
def test_a_damaged_json_file_is_refused(maps, keys, value, match, fitted, tmp_path):
    path = tmp_path / "map.json"
    fitted[maps.kind].save(path)
    data = json.loads(path.read_text())
    _set(data, keys, value)
    path.write_text(json.dumps(data))
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*map.json .*{match}"):
        maps.read(path)


@pytest.mark.parametrize("maps", [Polynomial(), Spline()], ids=lambda maps: maps.kind)
@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "is damaged or not JSON"),
        (b"[1, 2]", "has no key 'driftlab_map', expected a map; name a file that `driftlab fit-map` wrote"),
        (b'{"order": 3}', "has no key 'driftlab_map'"),
        (b'{"driftlab_map": 1, "record": {"ki', "is damaged or not JSON"),
        (b"\x08\x80\xff\x12", "is damaged or not JSON"),
    ],
)
def test_a_file_that_is_no_json_map_is_refused(maps, content, match, tmp_path):
    (tmp_path / "map.json").write_bytes(content)
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*map.json {match}"):
        maps.read(tmp_path / "map.json")


@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 0.99])
def test_a_torn_onnx_file_is_refused(part, fitted, tmp_path):
    whole = fitted["onnx_network"].graph
    (tmp_path / "map.onnx").write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(MapError, match=r"^onnx_network: map file .*map.onnx (is damaged or not ONNX|has no 'driftlab)"):
        OnnxNetwork().read(tmp_path / "map.onnx")


def test_a_json_map_is_no_onnx_map(fitted, tmp_path):
    fitted["polynomial"].save(tmp_path / "map.json")
    with pytest.raises(MapError, match=r"map.json is damaged or not ONNX .*, expected an ONNX file; .* kind"):
        OnnxNetwork().read(tmp_path / "map.json")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"record": False}, r"has no 'driftlab_map' in its metadata_props, expected the record .* add the record"),
        ({"d": 2}, r"gives the shape \(2, 3\) for 2 temperatures, expected \(2, 2\); export it with one output"),
        ({"inputs": 2}, r"cannot be run \(its inputs are .*\), expected a graph .*; export it so"),
    ],
)
def test_a_graph_that_does_not_fit_is_refused(change, match, tmp_path):
    nodes, arrays, _ = gemm_chain()
    with pytest.raises(MapError, match=f"^onnx_network: map file .*other.onnx {match}"):
        OnnxNetwork().read(of_other_hands(tmp_path / "other.onnx", nodes, arrays, **change))


def test_a_graph_with_weights_that_are_not_numbers_is_refused(tmp_path):
    nodes, arrays, _ = gemm_chain()
    path = of_other_hands(tmp_path / "other.onnx", nodes, {**arrays, "c": np.array([0, np.nan, 0])})
    with pytest.raises(
        MapError, match=r"other.onnx gives a bias that is not a finite number at T = .* expected rad/s; ref"
    ):
        OnnxNetwork().read(path)


# Measured data


@pytest.fixture(scope="module")
def heating():
    if "DRIFTLAB_DATA" not in os.environ:
        pytest.skip("DRIFTLAB_DATA does not name the folder of measured recordings")
    folder = Path(os.environ["DRIFTLAB_DATA"]) / "data" / "rtimulib2_teensy"
    runs = {}
    for k in (2, 3):
        table = np.genfromtxt(folder / f"measurements{k}.csv", delimiter=",", names=True)
        table = table[table["ok"] == 1]
        runs[k] = table["temp_C"], np.stack([table[f"g{axis}_rad_s"] for axis in "xyz"], axis=1)
    return runs


def block_rms(T, bias, found):
    """Rms of means of 25 rows, constant removed, deg/h: a row's noise is 85 to 130 deg/h, a mean's 16 to 27."""
    left = bias - found.bias(T)
    left -= left.mean(axis=0)
    n = len(left) // 25
    return DEG_H * np.std(left[: n * 25].reshape(n, 25, 3).mean(axis=1), axis=0)


REFERENCE = {(2, 3): [23, 25, 25], (3, 2): [35, 21, 23]}  # of an independent fit, deg/h


@pytest.mark.recordings
@pytest.mark.parametrize(("on", "to"), REFERENCE)
@kinds
def test_a_map_carries_over_to_another_run_of_the_same_board(maps, on, to, heating):
    """What a stiff map leaves is noise. Run 2 has a wave of 45 deg/h in x that run 3 has not, so a map that is
    supple enough to follow it carries it over: there the two others are bounded more loosely."""
    found = maps.fit(*heating[on], {})
    T, bias = heating[to]
    inside = (found.domain[0] <= T) & (found.domain[1] >= T)
    margin = 1.1 if maps.kind == "polynomial" else np.where([on == 2, False, False], 1.6, 1.15)
    assert np.all(block_rms(T[inside], bias[inside], found) <= margin * np.array(REFERENCE[on, to]))


@pytest.mark.recordings
@pytest.mark.parametrize("run", [2, 3])
@pytest.mark.parametrize("maps", ALL[1:], ids=lambda maps: maps.kind)
def test_a_supple_map_leaves_only_noise_on_its_own_run(maps, run, heating):
    T, bias = heating[run]
    noise = np.std(np.diff(bias, axis=0), axis=0) / np.sqrt(2) / np.sqrt(25) * DEG_H  # of a mean, if it is white
    assert np.all(block_rms(T, bias, maps.fit(T, bias, {})) < 1.35 * noise)
