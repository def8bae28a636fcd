"""Recordings as arrays of a MAT file, versions 4 to 7.3, each as MATLAB and Octave write it.

::

    path of a channel        variable
    gyro                     a variable: (N, 1), (1, N), (N, axes) or (axes, N)
    imu.gyro                 a field of a struct, or of a struct in a struct

N is the number of values of the time channel, which separates (axes, N) from (N, axes). Version 7.3 is HDF5 with its
dimensions the other way round. Rows are read in blocks; of a compressed file, the variables that are named are loaded.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal

import numpy as np

from fusion_core.budget import DEEPEST, NAMES, rows_at_once
from fusion_core.chunk import Array
from fusion_core.contracts import Block, Table, foreign, head
from fusion_core.contracts.table import row_blocks
from fusion_core.data_sets import DataSetRows, attribute, check_rows, links_of
from fusion_core.errors import BadValue, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.mat_elements import Elements, Old, Variable
from fusion_plugins.sources.joining import TableSource
from fusion_plugins.sources.unpacked import translated, unpacking

SIGNATURES = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")
DAMAGES = (
    OSError, EOFError, ValueError, LookupError, TypeError, RuntimeError, ArithmeticError, struct.error, zlib.error,
)  # fmt: skip
HDF5 = b"\x89HDF\r\n\x1a\n"
PLAIN = ["double", "single", "logical", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"]
AS_STRUCT = "in MATLAB, S = table2struct(timetable2table(TT), 'ToScalar', true); save('FILE', 'S', '-v7')"


@hookimpl
class Mat(TableSource):
    """A MAT file of MATLAB or Octave."""

    signatures: ClassVar[tuple[bytes, ...]] = SIGNATURES
    suffixes: ClassVar[tuple[str, ...]] = (".mat",)

    kind: Literal["mat"] = "mat"

    @unpacking
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the file; raises UnreadableFile where it is of another kind or damaged."""
        first = head(path)
        time = self.channels["time"].paths[0] if "time" in self.channels else None
        if first.startswith((b"# Created by Octave", b"Octave-1-")):
            raise UnreadableFile(
                f"{path}: is in a format of Octave's own, a MAT file was expected; save it with save('-v7', ...)"
            )
        if first.startswith(HDF5) or first[512 : 512 + len(HDF5)] == HDF5:
            import h5py

            with translated(path, *DAMAGES), h5py.File(path, "r") as file:
                yield Variables(path, Hdf5Groups(path, file), time)
        elif first.startswith(b"MATLAB 5.0") or first[124:128] in (b"\0\1IM", b"\1\0MI") or _version_4(first):
            with translated(path, *DAMAGES), path.open("rb") as plain:
                yield Variables(path, Loaded(path, plain, path.stat().st_size, old=_version_4(first)), time)
        else:
            raise foreign(path, first, self.kind)


class Loaded:
    """An open file of version 4 to 7, each variable loaded when it is asked for."""

    def __init__(self, path: Path, file: BinaryIO, size: int, *, old: bool) -> None:
        self.path = path
        self._elements = Old(path, file, size) if old else Elements(path, file, size)
        self._coming = self._elements.variables()
        self._seen: dict[str, tuple[Variable, int]] = {}
        self._kept: dict[str, Variable | None] = {}

    @cached_property
    def tops(self) -> Mapping[str, Variable]:
        """Every variable, its numbers left out."""
        for variable, at in self._coming:
            self._note(variable, at)
        return {name: variable for name, (variable, _) in self._seen.items()}

    def top(self, name: str) -> Variable | None:
        """Return a variable, None where there is none; of several of one name, the first."""
        if name not in self._kept:
            while name not in self._seen and (further := next(self._coming, None)) is not None:
                self._note(*further)
            known = self._seen.get(name)
            self._kept[name] = None if known is None else self._elements.load(known[1])
        return self._kept[name]

    def _note(self, variable: Variable, at: int) -> None:
        self._seen.setdefault(variable.name, (variable, at))
        if len(self._seen) > NAMES:
            raise UnreadableFile(f"{self.path}: has more than {NAMES:,} variables, which is the limit; save fewer")

    def fields(self, node: Variable) -> Mapping[str, Variable] | None:
        """Return the fields of a struct, None where it is none; an array of structs has none that could be read."""
        return node.fields

    def plain(self, node: Variable) -> tuple[Array | None, tuple[int, ...], str]:
        """Return an array of numbers, or None, with its shape and what it is."""
        return node.array, node.shape, node.what


