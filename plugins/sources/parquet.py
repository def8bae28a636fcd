"""Recordings as columns of a Parquet file, read by polars, span after span of rows.

::

    path of a channel        column
    gx                       a column of numbers
    imu.gyro.x               a field of a struct
    gyro                     lists of one length, or arrays: one column an axis

Times of day, durations and time stamps with a date come as seconds; a null is NaN. No other column is read.

A page of 2 GB, a row group of 1e9 rows and a row with a list of 1e9 values take a few bytes of a file each. So the
layout that the file declares is looked at before anything is unpacked::

    footer    schema: a tree of columns          row groups: rows, and of each column where its pages are
    page      header: bytes packed and unpacked, number of values             then the bytes

Rows are read in spans that are bounded, and what cannot be cut (a page, a list) is refused where it is too large.
Headers are structs of Thrift's compact protocol. Source: parquet.apache.org/docs/file-format, Apache Thrift's
thrift-compact-protocol.md.
"""

from __future__ import annotations

import mmap
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np

from fusion_core.budget import PIECE, TimeBudget, check_count, check_size
from fusion_core.chunk import Array
from fusion_core.contracts import Block, Table, foreign, head
from fusion_core.errors import BadValue
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.joining import TableSource
from fusion_plugins.sources.unpacked import damaged, translated, unpacking

if TYPE_CHECKING:
    import polars as pl


SIGNATURE = b"PAR1"
WIDE = 1024  # values of a list that can be channels


@hookimpl
class Parquet(TableSource):
    """A Parquet file."""

    signatures: ClassVar[tuple[bytes, ...]] = (SIGNATURE,)
    suffixes: ClassVar[tuple[str, ...]] = (".parquet", ".pq")

    kind: Literal["parquet"] = "parquet"

    @unpacking
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the file; raises UnreadableFile where it is of another kind or damaged."""
        import polars as pl

        first = head(path)
        if not (first.startswith(SIGNATURE) or SIGNATURE.startswith(first)):
            raise foreign(path, first, self.kind)
        with translated(path, pl.exceptions.PolarsError, OSError):
            yield ParquetColumns(path)


class Column(NamedTuple):
    """A column of a file, or a field of one that is a struct: the column's name, its path, expression and type."""

    top: str
    path: str
    expression: pl.Expr
    kind: pl.DataType


class ParquetColumns(Table):
    """The columns of a file, and the fields of those that are structs."""

    def __init__(self, path: Path) -> None:
        import polars as pl

        self.path = path
        self.layout = RowGroups(path)
        self.frame = pl.scan_parquet(path, glob=False)
        schema = self.frame.collect_schema()
        self.columns: dict[str, Column] = {}
        for name, kind in schema.items():
            for column in _with_fields(name, name, pl.col(name), kind):
                self.columns.setdefault(column.path, column)

    @cached_property
    def names(self) -> Sequence[str]:
        """Every column, and in place of a struct its fields."""
        return [path for path, column in self.columns.items() if not hasattr(column.kind, "fields")]

    def has(self, path: str) -> bool:
        """Return True if `path` is a column, or a field of a struct."""
        return path in self.columns

    def unit(self, path: str) -> str | None:
        """Return `s` for a time or a duration."""
        return "s" if self.has(path) and self.columns[path].kind.is_temporal() else None

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of about `size` rows."""
        numbers = [self._numbers(path).alias(str(k)) for k, path in enumerate(paths)]
        for frame in self._frames(numbers, paths):
            for part in frame.iter_slices(size):
                yield Block(len(part), partial(self._read, part, list(paths)))

    def _frames(self, columns: Sequence[pl.Expr], paths: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield expressions of columns as data frames of some rows; the next one is read while one is used."""
        waiting: Future[pl.DataFrame] | None = None
        with ThreadPoolExecutor(1) as reader:
            for begin, rows in self.layout.spans({self.columns[path].top for path in paths}):
                query = self.frame.slice(begin, rows).select(columns)
                done, waiting = waiting, reader.submit(query.collect)
                if done is not None:
                    yield done.result()
                    del done
            if waiting is not None:
                yield waiting.result()

    def _numbers(self, path: str) -> pl.Expr:
        """Return the column as numbers in seconds where it is a time; raises BadValue where it is none."""
        import polars as pl

        _, _, column, kind = self.columns[path]
        if isinstance(kind, pl.List | pl.Array):
            inner = _instance(kind.inner)
            if inner.is_numeric() or inner == pl.Boolean:
                return self._axes(path, column, kind)
        elif kind == pl.Date:
            return column.cast(pl.Datetime("us")).cast(pl.Int64) / 1e6
        elif isinstance(kind, pl.Datetime | pl.Duration):
            return column.cast(pl.Int64) / {"ns": 1e9, "us": 1e6, "ms": 1e3}[kind.time_unit]
        elif kind == pl.Time:
            return column.cast(pl.Int64) / 1e9
        elif kind.is_numeric() or kind == pl.Boolean:
            return column.cast(pl.Float64)
        field = next((name for name in self.names if name.startswith(f"{path}.")), path)
        fields = isinstance(kind, pl.Struct)
        advice = f"name a field of it, e.g. '{field}'" if fields else "name another column, or write it as numbers"
        raise BadValue(f"{self.path}: column '{path}' is {kind}, numbers were expected; {advice}")

    def _axes(self, path: str, column: pl.Expr, kind: pl.DataType) -> pl.Expr:
        """Return lists as arrays of one length: that of the first row which has one."""
        import polars as pl

        if isinstance(kind, pl.Array):
            self._check_width(path, int(np.prod(kind.shape, dtype=np.float64)))
            return column.cast(pl.Array(pl.Float64, kind.shape))
        lengths = column.list.len()
        query = [lengths.min().alias("least"), lengths.max().alias("most")]
        rows = [row for frame in self._frames(query, [path]) for row in frame.rows() if row[0] is not None]
        least, most = min((row[0] for row in rows), default=1), max((row[1] for row in rows), default=1)
        if least != most:
            raise BadValue(
                f"{self.path}: column '{path}' has lists of {least} to {most} values, lists of one length were "
                "expected; write one column an axis"
            )
        self._check_width(path, most)
        return column.cast(pl.List(pl.Float64)).list.to_array(most or 1)

    def _check_width(self, path: str, width: int) -> None:
        if width > WIDE:
            raise BadValue(
                f"{self.path}: column '{path}' has lists of {width:,} values, at most {WIDE:,} are read; write one "
                "column an axis"
            )

    def _read(self, frame: pl.DataFrame, paths: list[str], path: str) -> Array:
        import polars as pl

        column = frame[str(paths.index(path))]
        if isinstance(column.dtype, pl.Array):
            width = column.dtype.shape[0]
            flat = column.fill_null([None] * width).explode().fill_null(np.nan)
            return flat.to_numpy().reshape(len(frame), width)
        values: Array = column.fill_null(np.nan).to_numpy()
        return values


