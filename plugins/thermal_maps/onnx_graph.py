"""The ONNX graph of a small network: written by skl2onnx, read back as a chain of layers.

A chain is what a slope can be taken from: MatMul or Gemm, Add and Tanh, one after the other. A bias can be taken
from any graph that gives a slope.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
from pydantic import FiniteFloat, model_validator

from fusion_core.chunk import Array
from fusion_core.contracts import MapFile, MapRecord, Target
from fusion_core.errors import MapError

Weights = list[tuple[Array, Array]]  # W (inputs, outputs) and a (outputs,) of each layer
Curve = Callable[[Array], Array]  # of T (N,), with d values (N, d)
Chain = list[tuple[str, Array]]  # MatMul, Add or Tanh, and its constant

KEY = "driftlab_map"  # of the record among the file's metadata


_GAUSS = np.polynomial.legendre.leggauss(5)
_EXACT = 1e-11  # error of an integral, relative to its largest value
_INTERVALS = (512, 1 << 16)  # first tried, and most


class NetworkFile(MapFile):
    """The text under KEY: what the graph gives, and what a slope cannot say. A file without the keys gives the bias."""

    target: Target = "bias"
    constant: tuple[FiniteFloat, ...] | None = None  # bias of each axis at T_min, of a slope [rad/s]

    @model_validator(mode="after")
    def _slope_has_a_constant(self) -> Self:
        expected = self.record.d if self.target == "slope" else None
        found = None if self.constant is None else len(self.constant)
        if found != expected:
            raise ValueError(f"target {self.target} has {found} constants, not {expected}")
        return self


def forward(network: Weights, T: Array) -> tuple[Array, Array, Array]:
    """Return the values of both hidden layers (N, h) and the output (N, d) at T (N,)."""
    (W_1, a_1), (W_2, a_2), (W_3, a_3) = network
    hidden_1 = np.tanh(T[:, None] * W_1 + a_1)
    hidden_2 = np.tanh(hidden_1 @ W_2 + a_2)
    return hidden_1, hidden_2, hidden_2 @ W_3 + a_3


def tangent(network: Weights, T: Array, domain: tuple[float, float], target: Target) -> Array:
    """Return how the bias at T (m,) answers to each weight of a network of one output (m, p), by central differences.

    Where the network gives the slope, its integral from the lower end of the domain answers, and a constant.
    """
    fine = T if target == "bias" else np.linspace(*domain, 2001)
    columns = []
    for layer, arrays in enumerate(network):
        for which, array in enumerate(arrays):
            for place in np.ndindex(array.shape):
                step = 1e-5 * max(abs(float(array[place])), 1e-3 * float(np.abs(array).max()), 1e-300)
                values = [forward(_moved(network, layer, which, place, sign * step), fine)[-1] for sign in (1, -1)]
                columns.append((values[0] - values[1])[:, 0] / 2)  # in steps: columns of one scale
    J = np.stack(columns, axis=1)
    if target == "bias":
        return J
    area = np.concatenate([np.zeros((1, J.shape[1])), np.cumsum((J[1:] + J[:-1]) / 2, axis=0)]) * (fine[1] - fine[0])
    at = np.stack([np.interp(T, fine, column) for column in area.T], axis=1)
    return np.column_stack([at, np.full(len(T), float(np.abs(at).max()) or 1.0)])


def answer(
    network: Weights, bins: tuple[Array, Array], grid: Array, domain: tuple[float, float], target: Target
) -> Array:
    """Return how the bias on a grid (G,) answers to the means of bins (G, m), given by T (m,) and weight (m,).

    To first order about the trained weights, without the prior that training has.
    """
    T, root = bins[0], np.sqrt(bins[1])
    J, J_grid = (tangent(network, x, domain, target) for x in (T, grid))
    inverse = np.asarray(np.linalg.pinv(root[:, None] * J, rcond=1e-9), dtype=np.float64)
    return np.asarray(J_grid @ (inverse * root))


def _moved(network: Weights, layer: int, which: int, place: tuple[int, ...], step: float) -> Weights:
    moved = [tuple(array.copy() for array in arrays) for arrays in network]
    moved[layer][which][place] += step
    return moved  # type: ignore[return-value]


def side_by_side(networks: list[Weights]) -> Weights:
    """Join networks of one output each into one of d outputs; they share T and nothing else."""
    from scipy.linalg import block_diag

    joined = [
        (block_diag(*(W for W, _ in layer)), np.concatenate([a for _, a in layer]))
        for layer in zip(*networks, strict=True)
    ]
    joined[0] = (joined[0][0].sum(axis=0, keepdims=True), joined[0][1])
    return joined


def export(network: Weights, record: MapRecord, constant: tuple[float, ...] | None = None) -> bytes:
    """Return the ONNX file of a network with its record; one of a slope has the bias (d,) at T_min too."""
    from onnx import numpy_helper
    from skl2onnx import convert_sklearn
    from skl2onnx.common.data_types import DoubleTensorType
    from sklearn.neural_network import MLPRegressor

    d = record.d
    regressor = MLPRegressor(hidden_layer_sizes=tuple(len(a) for _, a in network[:-1]), activation="tanh")
    regressor.coefs_, regressor.intercepts_ = [W for W, _ in network], [a for _, a in network]
    regressor.n_layers_, regressor.n_outputs_, regressor.n_features_in_ = len(network) + 1, d, 1
    regressor.out_activation_ = "identity"
    model = convert_sklearn(regressor, "thermal_map", [("temperature", DoubleTensorType([None, 1]))], target_opset=17)
    last = model.graph.node[-1]
    for initializer in model.graph.initializer:  # its Reshape to (-1, 1) would give d axes as (d N, 1)
        if last.op_type == "Reshape" and initializer.name == last.input[1]:
            initializer.CopyFrom(numpy_helper.from_array(np.array([-1, d]), initializer.name))
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value = d
    return described(model, record, constant)


def described(model: Any, record: MapRecord, constant: tuple[float, ...] | None) -> bytes:
    """Return the ONNX file of a model that says of itself what the record does."""
    content = NetworkFile(record=record, target="bias" if constant is None else "slope", constant=constant)
    others = [item for item in model.metadata_props if item.key != KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(others)
    model.metadata_props.add(key=KEY, value=content.model_dump_json(exclude_none=True))
    return bytes(model.SerializeToString(deterministic=True))


def open_session(graph: bytes) -> Any:
    """Return an onnxruntime session of one thread, which gives the same bits each time; raises what it raises."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # what it has to say comes as an exception
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


