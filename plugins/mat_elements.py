"""The variables of MAT files of versions 4 to 7: their kinds, and the numbers of those that are arrays.

A file of version 5 (and 6, 7) is elements, each with its type and its bytes; in 7 a variable is a zlib stream. Only
the description of a variable is read before it is asked for, and no stream is inflated further than the budget. Source:
MAT-File Format, The MathWorks (2023).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fusion_core.budget import DEEPEST, LISTING, NAMES, PIECE, TOTAL, TimeBudget, check_size

STEP = 1 << 20  # bytes inflated at once
SHORT = 1 << 16  # bytes of the description of a variable: its dimensions, its name
NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"
}  # fmt: skip
MATRIX, COMPRESSED = 14, 15
ENCODINGS = {4: "utf-16-le", 17: "utf-16-le", 18: "utf-32-le"}  # of texts; the others are of UTF-8
CELL, STRUCT, TEXT, OPAQUE, COMPLEX = 1, 2, 4, 17, 1 << 11
KINDS = {1: "a cell array", 3: "an object of a class", 4: "text", 5: "a sparse matrix", 16: "a function"}
OLD = ("f8", "f4", "i4", "i2", "u2", "u1")  # numbers of version 4


@dataclass(frozen=True)
class Variable:
    """A variable, or a field of one: an array of numbers, with `array` where it is loaded, or else `what` it is.

    A text that is loaded is in `text`, the cells of an array of them are in `cells`.
    """

    name: str
    what: str = ""
    shape: tuple[int, ...] = (0, 0)
    array: NDArray[Any] | None = None
    fields: Mapping[str, Variable] | None = None
    text: str = ""
    cells: tuple[Variable, ...] = ()


class Plain:
    """The bytes of an open file as they are."""

    def __init__(self, path: Path, file: BinaryIO, at: int) -> None:
        self.path, self.file, self.at = path, file, at

    def read(self, count: int) -> bytes:
        """Return the next bytes; raises ValueError where they are missing."""
        self.file.seek(self.at)
        self.at += count
        return _whole(self.file, count)

    def skip(self, count: int) -> None:
        """Leave out the next bytes."""
        self.at += count

    def numbers(self, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the array that begins here, column after column, and stay here."""
        return _mapped(self.file, self.at, dtype, shape)