class Hdf5Groups:
    """An open file of version 7.3, or one that Octave wrote as HDF5."""

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self.file = path, file

    @cached_property
    def tops(self) -> Mapping[str, Any]:
        """Every variable."""
        return {name: node for name, node in self._inside(self.file).items() if not name.startswith("#")}

    def top(self, name: str) -> Any:
        """Return a variable, None where there is none."""
        return self.tops.get(name)

    def fields(self, node: Any) -> Mapping[str, Any] | None:
        """Return the fields of a struct, None where it is none."""
        if not hasattr(node, "keys") or "MATLAB_object_decode" in node.attrs or "MATLAB_sparse" in node.attrs:
            return None
        return self._inside(node)

    def _inside(self, group: Any) -> Mapping[str, Any]:
        """Return the nodes of a group: Octave keeps a value beside the name of its type."""
        import h5py

        nodes = {}
        for name in links_of(self.path, group):
            node = group[name]
            if isinstance(node, h5py.Group) and "OCTAVE_NEW_FORMAT" in node.attrs:
                node = node["value"] if b"value" in links_of(self.path, node) else node
            if isinstance(node, h5py.Group | h5py.Dataset):
                nodes[name.decode("utf-8", "backslashreplace")] = node
        return nodes

    def plain(self, node: Any) -> tuple[Array | Turned | None, tuple[int, ...], str]:
        """Return a view of the numbers as MATLAB has them, or None, with its shape and what it is."""
        kind = attribute(self.path, node, "MATLAB_class")
        kind = b"double" if kind is None else kind
        name = kind.decode("latin-1") if isinstance(kind, bytes) else str(kind)
        if "MATLAB_object_decode" in node.attrs:
            return None, (), f"an object of class {name}"
        if hasattr(node, "keys"):
            return None, (), "a sparse matrix"
        if node.dtype.kind == "O":
            return None, node.shape[::-1], "a cell array" if name == "cell" else "an array of structs"
        if name not in PLAIN or node.dtype.kind not in "iuf":
            return None, node.shape[::-1], "text" if name == "char" else f"of type {node.dtype}"
        if "MATLAB_empty" in node.attrs:
            return np.zeros((0, 1)), (0, 1), ""
        return Turned(self.path, node), node.shape[::-1], ""


class Turned:
    """A data set with its dimensions as MATLAB has them."""

    def __init__(self, path: Path, node: Any) -> None:
        self.path, self.node = path, node
        self._rows: DataSetRows | None = None

    def along(self, axis: int) -> DataSetRows:
        """Return its rows along an axis as MATLAB has them."""
        self._rows = self._rows or DataSetRows(self.path, self.node, 1 - axis)
        return self._rows