def damaged(name: str, error: Exception) -> MapError:
    """Return the message for a graph that cannot be read; `name` is what messages call it."""
    return MapError(
        f"{name} is damaged or not ONNX ({first_line(error)}), expected an ONNX file; refit it, or mend path or kind"
    )


def first_line(error: Exception) -> str:
    """Return the first line of what an exception says."""
    return str(error).strip().partition("\n")[0]


def read_chain(graph: bytes, name: str) -> Chain:
    """Return the operations of a graph that is a chain; raises MapError where it is not."""
    import onnx
    from onnx import numpy_helper

    try:
        model = onnx.load_model_from_string(graph)
        onnx.checker.check_model(model)
    except Exception as error:  # those of protobuf and of the checker have no base of their own
        raise damaged(name, error) from None
    content = model.graph
    constants = {entry.name: numpy_helper.to_array(entry) for entry in content.initializer}
    current = next(entry.name for entry in content.input if entry.name not in constants)
    chain: Chain = []
    for node in content.node:
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            constants[node.output[0]] = numpy_helper.to_array(node.attribute[0].t)
            continue
        steps = _steps(node, current, constants)
        if steps is None:
            raise MapError(
                f"{name} has the node {node.op_type}({', '.join(node.input)}), expected a chain of MatMul or "
                f"Gemm, Add and Tanh for the slope; export it as such a chain (its bias can be used as it is)"
            )
        chain += steps
        current = node.output[0]
    return chain


def _steps(node: Any, current: str, constants: Mapping[str, Any]) -> Chain | None:
    """Return what a node does to the `current` value, or None where it is no link of a chain."""
    if [name for name in node.input if name not in constants] != [current]:
        return None
    others = [np.asarray(constants[name], dtype=np.float64) for name in node.input if name in constants]
    options = {entry.name: entry.f if entry.name in ("alpha", "beta") else entry.i for entry in node.attribute}
    if node.op_type in ("Add", "Tanh"):
        return [(node.op_type, others[0] if others else np.empty(0))]
    if node.input[0] != current or options.get("transA"):
        return None
    if node.op_type == "MatMul":
        return [("MatMul", others[0])]
    if node.op_type == "Gemm":
        W = options.get("alpha", 1.0) * (others[0].T if options.get("transB") else others[0])
        return [("MatMul", W), *(("Add", options.get("beta", 1.0) * a) for a in others[1:])]
    return [] if node.op_type in ("Identity", "Cast", "Reshape") else None


def derive(chain: Chain, T: Array) -> tuple[Array, Array]:
    """Return the value (N, d) of a chain at T (N,), and its derivative (N, d)."""
    v, J = T[:, None], np.ones((len(T), 1))
    for operation, constant in chain:
        if operation == "MatMul":
            v, J = v @ constant, J @ constant
        elif operation == "Add":
            v = v + constant
        else:
            v = np.tanh(v)
            J = J * (1 - v**2)
    return v, J


def layers(chain: Chain, axis: int) -> Weights | None:
    """Return the network of one axis, where a chain is two layers of tanh and a linear one; else None."""
    if [operation for operation, _ in chain] != ["MatMul", "Add", "Tanh", "MatMul", "Add", "Tanh", "MatMul", "Add"]:
        return None
    (W_1, a_1, _, W_2, a_2, _, W_3, a_3) = (np.atleast_1d(constant) for _, constant in chain)
    return [(W_1, a_1), (W_2, a_2), (W_3[:, axis : axis + 1], a_3.ravel()[axis : axis + 1])]


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
