import json

import numpy as np
import pytest
from soaks import NOISE, rms, smooth, soak

from fusion_core.contracts import MapFile, MapRecord
from fusion_core.errors import (
    MapError,
)
from fusion_plugins.thermal_maps import onnx_graph
from fusion_plugins.thermal_maps.curve_table import CurveTable
from fusion_plugins.thermal_maps.onnx_network import OnnxMap, OnnxNetwork


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


def test_the_network_makes_one_session(fitted):
    found = fitted["onnx_network"]
    found.bias(np.array([20.0]))
    session = found._session
    found.bias(np.array([21.0]))
    assert found._session is session


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


@pytest.mark.parametrize("target", ["bias", "slope"])
def test_many_temperatures_and_one_alone_are_as_the_graph_has_them(target):
    """They come from a table, which is tried halfway between its nodes; here it is tried anywhere."""
    fitted = OnnxNetwork(starts=1, target=target).fit(*soak(smooth), {})
    low, high = fitted.domain
    at = np.concatenate([[low, high], np.random.default_rng(0).uniform(low, high, 5000)])
    assert fitted._table is not None
    few = np.concatenate([fitted._run(part) for part in np.array_split(at, 10)])
    alone = np.concatenate([fitted._run(T) for T in np.split(at[:100], 100)])
    np.testing.assert_allclose(fitted._run(at), few, rtol=0, atol=2e-13 * np.abs(few).max())
    np.testing.assert_array_equal(alone, fitted._run(at)[:100])


@pytest.mark.parametrize("curve", [
    lambda T: np.abs(T[:, None] - 20.0003),  # a kink
    lambda T: np.tanh((T[:, None] - 20) / 0.01),  # steeper than the nodes are near
    lambda T: np.float32(np.sin(T[:, None] / 10)).astype(np.float64),  # seven digits
])  # fmt: skip
def test_a_curve_that_is_not_smooth_has_no_table(curve):
    assert CurveTable.of(curve, (-20.0, 60.0)) is None
