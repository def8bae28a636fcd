"""The ONNX graph of a small network: written, checked, and read back as a chain of layers.

A chain is what a slope can be taken from: MatMul or Gemm, Add and Tanh, one after the other. A bias can be taken
from any graph that gives a slope.

A graph is a program of someone else's: it can call graphs within it, go round without end, or make much of nothing. So
each of its operations is known before one of them is run. Taken is a graph whose every value is (N, width), made from
the temperatures by matrix products with constants, sums and functions of single numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
from pydantic import FiniteFloat, model_validator

from fusion_core.chunk import Array
from fusion_core.contracts import MapFile, MapRecord, Target
from fusion_core.errors import MapError, quote
from fusion_plugins.thermal_maps.network import Weights

Chain = list[tuple[str, Array]]  # MatMul, Add or Tanh, and its constant

KEY = "driftlab_map"  # of the record among the file's metadata


class NetworkFile(MapFile):
    """The text under KEY: what the graph gives, and what a slope cannot say. A file without the keys gives the bias."""

    target: Target = "bias"
    constant: tuple[FiniteFloat, ...] | None = None  # bias of each axis at T_min, of a slope [rad/s]

    @model_validator(mode="after")
    def _slope_has_a_constant(self) -> Self:
        expected = self.record.d if self.target == "slope" else None
        count = None if self.constant is None else len(self.constant)
        if count != expected:
            raise ValueError(f"target {self.target} has {count} constants, not {expected}")
        return self


def export(network: Weights, record: MapRecord, constant: tuple[float, ...] | None = None) -> bytes:
    """Return the ONNX file of a network with its record; one of a slope has the bias (d,) at T_min too."""
    from onnx import TensorProto, helper, numpy_helper

    nodes, constants, value = [], [], "temperature"
    for k, layer in enumerate(network, 1):
        names = [f"W_{k}", f"a_{k}"]
        constants += [numpy_helper.from_array(array, name) for array, name in zip(layer, names, strict=True)]
        steps = [("MatMul", [names[0]]), ("Add", [names[1]]), ("Tanh", [])][: 3 if k < len(network) else 2]
        for operation, others in steps:
            nodes.append(helper.make_node(operation, [value, *others], [f"{operation}_{k}"]))
            value = f"{operation}_{k}"
    ends = [
        helper.make_tensor_value_info(name, TensorProto.DOUBLE, [None, width])
        for name, width in (("temperature", 1), (value, record.d))
    ]
    graph = helper.make_graph(nodes, "thermal_map", ends[:1], ends[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
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
    """Return the operations of a node on the `current` value, None where it is no link of a chain."""
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


FUNCTIONS = frozenset(
    ["Abs", "Ceil", "Cos", "Elu", "Erf", "Exp", "Floor", "Gelu", "HardSigmoid", "Identity", "LeakyRelu", "Neg",
     "Reciprocal", "Relu", "Selu", "Sigmoid", "Sin", "Softplus", "Softsign", "Sqrt", "Tanh"]
)  # fmt: skip
PAIRS = frozenset(["Add", "Sub", "Mul", "Div", "Pow"])
NUMBERS = frozenset([1, 6, 7, 10, 11])  # float, int32, int64, float16 and double: of a tensor, or to cast to
WIDEST = 1024  # numbers of one value for each temperature
MAX_PRODUCTS = 100_000  # products for each temperature; a function counts for ten
COST = 10
NODES = 1000


class GraphValues:
    """The values of a graph, one after the other, and what they cost.

    Parameters
    ----------
    model : onnx.ModelProto
    name : str
        What messages call it.

    Raises
    ------
    MapError
        Where it is anything else than such a graph.
    """

    def __init__(self, model: Any, name: str) -> None:
        self.name, self.cost = name, 0
        graph = model.graph
        if model.functions or model.training_info or graph.sparse_initializer or len(graph.node) > NODES:
            raise self._wrong(f"has functions of its own, sparse arrays, or more than {NODES} nodes")
        self.constants: dict[str, Array] = {}
        for entry in graph.initializer:
            self.constants[entry.name] = self._tensor(entry)
        # the numbers of a value for each temperature, and how many of them are in a row
        self.values = {entry.name: (1, 1) for entry in graph.input if entry.name not in self.constants}
        for node in graph.node:
            self._add(node)

    def _wrong(self, what: str) -> MapError:
        return MapError(
            f"{self.name} {what}, expected matrix products, sums and functions of numbers, at most {WIDEST} wide "
            f"and {MAX_PRODUCTS:,} products a temperature; export it so"
        )

    def _tensor(self, entry: Any) -> Array:
        """Return a constant; raises MapError where it is in another file, or of no numbers."""
        from onnx import numpy_helper

        if entry.data_location or entry.external_data or entry.data_type not in NUMBERS:
            raise self._wrong(f"has the constant '{quote(entry.name)}', which is in another file or of no numbers")
        try:
            values = np.asarray(numpy_helper.to_array(entry), dtype=np.float64)
        except (ValueError, TypeError, OverflowError, MemoryError):
            raise self._wrong(f"has the constant '{quote(entry.name)}', which is damaged") from None
        if values.ndim > 2:
            raise self._wrong(f"has the constant '{quote(entry.name)}' of {values.ndim} dimensions")
        return values

    def _add(self, node: Any) -> None:
        """Check a node, and note what it gives."""
        options = {entry.name: entry for entry in node.attribute}
        within = any(entry.HasField("g") or entry.graphs for entry in node.attribute)
        rule = RULES.get(node.op_type)
        if rule is None or node.domain not in ("", "ai.onnx") or within or len(node.output) != 1:
            raise self._wrong(f"has the node {quote(node.op_type)}({quote(', '.join(node.input), 100)})")
        if node.op_type == "Constant":
            self.constants[node.output[0]] = self._tensor(node.attribute[0].t)
            return
        size = rule(self, node, options)
        if size is None or size[0] > WIDEST:
            shapes = [self._shape(name) for name in node.input]
            raise self._wrong(f"has the node {quote(node.op_type)} of {', '.join(shapes)}")
        self.values[node.output[0]] = size
        self.cost += size[0] * (COST if node.op_type in FUNCTIONS else 1)
        if self.cost > MAX_PRODUCTS:
            raise self._wrong(f"takes more than {MAX_PRODUCTS:,} products a temperature")

    def _shape(self, name: str) -> str:
        if name in self.constants:
            return str(self.constants[name].shape)
        return f"(N, {self.values[name][1]})" if name in self.values else "a value that is not there"

    def of_one(self, node: Any, options: Mapping[str, Any]) -> tuple[int, int] | None:
        """Return the size of what a function gives."""
        if len(node.input) != 1 or (node.op_type == "Cast" and options["to"].i not in NUMBERS):
            return None
        return self.values.get(node.input[0])

    def of_two(self, node: Any, options: Mapping[str, Any]) -> tuple[int, int] | None:
        """Return the size of a sum or the like: rows and one row, or rows and rows of the same width."""
        sizes = [self._size(name) for name in node.input]
        if len(sizes) != 2 or None in sizes or not any(name in self.values for name in node.input):
            return None
        (size, width), (other, wide) = sorted((s for s in sizes if s is not None), key=lambda s: s[1])
        count = max(size // width, other // wide)
        return (count * wide, wide) if width in (1, wide) else None

    def of_product(self, node: Any, options: Mapping[str, Any]) -> tuple[int, int] | None:
        """Return the size of a matrix product of rows and a constant."""
        rows, W = self.values.get(node.input[0]), self.constants.get(node.input[1])
        if rows is None or W is None or W.ndim != 2 or ("transA" in options and options["transA"].i):
            return None
        high, wide = W.T.shape if "transB" in options and options["transB"].i else W.shape
        if high != rows[1] or not wide:
            return None
        if len(node.input) > 2 and (self._size(node.input[2]) or (0, 0))[1] not in (1, wide):
            return None
        self.cost += rows[0] * wide
        return rows[0] // rows[1] * wide, wide

    def of_shape(self, node: Any, options: Mapping[str, Any]) -> tuple[int, int] | None:
        """Return the size of rows that are made longer or shorter."""
        rows, shape = self.values.get(node.input[0]), self.constants.get(node.input[1])
        if rows is None or shape is None or shape.ndim != 1 or not 1 <= len(shape) <= 2 or shape[0] != -1:
            return None
        width = int(shape[1]) if len(shape) == 2 else 1
        return (rows[0], width) if 0 < width <= WIDEST else None

    def _size(self, name: str) -> tuple[int, int] | None:
        """Return the numbers for each temperature and in a row of a value, or of a constant that is one row."""
        if name not in self.constants:
            return self.values.get(name)
        shape = self.constants[name].shape
        one = math.prod(shape[:-1]) == 1 and 0 not in shape
        return (shape[-1] if shape else 1,) * 2 if one else None


Rule = Callable[[GraphValues, Any, Mapping[str, Any]], tuple[int, int] | None]
RULES: dict[str, Rule] = {
    **dict.fromkeys([*FUNCTIONS, "Cast", "Constant"], GraphValues.of_one),
    **dict.fromkeys(PAIRS, GraphValues.of_two),
    "MatMul": GraphValues.of_product,
    "Gemm": GraphValues.of_product,
    "Reshape": GraphValues.of_shape,
}
