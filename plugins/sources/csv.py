"""Recordings as text: one row a line, columns by name from the header.

::

    block of bytes  ->  polars, where every line has as many fields as the header and every cell is a number
                    ->  else line by line, which is slow and says what is wrong, and where

Lines that begin with `#` and blank lines are skipped, SKIPPED bytes of them at most; an empty cell is NaN. A last line
that its writer did not finish is left out and reported. A gzip archive of such a file is read as it is, and `-` is
standard input.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from fusion_core.budget import TEXTS, size_of
from fusion_core.chunk import Array
from fusion_core.contracts import Block, FileSource, Source, Table, foreign, recognised
from fusion_core.errors import BadValue, EmptyRecording, MissingChannel, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.unpacked import Stream, beginning, opened

BLOCK = 8 << 20  # bytes parsed at a time
LONGEST = 1 << 20  # bytes of a line
COLUMNS = 10_000  # of a file
SKIPPED = 4_000_000_000  # bytes of comments and blank lines, of a file; TEXTS of them before its first row
SLOW = 40  # times as many for each line that is left out by itself
COMMENTS, BLANK = re.compile(rb"^#[^\n]*(?:\n|\Z)", re.M), re.compile(rb"^(?:#[^\n]*|[^\S\n]+)?(?:\n|\Z)", re.M)
FIRST = re.compile(rb"^(?!#)[^\S\n]*\S", re.M)  # of a line that is neither
SEPARATORS = {",": ",", ";": ";", "\t": "\\t"}  # and how each is shown


class Csv(FileSource):
    """A text file with a header line, or a gzip archive of one; the path `-` is standard input."""

    suffixes: ClassVar[tuple[str, ...]] = (".csv", ".tsv", ".txt", ".csv.gz")

    kind: Literal["csv"] = "csv"
    separator: Literal[",", ";", "\t"] = ","
    """Separator of the cells of a line."""

    @contextmanager
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the file; raises UnreadableFile where it is of another kind."""
        with opened(path) as file:
            first = beginning(file, path)
            if recognised(first):
                raise foreign(path, first, self.kind)
            if b"\0" in first.partition(b"\n")[0]:
                raise UnreadableFile(f"{path}: is not UTF-8 text; save it as UTF-8")
            yield CsvLines(path, file, self.separator, faults)