def _with_fields(top: str, path: str, column: pl.Expr, kind: pl.DataType) -> Iterator[Column]:
    """Yield a column, and of a struct its fields, with all that is in them."""
    import polars as pl

    yield Column(top, path, column, kind)
    for field in kind.fields if isinstance(kind, pl.Struct) else ():
        inner = _instance(field.dtype)
        yield from _with_fields(top, f"{path}.{field.name}", column.struct.field(field.name), inner)


def _instance(kind: Any) -> pl.DataType:
    """Return a type as an instance, where a field or a list names a class."""
    import polars as pl

    return pl.Series(dtype=kind).dtype


SPAN = 128_000_000  # bytes of rows that are read at a time
GROUP = 8 * PIECE  # bytes of the rows of a row group: each span of them passes over those before it
STORED = PIECE + PIECE // 2  # bytes of a row group in the file
LISTS = PIECE // 2  # bytes of the values of lists in a row group
FOOTER = 16_000_000  # bytes
NODES, COLUMNS, DEEP = 4_000_000, 100_000, 64  # numbers and structs in a footer, columns, and how deep they stand
HEADER = 1 << 16  # bytes of the header of a page
BYTE_ARRAY, FIXED, REPEATED = 6, 7, 2  # types of columns, and their repetition
NUMBER, VIEW = 8, 16  # bytes of a number, and of a text


class Leaf(NamedTuple):
    """A column of numbers or texts: the name at the top of the tree, type, bytes of a value, whether of lists."""

    top: str
    kind: int
    width: int
    lists: bool


class Group(NamedTuple):
    """A row group: its rows, and of each leaf where its pages begin and how many bytes they have."""

    rows: int
    pages: list[tuple[int, int]]