class Inflating:
    """The bytes that a zlib stream in an open file holds.

    Parameters
    ----------
    path, file : Path, file
        The file.
    at, size : int
        Where the stream is.
    clock : Clock
        Of what is left out.
    """

    def __init__(self, path: Path, file: BinaryIO, at: int, size: int, clock: TimeBudget) -> None:
        self.path, self.file, self.place, self.left, self.clock = path, file, at, size, clock
        self.engine, self.rest, self.at = zlib.decompressobj(), b"", 0

    def read(self, count: int) -> bytes:
        """Return the next bytes; raises ValueError where they are missing."""
        check_size(self.path, "one element of it", count)
        return b"".join(self._pieces(count))

    def skip(self, count: int) -> None:
        """Inflate the next bytes and leave them out."""
        for _ in self._pieces(count):
            self.clock.check()

    def numbers(self, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the array that begins here, and go behind it."""
        values, filled = np.empty(math.prod(shape) * dtype.itemsize, np.uint8), 0
        for piece in self._pieces(len(values)):
            values[filled : filled + len(piece)] = np.frombuffer(piece, np.uint8)
            filled += len(piece)
        return values.view(dtype).reshape(shape, order="F")

    def check_end(self) -> None:
        """Raise ValueError where more than the padding of the last element follows, or the checksum is wrong."""
        over = 0
        while not self.engine.eof:
            piece = self._next(8)
            over += len(piece)
            if over > 7 or not (piece or self.engine.eof):
                raise ValueError("a compressed variable does not end where it should")

    def _pieces(self, count: int) -> Iterator[bytes]:
        self.at += count
        while count:
            piece = self._next(min(count, STEP))
            if not piece:
                raise ValueError("a compressed variable is cut short")
            count -= len(piece)
            yield piece

    def _next(self, most: int) -> bytes:
        """Return some bytes, at most `most`; none at the end."""
        while not self.engine.eof:
            if not self.rest and self.left:
                self.file.seek(self.place)
                self.rest = self.file.read(min(self.left, STEP))
                self.place, self.left = self.place + len(self.rest), self.left - len(self.rest)
            had = bool(self.rest)
            piece = self.engine.decompress(self.rest, most)
            self.rest = self.engine.unconsumed_tail
            if piece or not had:
                return piece
        return b""


Stream = Plain | Inflating


class Elements:
    """The elements of a file of version 5, 6 or 7, in one byte order."""

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self.path, self.file, self.size = path, file, size
        file.seek(126)
        self.order = ">" if file.read(2) == b"MI" else "<"
        self.clock = TimeBudget(path, "looking for its variables", LISTING)
        self.fields = self.bytes = 0

    def variables(self) -> Iterator[tuple[Variable, int]]:
        """Yield each variable, its numbers left out, and where it is; a later one of the same name replaces it."""
        at = 128
        if self.size < at:
            raise ValueError("the file ends within its head")
        while at < self.size:
            _, size, _ = self._tag(Plain(self.path, self.file, at))
            if size <= 0:
                raise ValueError("an element has no bytes")
            variable = self._top(at, load=False)
            if variable is not None:
                yield variable, at
            at += 8 + size
            self.clock.check()

    def load(self, at: int) -> Variable | None:
        """Return the variable at a place with its numbers."""
        return self._top(at, load=True)

    def _top(self, at: int, *, load: bool) -> Variable | None:
        stream: Stream = Plain(self.path, self.file, at)
        kind, size, _ = self._tag(stream)
        if kind == COMPRESSED:
            stream = Inflating(self.path, self.file, at + 8, size, self.clock)
            kind, size, _ = self._tag(stream)
        if kind != MATRIX:
            raise ValueError(f"a variable was expected, an element of type {kind} was found")
        variable = self._matrix(stream, stream.at + size, load, depth=0)
        if load and isinstance(stream, Inflating) and variable.what == "":
            stream.check_end()
        return variable if variable.name else None  # without a name it is MATLAB's own

    def _matrix(self, stream: Stream, end: int, load: bool, depth: int) -> Variable:
        """Return the variable from here to `end`; where it is loaded, the stream is behind its last number."""
        if stream.at == end:
            return Variable("", array=np.empty((0, 0)))
        flags = int(np.frombuffer(stream.read(16)[8:12], f"{self.order}u4")[0])
        kind = flags & 0xFF
        if kind == OPAQUE:
            name, _, cls = (self._element(stream).decode("latin-1") for _ in range(3))
            return Variable(name, f"an object of class {cls}", ())
        shape = tuple(np.frombuffer(self._element(stream), f"{self.order}i4").tolist())
        name = self._element(stream).decode("latin-1")
        if min(shape, default=-1) < 0:
            raise ValueError(f"a variable has the dimensions {shape}")
        if kind == STRUCT:
            if math.prod(shape) != 1:
                return Variable(name, f"an array of {math.prod(shape)} structs", shape)
            return Variable(name, "a struct", shape, fields=self._fields(stream, load, depth))
        if flags & COMPLEX and kind not in KINDS:
            return Variable(name, "complex", shape)
        if load and kind == TEXT:
            tag, content = self._typed_element(stream)
            return Variable(name, KINDS[kind], shape, text=content.decode(ENCODINGS.get(tag, "utf-8")))
        if load and kind == CELL:
            cells = tuple(self._inner(stream, load, depth) for _ in range(math.prod(shape)))
            return Variable(name, KINDS[kind], shape, cells=cells)
        if kind in KINDS or not 6 <= kind <= 15:
            return Variable(name, KINDS.get(kind, f"of class {kind}"), shape)
        return Variable(name, "", shape, self._numbers(stream, shape) if load else None)

    def _fields(self, stream: Stream, load: bool, depth: int) -> Mapping[str, Variable]:
        width = int(np.frombuffer(self._element(stream), f"{self.order}i4")[0])
        names = self._element(stream, SHORT * 64)
        if width <= 0 or len(names) % width:
            raise ValueError("the names of a struct's fields are damaged")
        fields = {}
        for k in range(0, len(names), width):
            fields[names[k : k + width].partition(b"\0")[0].decode("latin-1")] = self._inner(stream, load, depth)
        return fields

    def _inner(self, stream: Stream, load: bool, depth: int) -> Variable:
        """Return the next field of a struct, or cell of an array of them."""
        self.fields += 1
        if self.fields > NAMES:
            raise ValueError(f"structs have more than {NAMES:,} fields, which is the limit")
        if depth >= DEEPEST:
            raise ValueError(f"structs are within one another more than {DEEPEST} deep, which is the limit")
        kind, size, _ = self._tag(stream)
        if kind != MATRIX:
            raise ValueError(f"a field was expected, an element of type {kind} was found")
        end = stream.at + size
        inner = self._matrix(stream, end, load, depth + 1)
        if stream.at > end:
            raise ValueError("a field is longer than it declares")
        stream.skip(end - stream.at)
        return inner

    def _numbers(self, stream: Stream, shape: tuple[int, ...]) -> NDArray[Any]:
        kind, size, short = self._tag(stream)
        if kind not in NUMBERS:
            raise ValueError(f"numbers of type {kind} are unknown")
        dtype = np.dtype(self.order + NUMBERS[kind])
        if size != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"an array of {shape} has {size} bytes")
        if short is not None:
            return np.frombuffer(short[:size], dtype).reshape(shape, order="F")
        if isinstance(stream, Inflating):
            self.bytes += size
            check_size(self.path, "an array in compressed form", size, PIECE)
            check_size(self.path, "all arrays that are named, in compressed form,", self.bytes, TOTAL - PIECE)
            return stream.numbers(dtype, shape)
        values = stream.numbers(dtype, shape)
        stream.skip(size + -size % 8)
        return values

    def _tag(self, stream: Stream) -> tuple[int, int, bytes | None]:
        """Return type and size of the next element, and its content where that stands in the tag itself."""
        tag = stream.read(8)
        first, second = np.frombuffer(tag, f"{self.order}u4").tolist()
        if first >> 16:
            if first >> 16 > 4:
                raise ValueError("an element is damaged")
            return first & 0xFFFF, first >> 16, tag[4:]
        return first, second, None

    def _element(self, stream: Stream, most: int = SHORT) -> bytes:
        """Return the content of the next element, which tells a variable."""
        return self._typed_element(stream, most)[1]

    def _typed_element(self, stream: Stream, most: int = SHORT) -> tuple[int, bytes]:
        """Return type and content of the next element, which is a short one."""
        kind, size, short = self._tag(stream)
        if short is not None:
            return kind, short[:size]
        check_size(self.path, "what tells a variable", size, most)
        return kind, stream.read(size + -size % 8)[:size]


class Old:
    """The variables of a file of version 4."""

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self.path, self.file, self.size = path, file, size

    def variables(self) -> Iterator[tuple[Variable, int]]:
        """Yield each variable, and where it is."""
        at, clock = 0, TimeBudget(self.path, "looking for its variables", LISTING)
        while at < self.size:
            variable, size = self._read(at)
            yield variable, at
            at += size
            clock.check()

    def load(self, at: int) -> Variable:
        """Return the variable at a place with its numbers."""
        return self._read(at)[0]

    def _read(self, at: int) -> tuple[Variable, int]:
        """Return the variable, and how many bytes it takes."""
        self.file.seek(at)
        head = _whole(self.file, 20)
        order = next((o for o in "<>" if 0 <= int(np.frombuffer(head[:4], f"{o}i4")[0]) < 5000), None)
        if order is None:
            raise ValueError("a variable's type is damaged")
        kind, rows, columns, imaginary, length = np.frombuffer(head, f"{order}i4").tolist()
        number, form = kind % 100 // 10, kind % 10
        if (
            kind // 1000 > 1
            or number > 5
            or min(rows, columns) < 0
            or imaginary not in (0, 1)
            or not 0 < length < SHORT
        ):
            raise ValueError("a variable's description is damaged")
        name = _whole(self.file, length).partition(b"\0")[0].decode("latin-1")
        dtype = np.dtype(order + OLD[number])
        size = rows * columns * dtype.itemsize * (2 if imaginary and form != 2 else 1)
        what = {1: "text", 2: "a sparse matrix"}.get(form, "complex" if imaginary else "")
        if not what and at + 20 + length + size > self.size:
            raise ValueError(f"variable '{name}' of {size} bytes is cut short")
        array = None if what else _mapped(self.file, at + 20 + length, dtype, (rows, columns))
        return Variable(name, what, (rows, columns), array), 20 + length + size


def _mapped(file: BinaryIO, offset: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array in a file, whose rows are read when they are asked for; raises ValueError where it is cut."""
    if 0 in shape:
        return np.empty(shape, dtype)
    return np.memmap(file, dtype, "r", offset, shape, order="F")


def _whole(file: BinaryIO, count: int) -> bytes:
    """Return the next bytes of a file; raises ValueError where they are missing."""
    data = file.read(count)
    if len(data) < count:
        raise ValueError("the file ends before its last variable does")
    return data