class Variables(Table):
    """The variables of an open file, and the fields of structs."""

    noun: ClassVar[str] = "variable"

    def __init__(self, path: Path, file: Loaded | Hdf5Groups, time: str | None) -> None:
        self.path, self.file, self.time = path, file, time
        self._count = 0  # of variables and fields

    @cached_property
    def names(self) -> Sequence[str]:
        """Every variable, and in place of a struct its fields."""
        self._count = 0
        return [path for name, node in self.file.tops.items() for path in self._leaves(name, node)]

    def has(self, path: str) -> bool:
        """Return True if `path` is a variable, or a field of a struct."""
        return self._node(path) is not None

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of `size` rows."""
        arrays = {path: self._plain(path) for path in paths}
        rows = self._rows({path: shape for path, (_, shape) in arrays.items()})
        along = {path: self._axis(path, shape, rows) for path, (_, shape) in arrays.items()}
        columns = [a.along(along[path]) for path, (a, _) in arrays.items() if isinstance(a, Turned)]
        if columns:
            check_rows(self.path, columns)
        row = sum(8.0 * shape[1 - along[path]] for path, (_, shape) in arrays.items())
        size = rows_at_once(self.path, f"the variables {', '.join(paths)}"[:100], size, row)
        yield from row_blocks(rows, size, partial(self._read, arrays, along))

    def _leaves(self, path: str, node: Any, depth: int = 0) -> Iterator[str]:
        self._count += 1
        if depth > DEEPEST or self._count > NAMES:
            raise UnreadableFile(
                f"{self.path}: has structs more than {DEEPEST} deep, or more than {NAMES:,} variables and fields, "
                "which is the limit; save fewer"
            )
        fields = self.file.fields(node)
        if fields is None:
            yield path
        else:
            for name, field in fields.items():
                yield from self._leaves(f"{path}.{name}", field, depth + 1)

    def _node(self, path: str) -> Any:
        """Return the node of a path, None where there is none; raises BadValue where that is inside an object."""
        name, *rest = path.split(".")
        node = self.file.top(name)
        for k, field in enumerate(rest):
            if node is None:
                return None
            fields = self.file.fields(node)
            if fields is None:
                raise self._not_numbers(".".join([name, *rest[:k]]), node, "a struct was expected")
            node = fields.get(field)
        return node

    def _plain(self, path: str) -> tuple[Any, tuple[int, ...]]:
        """Return an array of numbers and its shape; raises BadValue where there is none."""
        node = self._node(path)
        fields = self.file.fields(node)
        if fields is not None:
            inside = next(iter(self._leaves(path, node)), path)
            raise BadValue(f"{self.path}: variable '{path}' is a struct, an array was expected; name '{inside}'")
        array, shape, _ = self.file.plain(node)
        if array is None:
            raise self._not_numbers(path, node, "an array of numbers was expected")
        return array, shape

    def _not_numbers(self, path: str, node: Any, expected: str) -> BadValue:
        what = self.file.plain(node)[2] or "an array"
        advice = "save a full matrix of real numbers, or a struct of them"
        if what.startswith("an object"):
            advice = f"save it as a struct or as arrays: {AS_STRUCT}"
        return BadValue(f"{self.path}: variable '{path}' is {what}, {expected}; {advice}")

    def _rows(self, shapes: Mapping[str, tuple[int, ...]]) -> int:
        """Return the number of rows: the time's, else that of the vectors, else the longest dimension."""
        if self.time is not None:
            shape = shapes[self.time]
            if sum(length > 1 for length in shape) > 1:
                raise BadValue(
                    f"{self.path}: variable '{self.time}' has shape {shape}, a vector was expected for channel time; "
                    "name the vector of the time stamps"
                )
            return int(np.prod(shape))
        vectors = [int(np.prod(s)) for s in shapes.values() if sum(length > 1 for length in s) <= 1]
        return vectors[0] if vectors else max(max(shape) for shape in shapes.values())

    def _axis(self, path: str, shape: tuple[int, ...], rows: int) -> int:
        """Return the dimension of the rows; raises BadValue where there is none of their number."""
        if len(shape) == 2 and rows in shape:
            return shape.index(rows)
        raise BadValue(
            f"{self.path}: variable '{path}' has shape {shape}, ({rows}, axes) or (axes, {rows}) was expected as "
            f"'{self.time or 'the others'}' {'has' if self.time else 'have'} {rows} values; name variables that were "
            "sampled together"
        )

    def _read(self, arrays: Mapping[str, tuple[Any, Any]], along: Mapping[str, int], rows: slice, path: str) -> Array:
        array, axis = arrays[path][0], along[path]
        part = array.along(axis)[rows].T if isinstance(array, Turned) else array[rows] if axis == 0 else array[:, rows]
        values = np.asarray(part, dtype=np.float64)
        return values if axis == 0 else values.T


def _version_4(first: bytes) -> bool:
    """Return True if a file begins as version 4: type (MOPT), rows, columns, complex or not, length of the name."""
    for order in ("<i4", ">i4"):
        if len(first) > 20:
            kind, rows, columns, imaginary, name = np.frombuffer(first[:20], order).tolist()
            good = 0 <= kind < 5000 and kind % 100 // 10 <= 5 and rows >= 0 and columns >= 0
            if good and imaginary in (0, 1) and 1 < name <= 64 and first[19 + name : 20 + name] == b"\0":
                return True
    return False