class RowGroups:
    """The row groups of a file.

    Raises
    ------
    UnreadableFile
        If the footer is damaged, or beyond the budget.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.clock = TimeBudget(path, "the headers of its pages")
        try:
            footer = _Struct(self._footer()).read()
            self.leaves = list(_leaves(footer[2]))
            check_count(path, "columns", len(self.leaves), COLUMNS)
            self.groups = [_group(group, len(self.leaves)) for group in footer.get(4, ())]
        except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
            raise damaged(self.path, f"its footer cannot be read, {type(error).__name__}") from None

    def spans(self, columns: Collection[str]) -> Iterator[tuple[int, int]]:
        """Yield first row and number of rows of what can be read at a time; raises UnreadableFile beyond the budget."""
        mine = [k for k, leaf in enumerate(self.leaves) if leaf.top in columns]
        width = sum(self.leaves[k].width for k in mine) or NUMBER
        begin = end = 0
        with self.path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for number, group in enumerate(self.groups, 1):
                with self.clock:
                    self._check(number, group, mine, width, data)
                    self.clock.check(group.rows)
                if end > begin and (end - begin + group.rows) * width > SPAN:
                    yield begin, end - begin
                    begin = end
                end += group.rows
                step = max(SPAN // width, 1)
                while (end - begin) * width > SPAN:
                    yield begin, min(step, end - begin)
                    begin = min(begin + step, end)
        if end > begin:
            yield begin, end - begin

    def _check(self, number: int, group: Group, mine: list[int], width: int, data: mmap.mmap) -> None:
        """Raise UnreadableFile where the wanted columns of a row group take more than the budget."""
        what = f"row group {number} of {group.rows:,} rows"
        check_size(self.path, what, group.rows * width, GROUP)
        check_size(self.path, f"{what} in the file", sum(group.pages[k][1] for k in mine), STORED)
        largest = 0
        for k in mine:
            leaf, values, unpacked, most = self.leaves[k], 0, 0, 0
            for size, count in self._pages(*group.pages[k], data):
                values, unpacked, most = values + count, unpacked + size, max(most, size)
            of = f"column '{leaf.top}' of {what}"
            largest += most
            if leaf.lists:
                check_size(self.path, f"{of}, with {values:,} values in its lists,", values * leaf.width, LISTS)
            elif values > group.rows:
                raise damaged(self.path, f"{of} has {values:,} values")
            if leaf.kind == BYTE_ARRAY:
                check_size(self.path, of, unpacked, PIECE)
        check_size(self.path, f"a page of each column of {what}", largest, PIECE)

    def _pages(self, at: int, length: int, data: mmap.mmap) -> Iterator[tuple[int, int]]:
        """Yield bytes when unpacked, and number of values, of the pages of a column."""
        end = at + length
        while at < end:
            self.clock.tick()
            head = _Struct(data[at : min(at + HEADER, end)])
            try:
                header = head.read()
                unpacked, packed = header[2], header[3]
                data_header = header.get(5) or header.get(8) or {}
                count = data_header.get(1, 0)
            except (ValueError, KeyError, IndexError, AttributeError):
                return  # polars says what is wrong with it
            if min(unpacked, packed, count) < 0:
                return
            yield unpacked, count
            at += head.at + packed

    def _footer(self) -> bytes:
        """Return the bytes of the footer."""
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(size - 8, 0))
            tail = file.read(8)
            length = int.from_bytes(tail[:4], "little")
            if len(tail) < 8 or tail[4:] != b"PAR1" or length > size - 8:
                raise damaged(self.path, "it has no footer")
            check_size(self.path, "its footer", length, FOOTER)
            file.seek(size - 8 - length)
            return file.read(length)


def _leaves(schema: list[dict[int, Any]]) -> Iterator[Leaf]:
    """Yield the leaves of the tree of columns, which stands in the file as a list, each node before its children."""
    left = [schema[0][5]]  # children that are still to come, of each node above
    names, lists = [""], [False]
    for node in schema[1:]:
        while left and left[-1] == 0:
            del left[-1], names[-1], lists[-1]
        left[-1] -= 1
        top = names[-1] or node[4].decode("utf-8", "replace")
        repeated = lists[-1] or node.get(3) == REPEATED
        if node.get(5):
            left, names, lists = [*left, node[5]], [*names, top], [*lists, repeated]
            if len(left) > DEEP or node[5] < 0:
                raise ValueError("columns in columns without end")
        else:
            kind = node.get(1, -1)
            width = VIEW if kind == BYTE_ARRAY else max(node.get(2, 0), VIEW) if kind == FIXED else NUMBER
            yield Leaf(top, kind, width, repeated)


def _group(group: dict[int, Any], leaves: int) -> Group:
    """Return a row group, by its struct in the footer."""
    about = [column[3] for column in group[1]]
    pages = [(column.get(11, column[9]), column[7]) for column in about]
    if len(pages) != leaves or min([group[3], *map(min, pages)]) < 0:
        raise ValueError("a row group of other columns, or pages before the file")
    return Group(group[3], pages)


class _Struct:
    """A struct of Thrift's compact protocol: numbers, bytes, lists and structs by the numbers of their fields."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at, self.nodes = data, 0, 0

    def read(self, depth: int = 0) -> dict[int, Any]:
        """Return the fields; raises ValueError or IndexError where they are damaged."""
        fields: dict[int, Any] = {}
        number = 0
        while head := self.data[self.at]:
            self.at += 1
            number = number + (head >> 4) if head >> 4 else self._number()
            kind = head & 15
            fields[number] = kind == 1 if kind in (1, 2) else self._value(kind, depth)
        self.at += 1
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        self.nodes += 1
        if self.nodes > NODES or depth > DEEP:
            raise ValueError("a footer without end")
        if kind in (4, 5, 6):
            return self._number()
        if kind == 8:
            length = self._varint()
            self.at += length
            return self.data[self.at - length : self.at]
        if kind == 12:
            return self.read(depth + 1)
        if kind in (9, 10):
            head = self.data[self.at]
            self.at += 1
            length = head >> 4 if head >> 4 < 15 else self._varint()
            if length > len(self.data) - self.at:
                raise ValueError("a list is cut")
            return [self._value(head & 15, depth + 1) for _ in range(length)]
        if kind in (1, 2, 3, 7):
            self.at += 8 if kind == 7 else 1
            return None
        raise ValueError(f"a value of type {kind}")

    def _varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.data[self.at]
            self.at += 1
            value |= (byte & 127) << shift
            if byte < 128:
                return value
            shift += 7
            if shift > 63:
                raise ValueError("a number without end")

    def _number(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
