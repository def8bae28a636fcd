"""Small files of arrays, text, graphs and settings that declare much, inflate to much, or have no end.

Each name begins with what reads the file: the kind of a source (`hdf5`, `mat`, `csv`), the kind of a map
(`onnx_network`, `polynomial`), or `config`. The data sets and variables are called as those of `base.recording`.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from torture.base import COLUMNS, UNITS

RNG = np.random.Generator
PIECE = 1 << 22
WIDTHS = {"time": 1, "gyro": 3, "accel": 3, "temperature": 1}
SUFFIXES = {
    "hdf5": ".h5", "mat": ".mat", "csv": ".csv", "onnx_network": ".onnx", "polynomial": ".json", "config": ".yaml",
}  # fmt: skip


def _many(rng: RNG, low: float, high: float) -> int:
    """Return a number between two powers of ten."""
    return int(10 ** rng.uniform(low, high))


def _rows(count: int, d: int) -> np.ndarray:
    values = np.linspace(0, count / 100, count) if d == 1 else np.zeros((count, d))
    return np.asarray(values)


def _zeros(size: int, before: bytes = b"") -> bytes:
    """Return a zlib stream of some bytes and many zeros: one block of zeros, written again and again."""
    engine = zlib.compressobj(1)
    start = engine.compress(before) + engine.flush(zlib.Z_FULL_FLUSH)
    engine = zlib.compressobj(1, zlib.DEFLATED, -15)
    block = engine.compress(bytes(PIECE)) + engine.flush(zlib.Z_FULL_FLUSH)
    count, rest = divmod(size, PIECE)
    end = engine.compress(bytes(rest)) + engine.flush()
    a, b = (sums := zlib.adler32(before)) & 0xFFFF, sums >> 16
    return start + block * count + end + struct.pack(">HH", (b + size * a) % 65521, a)


def _shape(rows: int, d: int) -> tuple[int, ...]:
    return (rows,) if d == 1 else (rows, d)


def _h5(path: Path, make: Callable[[h5py.File, str, int], object], libver: str = "earliest") -> None:
    with h5py.File(path, "w", libver=libver) as file:
        for name, d in WIDTHS.items():
            make(file, name, d)
            if name in file and file.get(name, getlink=True).__class__ is h5py.HardLink:
                file[name].attrs["unit"] = UNITS[name]


def unwritten(rng: RNG, path: Path) -> None:
    """Data sets that declare rows which were never written, all of them or all but the first."""
    rows, chunked, some = _many(rng, 8.5, 14), bool(rng.integers(2)), bool(rng.integers(2))

    def make(file: h5py.File, name: str, d: int) -> None:
        chunks = tuple(min(n, 4096) for n in _shape(rows, d)) if chunked else None
        gzip = "gzip" if chunked and rng.integers(2) else None
        data = file.create_dataset(name, _shape(rows, d), np.float64, chunks=chunks, compression=gzip)
        if some and chunked:
            data[:1000] = _rows(1000, d)

    _h5(path, make, "latest" if rng.integers(2) else "earliest")


def one_chunk(rng: RNG, path: Path) -> None:
    """One compressed chunk of zeros for each data set, of its declared size or one that holds far more."""
    size = _many(rng, 8.3, 9.2)
    declared = size if rng.integers(2) else _many(rng, 2, 5)
    stream = _zeros(size)

    def make(file: h5py.File, name: str, d: int) -> None:
        shape = _shape(max(1, declared // 8 // d), d)
        data = file.create_dataset(name, shape, np.float64, chunks=shape, compression="gzip")
        data.id.write_direct_chunk((0,) * len(shape), stream if name in ("time", "gyro") else zlib.compress(b""))

    _h5(path, make)


def wide(rng: RNG, path: Path) -> None:
    """A few rows of a great many columns."""
    d, rows = _many(rng, 6, 9), _many(rng, 1, 4)

    def make(file: h5py.File, name: str, width: int) -> None:
        if width == 1:
            file[name] = _rows(rows, 1)
        else:
            data = file.create_dataset(name, (rows, d), np.float64, chunks=(1, d), compression="gzip")
            data.id.write_direct_chunk((0, 0), _zeros(8 * d) if d < 1e8 else zlib.compress(b""))

    _h5(path, make)


def elsewhere(rng: RNG, path: Path) -> None:
    """Values in devices, pipes and other files: external storage, virtual data sets, links of three kinds."""
    how, target = int(rng.integers(5)), str(rng.choice(["/dev/zero", "/dev/stdin", str(path), "/proc/self/mem"]))
    rows = _many(rng, 3, 9)

    def make(file: h5py.File, name: str, d: int) -> None:
        shape = _shape(rows, d)
        if how == 0:
            file.create_dataset(name, shape, np.float64, external=[(target, 0, h5py.h5f.UNLIMITED)])
        elif how == 1:
            layout = h5py.VirtualLayout(shape, np.float64)
            layout[:] = h5py.VirtualSource(target, name, shape)
            file.create_virtual_dataset(name, layout)
        elif how == 2:
            file[name] = h5py.ExternalLink(target, name)
        elif how == 3:
            file[name] = h5py.SoftLink(f"/{name}")
        else:
            file.require_group("a")[name] = file["a"]
            file[name] = _rows(100, d)

    _h5(path, make)


def deep_groups(rng: RNG, path: Path) -> None:
    """Groups within groups, or a great many beside one another."""
    with h5py.File(path, "w", libver="latest") as file:
        for name, d in WIDTHS.items():
            file[name] = _rows(100, d)
        here, nested = file, bool(rng.integers(2))
        for k in range(_many(rng, 3, 4.3)):
            made = here.create_group("g" if nested else f"g{k}")
            here = made if nested else here


def attributes(rng: RNG, path: Path) -> None:
    """Attributes of many megabytes in place of a unit, a factor or the value of what is missing."""
    name = str(rng.choice(["unit", "units", "scale_factor", "_FillValue", "missing_value"]))
    size, how = _many(rng, 5, 6.5), int(rng.integers(3))
    content = [np.zeros(size), "s" * size, np.array(["s" * 1000] * (size // 100), dtype=h5py.string_dtype())][how]
    with h5py.File(path, "w", libver="latest") as file:
        for column, d in WIDTHS.items():
            file[column] = _rows(100, d)
            file[column].attrs["unit"] = UNITS[column]
            file[column].attrs[name] = content


def small_chunks(rng: RNG, path: Path) -> None:
    """Chunks of a row each, of a file with a hole before it, or through filters that make much of a few bytes."""
    rows, size, how = _many(rng, 3, 4.3), _many(rng, 6, 8.5), int(rng.integers(3))

    def make(file: h5py.File, name: str, d: int) -> None:
        one = dict[str, object](chunks=_shape(1, d))
        many = dict[str, object](chunks=_shape(size, d), dtype="i4")
        settings = [one, {**many, "scaleoffset": 0}, {**many, "compression": "lzf"}][how]
        shape = _shape(rows, d) if how == 0 else settings["chunks"]
        data = file.create_dataset(name, shape, **{"dtype": "f8", **settings})
        data[:rows] = _rows(rows, d) if how == 0 else 0
        if how:
            data.id.write_direct_chunk((0,) * data.ndim, struct.pack("<IB", 0, 8) + bytes(30))

    _h5(path, make, "latest" if rng.integers(2) else "earliest")


def unequal(rng: RNG, path: Path) -> None:
    """A great many data sets, each of its own number of rows, of which one was written."""
    with h5py.File(path, "w", libver="latest") as file:
        for k in range(_many(rng, 2, 3.5)):
            file.create_dataset(f"d{k}", (900_000 + k,), np.float64, chunks=(1000,))[:1] = 1


def compound(rng: RNG, path: Path) -> None:
    """Compound, array and opaque types of any size."""
    size = _many(rng, 2, 9)
    kinds = [[("a", "f8"), ("b", "f8", (size // 8,))], f"V{size}", f"S{size}"]
    with h5py.File(path, "w") as file:
        for name in WIDTHS:
            kind = np.dtype(kinds[int(rng.integers(3))])
            chunks = (1,) if rng.integers(2) else None
            file.create_dataset(name, (_many(rng, 1, 6),), kind, chunks=chunks).attrs["unit"] = UNITS[name]


def _element(kind: int, content: bytes, declared: int | None = None) -> bytes:
    size = len(content) if declared is None else declared
    return struct.pack("<II", kind, size) + content + (b"" if kind == 15 else bytes(-len(content) % 8))


def _head(name: str, cls: int, dims: tuple[int, ...]) -> bytes:
    flags = _element(6, struct.pack("<II", cls, 0))
    shape = _element(5, struct.pack(f"<{len(dims)}i", *(min(n, 2**31 - 1) for n in dims)))
    return flags + shape + _element(1, name.encode())


def _mat(path: Path, elements: list[bytes]) -> None:
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\x01IM" + b"".join(elements))


def variables(rng: RNG, path: Path) -> None:
    """Compressed variables of gigabytes, plain ones or fields of a struct."""
    size, struct_of = _many(rng, 8.8, 9.6) // 8 * 8, bool(rng.integers(2))
    size, elements = min(size, 4_294_967_000), []
    for name, d in WIDTHS.items():
        rows = size // 8 // d
        head = _head("" if struct_of else name, 6, (rows, d))
        length = 8 * d * rows
        matrix = struct.pack("<II", 14, min(len(head) + 8 + length, 2**32 - 1)) + head
        matrix += struct.pack("<II", 9, length)
        if struct_of:
            outer = _head(name, 2, (1, 1)) + _element(5, struct.pack("<i", 8)) + _element(1, b"values\0\0")
            matrix = struct.pack("<II", 14, min(len(outer) + len(matrix) + length, 2**32 - 1)) + outer + matrix
        elements.append(_element(15, _zeros(length, matrix)))
    _mat(path, elements)


def declared(rng: RNG, path: Path) -> None:
    """Cells, structs and arrays that declare millions of elements and hold none."""
    dims = (_many(rng, 5, 9.3), int(rng.integers(1, 4)))
    elements = []
    for name in WIDTHS:
        cls = int(rng.choice([1, 2, 3, 4, 5, 6, 7, 12]))
        body = _head(name, cls, dims)
        if cls in (2, 3):
            body += _element(5, struct.pack("<i", 32)) + _element(1, b"a".ljust(32, b"\0") * _many(rng, 0, 4))
        elif cls != 1:
            body += _element(9, b"", _many(rng, 1, 9.6))
        whole = _element(14, body, None if rng.integers(2) else 2**32 - 8)
        elements.append(_element(15, zlib.compress(whole)) if rng.integers(2) else whole)
    _mat(path, elements)


def nested(rng: RNG, path: Path) -> None:
    """Cells or structs within one another, to a great depth."""
    cell, elements = bool(rng.integers(2)), []
    for name in WIDTHS:
        depth, body, parts = _many(rng, 1, 4.7), b"", []
        for _ in range(depth):
            head = _head("", 1 if cell else 2, (1, 1))
            parts.append(head if cell else head + _element(5, struct.pack("<i", 8)) + _element(1, b"a".ljust(8, b"\0")))
        inner = 0
        tags = []
        for part in reversed(parts):
            inner += len(part)
            tags.append(struct.pack("<II", 14, inner) + part)
            inner += 8
        body = b"".join(reversed(tags))
        named = _head(name, 1 if cell else 2, (1, 1))
        named += b"" if cell else _element(5, struct.pack("<i", 8)) + _element(1, b"a".ljust(8, b"\0"))
        whole = struct.pack("<II", 14, len(named) + len(body)) + named + body
        elements.append(_element(15, zlib.compress(whole)))
    _mat(path, elements)


def version_4(rng: RNG, path: Path) -> None:
    """Variables of the oldest form: of any size, in a hole, of negative size, with a name of gigabytes."""
    rows, hole = _many(rng, 3, 7.5), bool(rng.integers(2))
    with path.open("wb") as file:
        for name, d in WIDTHS.items():
            shape = (rows, d) if hole else (int(rng.choice([rows, -1, 2**31 - 1])), int(rng.choice([d, 0, 2**31 - 1])))
            length = len(name) + 1 if hole else int(rng.choice([len(name) + 1, 2**31 - 1, -1]))
            file.write(struct.pack("<5i", 0, *shape, 0, length) + name.encode() + b"\0")
            file.seek(8 * rows * d, 1)
        file.truncate(max(file.tell(), 10**12 * (rng.integers(3) == 0)))


def comments(rng: RNG, path: Path) -> None:
    """Lines that hold no row, in great number: before the header, after it, or both."""
    line = str(rng.choice(["#", "# a comment", "", "  \t", "#,,,,,,,"])) + "\n"
    head, row = ",".join(COLUMNS) + "\n", ",".join(["0"] * len(COLUMNS)) + "\n"
    many = line * _many(rng, 5, 6.7)
    odd = '"0"' + row[1:] if rng.integers(2) else row
    texts = [many + head + row, head + many + row, head + row + many + odd + many]
    path.write_text(texts[int(rng.integers(3))])


def long_lines(rng: RNG, path: Path) -> None:
    """One line of many megabytes: a header, a row or a cell; with separators or without."""
    cell = str(rng.choice(["1,", "1", "x,", '"', "9" * 4000 + ",", "\t"]))
    long = cell * (_many(rng, 5, 7.5) // len(cell))
    head, row = ",".join(COLUMNS) + "\n", ",".join(["0"] * len(COLUMNS)) + "\n"
    texts = [long, long + "\n" + row, head + long, head + row + long + "\n" + row]
    path.write_text(texts[int(rng.integers(4))])


def _onnx(path: Path, nodes: list[object], arrays: dict[str, np.ndarray], opset: int = 17, **more: object) -> None:
    content = {
        "driftlab_map": 1,
        "record": {
            "kind": "onnx_network",
            "domain": [0.0, 60.0],
            "residual": [1e-5] * 3,
            "samples": 9,
            "unit": "rad/s",
        },
    }
    graph = helper.make_graph(
        nodes, "g",
        [helper.make_tensor_value_info("T", TensorProto.DOUBLE, [None, 1])],
        [helper.make_tensor_value_info("b", TensorProto.DOUBLE, [None, None])],
        [numpy_helper.from_array(value, name) for name, value in arrays.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8, **more)
    model.metadata_props.add(key="driftlab_map", value=json.dumps(content))
    path.write_bytes(model.SerializeToString())


def graphs(rng: RNG, path: Path) -> None:
    """Graphs that make much of nothing, go round, or call what is within them."""
    size, node = _many(rng, 8.5, 10), helper.make_node
    W, end = np.ones((1, 3)), [node("MatMul", ["T", "W"], ["m"]), node("Add", ["m", "s"], ["b"])]
    sum_up = [node("ReduceSum", ["c"], ["s"], keepdims=0), *end]
    shape = np.array([size])
    how = int(rng.integers(6))
    if how == 0:
        value = helper.make_tensor("v", TensorProto.DOUBLE, [1], [1.0])
        _onnx(path, [node("ConstantOfShape", ["n"], ["c"], value=value), *sum_up], {"n": shape, "W": W})
    elif how == 1:
        inside = helper.make_graph(
            [node("Identity", ["go"], ["on"]), node("Add", ["a", "a"], ["next"])], "body",
            [helper.make_tensor_value_info("k", TensorProto.INT64, []),
             helper.make_tensor_value_info("go", TensorProto.BOOL, []),
             helper.make_tensor_value_info("a", TensorProto.DOUBLE, [1])],
            [helper.make_tensor_value_info("on", TensorProto.BOOL, []),
             helper.make_tensor_value_info("next", TensorProto.DOUBLE, [1])],
        )  # fmt: skip
        arrays = {"n": np.array(10**12), "yes": np.array(True), "zero": np.zeros(1), "W": W}
        _onnx(path, [node("Loop", ["n", "yes", "zero"], ["s"], body=inside), *end], arrays)
    elif how == 2:
        arrays = {"one": np.ones(1), "n": shape, "W": W}
        _onnx(path, [node("Expand", ["one", "n"], ["c"]), *sum_up], arrays)
    elif how == 3:
        arrays = {"a": np.array(0.0), "z": np.array(float(size)), "one": np.array(1.0), "W": W}
        _onnx(path, [node("Range", ["a", "z", "one"], ["c"]), *sum_up], arrays)
    elif how == 4:  # a broadcast that doubles again and again
        nodes = [node("MatMul", ["T", "W"], ["c0"])]
        nodes += [node("Add", [f"c{k}", "u" if k % 2 else "v"], [f"c{k + 1}"]) for k in range(12)]
        arrays = {"W": W, "u": np.ones((3000, 1, 1)), "v": np.ones((3000, 1, 1, 1))}
        _onnx(path, [*nodes, node("ReduceSum", ["c12"], ["b"], keepdims=0)], arrays)
    else:
        nodes = [node("Tanh", ["T" if k == 0 else f"c{k}"], [f"c{k + 1}"]) for k in range(_many(rng, 3, 5))]
        nodes.append(node("MatMul", [f"c{len(nodes)}", "W"], ["b"]))
        _onnx(path, nodes, {"W": W})


def constants(rng: RNG, path: Path) -> None:
    """Constants that declare any shape, or lie in devices and other files; keys in great number."""
    how, W = int(rng.integers(5)), np.ones((1, 3))
    chain = [helper.make_node("MatMul", [f"c{k}" if k else "T", "V" if k else "W"], [f"c{k + 1}"]) for k in range(900)]
    nodes = (
        [*chain, helper.make_node("Identity", ["c900"], ["b"])]
        if how == 4
        else [helper.make_node("MatMul", ["T", "W"], ["b"])]
    )
    _onnx(path, nodes, {"W": W, "V": np.eye(3)})
    model = onnx.load(str(path), load_external_data=False)
    tensor = model.graph.initializer[0]
    if how == 0:
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        for key, value in {
            "location": str(rng.choice(["/dev/zero", "../recording.csv", path.name])),
            "length": "24",
        }.items():
            tensor.external_data.add(key=key, value=value)
    elif how == 1:
        del tensor.dims[:]
        tensor.dims.extend([[10**6, 10**9], [2**33, 2**31], [-1, 3], [0, 10**18]][int(rng.integers(4))])
    elif how == 2:
        del tensor.dims[:]
        tensor.dims.extend([1] * _many(rng, 3, 6) + [3])
    elif how == 3:
        for k in range(_many(rng, 3, 5.3)):
            model.metadata_props.add(key=f"k{k}", value="{}")
            model.graph.input.add(name=f"i{k}")
    path.write_bytes(model.SerializeToString())


def json_maps(rng: RNG, path: Path) -> None:
    """JSON of megabytes, of great depth, and of numbers without end."""
    depth, how = _many(rng, 3, 6), int(rng.integers(8))
    number = "9" * _many(rng, 2, 6)
    value = [
        "[" * depth + "]" * depth,
        '{"a":' * depth + "1" + "}" * depth,
        number,
        "[" + "[]," * depth + "1]",
        "{" + '"a":1,' * depth + '"a":1}',
        "{" + ",".join(f'"{k}":1' for k in range(depth)) + "}",
        "[" + "{}," * (2 * depth) + "{}]",
        "[" + "0," * (3 * depth) + "0]",
    ][how]
    sparse = rng.integers(4) == 0
    text = f'{{"driftlab_map": 1, "record": {{"kind": "polynomial", "samples": {value}}}, "coefficients": {value}}}'
    path.write_text(text)
    if sparse:  # blanks to the end, which no disk has to hold
        with path.open("r+b") as file:
            file.truncate(_many(rng, 9, 10.5))


def configs(rng: RNG, path: Path) -> None:
    """YAML that is deep, wide, or holds itself again and again."""
    how, many = int(rng.integers(4)), _many(rng, 3, 5.5)
    if how == 0:
        path.write_text("a: " + "[" * many + "]" * many)
    elif how == 1:
        lines = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9 if k else ['1'])}]" for k in range(30)]
        path.write_text("\n".join(lines))
    elif how == 2:
        path.write_text("latitude: " + "9" * many)
    else:
        path.write_text("a: 1\n" * many)
        with path.open("r+b") as file:
            file.truncate(_many(rng, 9, 10.5))


FORMATS: dict[str, Callable[[RNG, Path], None]] = {
    "hdf5 unwritten": unwritten, "hdf5 one chunk": one_chunk, "hdf5 wide": wide, "hdf5 elsewhere": elsewhere,
    "hdf5 groups": deep_groups, "hdf5 attributes": attributes, "hdf5 compound": compound,
    "hdf5 small chunks": small_chunks, "hdf5 unequal": unequal, "mat variables": variables, "mat declared": declared,
    "mat nested": nested, "mat version 4": version_4, "csv comments": comments, "csv lines": long_lines,
    "onnx_network graphs": graphs,
    "onnx_network constants": constants, "polynomial json": json_maps, "config yaml": configs,
}  # fmt: skip
