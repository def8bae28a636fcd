"""What a Parquet file declares of itself, and what its pages do, before any of them is unpacked.

::

    footer    schema: a tree of columns          row groups: rows, and of each column where its pages are
    page      header: bytes packed and unpacked, number of values             then the bytes

A page of 2 GB, a row group of 1e9 rows and a row with a list of 1e9 values take a few bytes of a file each. So the rows
are read in spans that are bounded, and what cannot be cut (a page, a list) is refused where it is too large. Headers
are structs of Thrift's compact protocol.

Source: parquet.apache.org/docs/file-format, Apache Thrift's thrift-compact-protocol.md.
"""

from __future__ import annotations

import mmap
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from fusion_core.budget import PIECE, TimeBudget, check_count, check_size
from fusion_core.errors import UnreadableFile

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


class Pages(NamedTuple):
    """Where the pages of a column are in a row group."""

    begin: int
    length: int


class Group(NamedTuple):
    """A row group: its rows, and the pages of each leaf."""

    rows: int
    pages: tuple[Pages, ...]


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
            raise self._damaged(f"its footer cannot be read, {type(error).__name__}") from None

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
        check_size(self.path, f"{what} in the file", sum(group.pages[k].length for k in mine), STORED)
        largest = 0
        for k in mine:
            leaf, values, unpacked, most = self.leaves[k], 0, 0, 0
            for size, count in self._pages(group.pages[k], data):
                values, unpacked, most = values + count, unpacked + size, max(most, size)
            of = f"column '{leaf.top}' of {what}"
            largest += most
            if leaf.lists:
                check_size(self.path, f"{of}, with {values:,} values in its lists,", values * leaf.width, LISTS)
            elif values > group.rows:
                raise self._damaged(f"{of} has {values:,} values")
            if leaf.kind == BYTE_ARRAY:
                check_size(self.path, of, unpacked, PIECE)
        check_size(self.path, f"a page of each column of {what}", largest, PIECE)

    def _pages(self, pages: Pages, data: mmap.mmap) -> Iterator[tuple[int, int]]:
        """Yield bytes when unpacked, and number of values, of the pages of a column."""
        at, end = pages.begin, pages.begin + pages.length
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
                raise self._damaged("it has no footer")
            check_size(self.path, "its footer", length, FOOTER)
            file.seek(size - 8 - length)
            return file.read(length)

    def _damaged(self, why: str) -> UnreadableFile:
        return UnreadableFile(f"{self.path}: is cut short or damaged ({why}); copy or record it again")


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
    pages = []
    for column in group[1]:
        about = column[3]
        begin = about.get(11, about[9])
        pages.append(Pages(begin, about[7]))
        if begin < 0 or about[7] < 0:
            raise ValueError("pages before the file")
    if len(pages) != leaves or group[3] < 0:
        raise ValueError("a row group of other columns")
    return Group(group[3], tuple(pages))


class _Struct:
    """A struct of Thrift's compact protocol: numbers, bytes, lists and structs by the numbers of their fields."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at, self.nodes = data, 0, 0

    def read(self, depth: int = 0) -> dict[int, Any]:
        """Return the fields; raises ValueError or IndexError where they are damaged."""
        found: dict[int, Any] = {}
        number = 0
        while head := self.data[self.at]:
            self.at += 1
            number = number + (head >> 4) if head >> 4 else self._number()
            kind = head & 15
            found[number] = kind == 1 if kind in (1, 2) else self._value(kind, depth)
        self.at += 1
        return found

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