class CsvLines(Table):
    """The lines of an open file."""

    def __init__(self, path: Path, file: Stream, separator: str, faults: Faults) -> None:
        self.path, self.file, self.separator, self.faults = path, file, separator, faults
        self.skipped, self.most = 0, TEXTS  # bytes of comments and blank lines, and how many there may be
        self.line = 1  # number of the first line of the block that is read
        self.columns = [name.strip() for name in self._fields(self._header())]
        self._check_header()

    @property
    def names(self) -> Sequence[str]:
        """The columns' names."""
        return [name for name in self.columns if name]

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of about `BLOCK` bytes, in order."""
        for path in paths:
            if (count := self.columns.count(path)) > 1:
                raise BadValue(f"{self.path}: has {count} columns '{path}', one was expected; rename the others")
        at = {path: self.columns.index(path) for path in paths}
        for _, block, final in self._pieces():
            unfinished = final and not block.endswith(b"\n")
            values = None if unfinished else self._fast(block, at)
            if values is None:
                cells = self._without(block)
                values = self._fast(cells, at) if cells and cells != block and not unfinished else None
                values = self._careful(block, cells, at, final) if values is None else values
            rows = len(next(iter(values.values()), ()))
            if rows:
                self.most = SKIPPED
                yield Block(rows, values.__getitem__)
            else:
                self._skip(len(block))
            self.line += block.count(b"\n")

    def _header(self) -> str:
        """Return the first line that is neither blank nor a comment, and leave the file after it."""
        for offset, block, _ in self._pieces():
            first = FIRST.search(block)
            begin = first.start() if first else len(block)
            end = block.find(b"\n", begin) + 1 or len(block)
            self._skip(begin)
            self.line += block.count(b"\n", 0, end)
            if first is None:
                continue
            if end - begin > LONGEST:
                raise self._too_long()
            self.file.seek(offset + end)
            try:
                text = block[begin:end].decode("utf-8" if offset + begin else "utf-8-sig")
            except UnicodeDecodeError:
                text = block[begin:end].decode("latin-1")
            if text.strip() and not text.startswith("#"):
                return text
            self._skip(BLOCK)  # such a line is looked for in a block of its own
            return self._header()
        raise EmptyRecording(f"{self.path}: has no header line; write the columns' names in the first line")

    def _skip(self, count: int) -> None:
        self.skipped += count
        if self.skipped > self.most:
            where = " before its first row" if self.most < SKIPPED else ""
            raise UnreadableFile(
                f"{self.path}: has more than {size_of(self.most)} of comments and blank lines{where}, which is the "
                "limit; remove them"
            )

    def _too_long(self) -> UnreadableFile:
        return UnreadableFile(
            f"{self.path}: has a line of more than {LONGEST >> 20} MB, a row of numbers was expected; check the path"
        )

    def _without(self, block: bytes) -> bytes:
        """Return a block without its comments, and without blank lines where these are no empty cells."""
        rows = (COMMENTS if len(self.columns) == 1 else BLANK).sub(b"", block)
        self._skip(len(block) - len(rows))
        return rows

    def _check_header(self) -> None:
        if len(self.columns) > COLUMNS:
            raise UnreadableFile(
                f"{self.path}: has {len(self.columns):,} columns, at most {COLUMNS:,} are read; check the separator"
            )
        if all(_number(name) is not None for name in self.columns):
            raise MissingChannel(
                f"{self.path}: the first line has numbers only ({', '.join(self.columns[:4])}, ...), "
                "the columns' names were expected; write them in a line above"
            )
        other = next((s for s in SEPARATORS if s != self.separator and s in self.columns[0]), None)
        if len(self.columns) == 1 and other:
            raise MissingChannel(
                f"{self.path}: the header has no '{SEPARATORS[self.separator]}' and is a single column; "
                f'set separator: "{SEPARATORS[other]}"'
            )

    def _pieces(self) -> Iterator[tuple[int, bytes, bool]]:
        """Yield whole lines as (offset in the file, bytes, whether the file ends here)."""
        rest, offset = b"", self.file.tell()
        while data := self.file.read(BLOCK):
            cut = data.rfind(b"\n") + 1
            if not cut and len(rest) > LONGEST:
                raise self._too_long()
            block, rest = b"".join((rest, memoryview(data)[:cut])), rest + data if not cut else data[cut:]
            if cut:
                yield offset, block, not rest and not self.file.peek(1)
                offset += len(block)
        if rest:
            yield offset, rest, True

    def _fast(self, block: bytes, at: dict[str, int]) -> dict[str, Array] | None:
        """Parse a block with polars; None where a line or a cell is not as it should be."""
        import polars as pl

        n = len(self.columns)
        names = [f"column_{k + 1}" for k in range(n + 1)]  # one more, where a line that is too long shows
        last, extra = names[-2:]
        used = {names[k] for k in at.values()}
        try:
            frame = pl.read_csv(
                self.separator.encode() * n + b"\n" + block,  # polars counts the columns of the first line
                has_header=False,
                separator=self.separator,
                comment_prefix="#",
                schema={name: pl.Float64 if name in used else pl.String for name in names},
                columns=sorted(used | {last, extra}, key=names.index),
            )[1:]
        except pl.exceptions.PolarsError:
            return None
        whole = frame[last].null_count() == 0 and frame[extra].null_count() == len(frame) and b'"' not in block
        separators = np.count_nonzero(np.frombuffer(block, np.uint8) == ord(self.separator))
        if not (whole and separators == (n - 1) * len(frame)) and self._lines(block) != len(frame):
            return None
        return {path: frame[names[k]].to_numpy() for path, k in at.items()}

    def _lines(self, block: bytes) -> int | None:
        """Return the number of lines where each has as many fields as the header, or None."""
        text = np.frombuffer(block, np.uint8)
        ends = text[np.flatnonzero((text == ord("\n")) | (text == ord(self.separator)))] == ord("\n")
        n = len(self.columns)
        if len(ends) % n:
            return None
        grid = ends.reshape(-1, n)
        return len(grid) if np.all(grid[:, -1]) and not np.any(grid[:, :-1]) else None

    def _careful(self, block: bytes, cells: bytes, at: dict[str, int], final: bool) -> dict[str, Array]:
        """Parse the lines of a block, whose comments `cells` lacks, one by one; raises BadValue."""
        text = cells.decode("utf-8", "replace").removesuffix("\n")
        lines = [line.rstrip("\r") for line in text.split("\n")] if cells else []
        one = len(self.columns) == 1  # then a blank line is an empty cell
        rows = [k for k, line in enumerate(lines) if not line.startswith("#") and (one or line.strip())]
        self._skip(SLOW * (len(lines) - len(rows)))
        where = partial(self._number_of, block)
        if final and rows and self._torn(lines[rows[-1]], at, closed=block.endswith(b"\n")):
            self.faults.add("torn last line, left out", 1, f"line {where(rows.pop())}")
        numbers = [self._row(lines[k], at, where, k) for k in rows]
        columns = np.array(numbers, dtype=np.float64).reshape(len(numbers), len(at)).T
        return dict(zip(at, np.ascontiguousarray(columns), strict=True))

    def _number_of(self, block: bytes, k: int) -> int:
        """Return the number of the k-th line that is kept of the block."""
        left_out = COMMENTS if len(self.columns) == 1 else BLANK
        lines = block.removesuffix(b"\n").split(b"\n")
        numbers = (number for number, line in enumerate(lines) if not left_out.fullmatch(line + b"\n"))
        return self.line + next(islice(numbers, k, None), len(lines))

    def _row(self, line: str, at: dict[str, int], where: Callable[[int], int], k: int) -> list[float]:
        """Return the numbers of a line, whose number is `where(k)`."""
        fields, row = self._fields(line), []
        if len(fields) != len(self.columns):
            raise BadValue(
                f"{self.path}: line {where(k)} has {len(fields)} fields, "
                f"{len(self.columns)} were expected as in the header; correct or remove the line"
            )
        for path, place in at.items():
            number = _number(fields[place])
            if number is None:
                raise BadValue(
                    f"{self.path}: line {where(k)}, column '{path}': '{fields[place][:40]}' is "
                    "not a number; correct it, or leave the cell empty where the value is missing"
                )
            row.append(number)
        return row

    def _torn(self, line: str, at: dict[str, int], *, closed: bool) -> bool:
        """Return True if the last line of the file was not written to its end."""
        fields, n = self._fields(line), len(self.columns)
        if len(fields) < n or closed:
            return len(fields) < n
        return line.count('"') % 2 == 1 or (n - 1 in at.values() and _number(fields[-1]) is None)

    def _fields(self, line: str) -> list[str]:
        line = line.rstrip("\r\n")
        if '"' in line:
            with suppress(csv.Error):
                return next(csv.reader([line], delimiter=self.separator))
        return line.split(self.separator)


def _number(cell: str) -> float | None:
    """Return the number in a cell, NaN where it is empty, None where there is something else."""
    if "_" in cell or not cell.isascii():  # which Python takes for part of a number
        return None
    try:
        return float(cell) if cell.strip() else np.nan
    except ValueError:
        return None


@hookimpl
def sources() -> list[type[Source]]:
    """Register the plugin."""
    return [Csv]
