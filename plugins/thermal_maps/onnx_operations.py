"""The operations of an ONNX graph that gives a bias: each is known before one of them is run.

A graph is a program of someone else's: it can call graphs within it, go round without end, or make much of nothing.
Taken is one whose every value is (N, width), made from the temperatures by matrix products with constants, sums and
functions of single numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fusion_core.chunk import Array
from fusion_core.errors import MapError, shown

FUNCTIONS = frozenset(
    ["Abs", "Ceil", "Cos", "Elu", "Erf", "Exp", "Floor", "Gelu", "HardSigmoid", "Identity", "LeakyRelu", "Neg",
     "Reciprocal", "Relu", "Selu", "Sigmoid", "Sin", "Softplus", "Softsign", "Sqrt", "Tanh"]
)  # fmt: skip
PAIRS = frozenset(["Add", "Sub", "Mul", "Div", "Pow"])
NUMBERS = frozenset([1, 6, 7, 10, 11])  # float, int32, int64, float16 and double: of a tensor, or to cast to
WIDEST = 1024  # numbers of one value for each temperature
MOST = 100_000  # products for each temperature; a function counts for ten
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
            f"and {MOST:,} products a temperature; export it so"
        )

    def _tensor(self, entry: Any) -> Array:
        """Return a constant; raises MapError where it is in another file, or of no numbers."""
        from onnx import numpy_helper

        if entry.data_location or entry.external_data or entry.data_type not in NUMBERS:
            raise self._wrong(f"has the constant '{shown(entry.name)}', which is in another file or of no numbers")
        try:
            values = np.asarray(numpy_helper.to_array(entry), dtype=np.float64)
        except (ValueError, TypeError, OverflowError, MemoryError):
            raise self._wrong(f"has the constant '{shown(entry.name)}', which is damaged") from None
        if values.ndim > 2:
            raise self._wrong(f"has the constant '{shown(entry.name)}' of {values.ndim} dimensions")
        return values

    def _add(self, node: Any) -> None:
        """Check a node, and note what it gives."""
        options = {entry.name: entry for entry in node.attribute}
        within = any(entry.HasField("g") or entry.graphs for entry in node.attribute)
        rule = RULES.get(node.op_type)
        if rule is None or node.domain not in ("", "ai.onnx") or within or len(node.output) != 1:
            raise self._wrong(f"has the node {shown(node.op_type)}({shown(', '.join(node.input), 100)})")
        if node.op_type == "Constant":
            self.constants[node.output[0]] = self._tensor(node.attribute[0].t)
            return
        found = rule(self, node, options)
        if found is None or found[0] > WIDEST:
            shapes = [self._shape(name) for name in node.input]
            raise self._wrong(f"has the node {shown(node.op_type)} of {', '.join(shapes)}")
        self.values[node.output[0]] = found
        self.cost += found[0] * (COST if node.op_type in FUNCTIONS else 1)
        if self.cost > MOST:
            raise self._wrong(f"takes more than {MOST:,} products a temperature")

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
