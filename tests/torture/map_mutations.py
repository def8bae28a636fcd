"""Mutations of a map's file: its bytes, its record, its coefficients, its graph."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

KEY = "driftlab_map"
RNG = np.random.Generator
BAD = (
    float("nan"),
    float("inf"),
    -float("inf"),
    1e308,
    -1e308,
    1e300,
    1e-320,
    None,
    "x",
    [],
    {},
    True,
    2**70,
    "1",
    -1,
    0,
)
OPS = (
    "Sin",
    "Exp",
    "Log",
    "Sqrt",
    "Relu",
    "Neg",
    "Identity",
    "Reciprocal",
    "Abs",
    "NonZero",
    "Shape",
    "IsNaN",
    "NoSuchOp",
)


def of_bytes(raw: bytes, rng: RNG) -> bytes:
    """Truncate, flip, overwrite or exchange."""
    changed = bytearray(raw)
    match rng.integers(5):
        case 0:
            return raw[: rng.integers(len(raw))]
        case 1 | 2:
            for _ in range(int(rng.choice([1, 2, 20]))):
                changed[rng.integers(len(raw))] ^= 1 << int(rng.integers(8))
        case 3:
            k = int(rng.integers(len(raw)))
            changed[k : k + 50] = bytes(rng.integers(0, 256, len(changed[k : k + 50]), dtype=np.uint8))
        case _:
            return bytes(
                [b"", b"{}", b"[]", b"null", b"\x00" * 100, raw * 2, b"{" * 100_000, b"\xff\xfe" + raw][rng.integers(8)]
            )
    return bytes(changed)


def of_content(content: dict[str, Any], rng: RNG) -> dict[str, Any]:
    """Another unit, channel, kind, range, residual or version; coefficients of another size or shape."""
    record = content["record"]
    low, high = record["domain"]
    match rng.integers(9):
        case 0 | 1:
            record["unit"] = [
                "deg/h",
                "deg/s",
                "banana",
                "m/s^2",
                "",
                None,
                "rad/s/s",
                "1,5 rad/s",
                "9**9 rad/s",
                "degC",
            ][rng.integers(10)]
        case 2:
            record["channel"] = ["accel", "temperature", "", None, 3, "gyr0"][rng.integers(6)]
        case 3:
            record["kind"] = ["polynomial", "spline", "onnx_network", "x", None, 3][rng.integers(6)]
        case 4:
            infinite = float("inf")
            record["domain"] = [
                [-infinite, infinite], [low, infinite], [float("nan")] * 2, [high, low], [low, low], [low], [1e308,
                1e308], [-1e308, 1e308],
                ["a", "b"], [low, high, high], [low - 1e300, high], [21.0, 21.2],
            ][rng.integers(12)]  # fmt: skip
        case 5:
            record["residual"] = [[], [1e-5], [1e-5] * 6, [float("nan")] * 3, [-1.0] * 3, "x"][rng.integers(6)]
        case 6:
            content[KEY] = [2, 0, "1", None, 1.5, True][rng.integers(6)]
        case 7:
            record[["samples", "provenance", "unknown", "domain"][rng.integers(4)]] = BAD[rng.integers(len(BAD))]
        case _:
            content[["unknown", "coefficients", "covariance", "spread", "constant"][rng.integers(5)]] = BAD[
                rng.integers(len(BAD))
            ]
    return content


def of_numbers(content: dict[str, Any], rng: RNG) -> dict[str, Any]:
    """A coefficient, a row of them, or the file's numbers as a whole."""
    rows = content["coefficients"]
    k, bad = int(rng.integers(len(rows))), BAD[rng.integers(len(BAD))]
    match rng.integers(4):
        case 0:
            rows[k][int(rng.integers(3))] = bad
        case 1:
            rows[k] = [bad] * 3
        case 2:
            content["coefficients"] = [
                rows[:-1],
                rows + rows,
                [row[:2] for row in rows],
                [[]],
                [row * 2 for row in rows],
            ][rng.integers(5)]
        case _:
            content["coefficients"] = [[value * 1e300 for value in row] for row in rows]
    return content


def of_graph(model: onnx.ModelProto, rng: RNG) -> onnx.ModelProto:
    """Other operations, weights that are no numbers, other shapes, inputs, outputs and types."""
    graph = model.graph
    node = graph.node[int(rng.integers(len(graph.node)))]
    weight = graph.initializer[int(rng.integers(len(graph.initializer)))]
    match rng.integers(7):
        case 0 | 1:
            node.op_type = OPS[rng.integers(len(OPS))]
        case 2 | 3:
            values = numpy_helper.to_array(weight).astype(np.float64)
            values.flat[int(rng.integers(values.size))] = rng.choice([np.nan, np.inf, -np.inf, 1e308, 1e-320])
            weight.CopyFrom(numpy_helper.from_array(values, weight.name))
        case 4:
            values = numpy_helper.to_array(weight)
            other = [
                values.astype(np.float32),
                values.ravel(),
                values[..., :1],
                np.zeros((0, 3)),
                values.astype(np.int64),
            ][rng.integers(5)]
            weight.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(other), weight.name))
        case 5:
            last = graph.output[0].name
            op = OPS[rng.integers(len(OPS))]
            graph.node.append(helper.make_node(op, [last], ["more"]))
            graph.output[0].name = "more"
        case _:
            what = [graph.input, graph.output, graph.node, graph.initializer][rng.integers(4)]
            del what[int(rng.integers(len(what)))]
    return model


def of_metadata(model: onnx.ModelProto, rng: RNG) -> onnx.ModelProto:
    """The record in the file's metadata."""
    for entry in model.metadata_props:
        if entry.key == KEY:
            if rng.random() < 0.15:
                entry.value = ["", "{}", "x", "[1]", entry.value[:-5]][rng.integers(5)]
            else:
                entry.value = json.dumps(of_content(json.loads(entry.value), rng))
    return model


def mutate(name: str, raw: bytes, rng: RNG) -> bytes:
    """Return the bytes of a hostile map."""
    how = rng.random()
    if how < 0.25:
        return of_bytes(raw, rng)
    if name in ("polynomial", "spline"):
        content = json.loads(raw)
        return json.dumps(of_content(content, rng) if how < 0.75 else of_numbers(content, rng)).encode()
    change: Callable[[onnx.ModelProto, RNG], onnx.ModelProto] = of_metadata if how < 0.6 else of_graph
    return change(copy.deepcopy(onnx.load_from_string(raw)), rng).SerializeToString()
