"""Recordings as text, or as the sheet of a workbook: one row a line, columns by name from the header.

::

    block of bytes  ->  polars, where every line has as many fields as the header and every cell is a number
                    ->  else line by line, which is slow and says what is wrong, and where

Lines that begin with `#` and blank lines are skipped, SKIPPED bytes of them at most; an empty cell is NaN, and so is
one of the texts MISSING. A last line that its writer did not finish is left out and reported. A gzip archive of such a
file is read as it is, and `-` is standard input. Text in UTF-16 is turned into UTF-8 first.
"""

from __future__ import annotations

import codecs
import io
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import Field, model_validator

from fusion_core.budget import COPIED, TEXTS, check_all, keep, size_of, unpacked_at_most
from fusion_core.chunk import Array
from fusion_core.contracts import Block, Table, foreign, recognised
from fusion_core.errors import BadValue, EmptyRecording, MissingChannel, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_core.units import problem
from fusion_plugins.sources.dialect import (
    JOINED,
    TimeOfDay,
    bare,
    called,
    dialect_of,
    fields_of,
    has_day,
    names_of,
    numbers_of,
    seconds_of,
)
from fusion_plugins.sources.joining import TableSource
from fusion_plugins.sources.unpacked import Stream, beginning, opened

Item = TypeVar("Item")
BLOCK = 8 << 20  # bytes parsed at a time
LONGEST = 1 << 20  # bytes of a line
COLUMNS = 10_000  # of a file
SKIPPED = 4_000_000_000  # bytes of comments and blank lines, of a file; TEXTS of them before its first row
SLOW = 40  # times as many for each line that is left out by itself
COMMENTS, BLANK = re.compile(rb"^#[^\n]*(?:\n|\Z)", re.M), re.compile(rb"^(?:#[^\n]*|[^\S\n]+)?(?:\n|\Z)", re.M)
FIRST = re.compile(rb"^(?!#)[^\S\n]*\S[^\n]*", re.M)  # line that is neither
SEPARATORS = {",": ",", ";": ";", "\t": "\\t", "|": "|", " ": " "}  # and how each is shown
BLANKS, EDGES = re.compile(rb"[ \t]+"), re.compile(rb"^[ \t]+|[ \t]+(?=\r?$)", re.M)
MARKS = {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}  # of encodings, at the beginning
MISSING = ("n/a", "N/A", "NA", "#N/A", "null", "NULL", "None")  # texts of an empty cell
COMMA = str.maketrans(",.", ".,")
GUESSED = 1 << 18  # bytes that are looked at to tell how a text is a table


@hookimpl
class Csv(TableSource):
    """A text file with a header line, or a gzip archive of one; the path `-` is standard input."""

    suffixes: ClassVar[tuple[str, ...]] = (".csv", ".tsv", ".txt", ".csv.gz")

    kind: Literal["csv"] = "csv"
    separator: Literal[",", ";", "\t", "|", " "] = ","
    """Separator of the cells of a line; a blank stands for any number of blanks and tabs."""
    decimal: Literal[".", ","] = "."
    """Decimal sign of the numbers."""
    header: Annotated[int, Field(ge=0)] | None = None
    """Line of the columns' names, 0 where there is none: columns are then called 1, 2, ...; by default the first line
    that is neither blank nor begins with `#`."""
    first_row: Annotated[int, Field(ge=1)] | None = None
    """Line of the first row, where lines of units or the like are between it and the names."""
    dates: Mapping[str, str] = Field(default_factory=dict)
    """Format of the dates of a column, as `%d.%m.%Y %H:%M:%S`; `Date + Time` is two columns, joined by a blank. A time
    without a day goes on over midnight."""
    flags: Mapping[str, str] = Field(default_factory=dict)
    """Text of a column that is 1, any other is 0, as `status: OK` where the channel `valid` is of this column."""

    @model_validator(mode="after")
    def _check_signs(self) -> Self:
        if self.separator == self.decimal:
            raise problem("the separator and the decimal sign are both ','; correct one of them")
        return self

    @classmethod
    def settings_for(cls, path: Path, known: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings under which a text can be read, by its first lines."""
        with cls.model_construct(**known).lines_of(path) as file:
            data = file.read(GUESSED)
        if data.lstrip()[:1] in (b"{", b"<"):
            what = "JSON" if data.lstrip()[:1] == b"{" else "XML"
            raise UnreadableFile(f"{path}: is {what}, a table of lines and cells was expected; write it as CSV")
        lines = decoded(data[: data.rfind(b"\n") + 1] or data).removesuffix("\n").split("\n")
        found = dialect_of(lines, known)
        if found is None:
            return known
        between = [line for line in lines[found.header : found.first_row - 1] if BLANK.fullmatch(line.encode()) is None]
        usual = next((k for k, line in enumerate(lines, 1) if BLANK.fullmatch(line.encode()) is None), 0)
        settings = {
            "separator": found.separator,
            "decimal": found.decimal,
            "header": None if found.header == usual and not between else found.header,
            "first_row": found.first_row if between else None,
            "dates": found.dates,
        }
        defaults = {name: cls.model_fields[name].default for name in settings}
        return {**{k: v for k, v in settings.items() if v == 0 or (v and v != defaults[k])}, **known}

    @contextmanager
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the file; raises UnreadableFile where it is of another kind."""
        with self.lines_of(path) as file:
            yield CsvLines(path, file, self, faults)

    @contextmanager
    def lines_of(self, path: Path) -> Iterator[Stream]:
        """Open the text of a file, in UTF-8 where it is in UTF-16."""
        with opened(path) as file:
            first = beginning(file, path)
            if recognised(first):
                raise foreign(path, first, self.kind)
            if encoding := next((name for mark, name in MARKS.items() if first.startswith(mark)), None):
                decoder = codecs.getincrementaldecoder(encoding)("replace")
                with stream_of(path, (decoder.decode(data) for data in iter(partial(file.read, COPIED), b""))) as text:
                    yield text
                return
            if b"\0" in first.partition(b"\n")[0]:
                raise UnreadableFile(f"{path}: is not UTF-8 text; save it as UTF-8")
            yield file


@contextmanager
def stream_of(path: Path, texts: Iterator[str]) -> Iterator[Stream]:
    """Open a temporary file with the texts that a file is turned into, as far as the budget allows."""
    with tempfile.TemporaryFile() as file:
        for text in texts:
            check_all()
            keep(path, text.encode(), file, unpacked_at_most(path))
        file.seek(0)
        yield io.BufferedReader(file.raw)


def decoded(data: bytes) -> str:
    """Return the text of bytes, in UTF-8 or else Latin-1."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


class CsvLines(Table):
    """The lines of an open file, under the settings of its source."""

    def __init__(self, path: Path, file: Stream, settings: Csv, faults: Faults) -> None:
        self.path, self.file, self.faults = path, file, faults
        self.settings, self.separator = settings, settings.separator
        self.skipped, self.most = 0, TEXTS  # bytes of comments and blank lines, and how many there may be
        self.line = 1  # number of the first line of the block that is read
        self.units: list[str] = []
        self.again: re.Pattern[bytes] | None = None  # the line of the names, where a logger writes it once more
        self.texts = {part for path in settings.dates for part in self._parts(path)} | settings.flags.keys()
        self.flagged = settings.channels["valid"].paths if "valid" in settings.channels else ()
        self.columns = self._names()
        self._check_header()

    @property
    def names(self) -> Sequence[str]:
        """The columns' names."""
        dates, columns = self.settings.dates, [name for name in self.columns if name and name not in self.texts]
        return [*columns, *dates, *(name for name in self.settings.flags if name in self.columns)]

    def unit(self, path: str) -> str | None:
        """Return s of a date; of another column what the line below its name says."""
        if path in self.settings.dates:
            return "s"
        place = self.columns.index(path) if path in self.columns else len(self.units)
        return self.units[place].strip(" ()[]") or None if place < len(self.units) else None

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of about `BLOCK` bytes, in order."""
        parts = [part for path in paths for part in self._parts(path)]
        for part in parts:
            if (count := self.columns.count(part)) > 1:
                raise BadValue(f"{self.path}: has {count} columns '{part}', one was expected; rename the others")
        at = {part: self.columns.index(part) for part in parts}
        clocks = {path: TimeOfDay() for path, form in self._dates(at) if not has_day(form)}
        parsed = self._parsed(at)
        for block, final, values in _ahead(parsed) if self.path.is_file() else parsed:  # a pipe may keep one waiting
            if values is None:
                cells, unfinished = self._without(block), final and not block.endswith(b"\n")
                values = self._fast(cells, at) if cells and cells != block and not unfinished else None
                values = self._careful(block, cells, at, final) if values is None else values
            values |= {path: clock.unwrapped(values[path]) for path, clock in clocks.items()}
            rows = len(next(iter(values.values()), ()))
            if rows:
                self.most = SKIPPED
                yield Block(rows, values.__getitem__)
            else:
                self._skip(len(block))
            self.line += block.count(b"\n")

    def _parsed(self, at: dict[str, int]) -> Iterator[tuple[bytes, bool, dict[str, Array] | None]]:
        """Yield blocks, whether the file ends there, and their columns; None of one that has to be looked at."""
        for _, block, final in self._pieces():
            if self.separator == " ":
                block = EDGES.sub(b"", BLANKS.sub(b" ", block))
            yield block, final, None if final and not block.endswith(b"\n") else self._fast(block, at)

    def _parts(self, path: str) -> list[str]:
        """Return the columns that a path names: those of a date and of a time may be two."""
        return path.split(JOINED) if path in self.settings.dates else [path]

    def _names(self) -> list[str]:
        """Return the names of the columns, and leave the file before the first row."""
        header, first = self.settings.header, self.settings.first_row
        if header is None and first is None:
            return self._widened(called(self._fields(self._again(self._header()))))
        skipped = [decoded(self.file.readline(LONGEST)) for _ in range(max(header or 0, (first or 1) - 1))]
        self.line += len(skipped)
        self._skip(sum(map(len, skipped)))
        if not header:
            cells = bare(self._fields(self._next_line()))
            return self._widened([str(k + 1) for k in range(len(cells))])
        if header > len(skipped) or not skipped[header - 1]:
            raise EmptyRecording(f"{self.path}: has fewer than {header} lines; correct source.header")
        rest = [names_of(line, self.separator) for line in skipped[header:] if line.strip()]
        names = names_of(self._again(skipped[header - 1]), self.separator)
        self.units = rest[0] if rest and len(rest[0]) == len(names) else []
        return self._widened(names)

    def _again(self, names: str) -> str:
        """Return the line of the names, which is left out where it stands between rows."""
        line = names.strip("\ufeff\r\n\t ").encode()
        line = BLANKS.sub(b" ", line) if self.separator == " " else line
        if line:
            self.again = re.compile(rb"^[ \t]*" + re.escape(line) + rb"[ \t]*\r?(?:\n|\Z)", re.M)
        return names

    def _next_line(self) -> str:
        """Return the next line that is neither blank nor a comment, and stay before it."""
        place, first = self.file.tell(), None
        for offset, block, _ in self._pieces():
            if (first := FIRST.search(block)) or offset - place > self.most:
                break
        self.file.seek(place)
        return decoded(first.group()) if first else ""

    def _widened(self, names: list[str]) -> list[str]:
        """Return the names with an empty one, or less one, where rows end with a separator and these do not, or do."""
        cells = self._fields(self._next_line())
        if len(cells) == len(names) + 1 and not cells[-1].strip():
            return [*names, ""]
        spare = names[-1].strip().lower() in ("", "comment")  # as LabVIEW's, which only some rows have
        return names[:-1] if len(cells) == len(names) - 1 > 0 and spare else names

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
            text = decoded(block[begin:end])
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
        if self.again is not None and (first := self.again.search(block)):
            rows, count = self.again.subn(b"", rows)
            where = self.line + block.count(b"\n", 0, first.start())
            self.faults.add("line of the names again, left out", count, f"line {where}")
        self._skip(len(block) - len(rows))
        return rows

    def _check_header(self) -> None:
        if len(self.columns) > COLUMNS:
            raise UnreadableFile(
                f"{self.path}: has {len(self.columns):,} columns, at most {COLUMNS:,} are read; check the separator"
            )
        if self.settings.header is None and all(_number(name) is not None for name in self.columns):
            raise MissingChannel(
                f"{self.path}: the first line has numbers only ({', '.join(self.columns[:4])}, ...), "
                "the columns' names were expected; write them in a line above, or set header: 0"
            )
        other = next((s for s in ",;\t|" if s != self.separator and s in self.columns[0]), None)
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

    def _fast(self, block: bytes, at: dict[str, int], missing: Sequence[str] = ()) -> dict[str, Array] | None:
        """Parse a block with polars; None where a line or a cell is not as it should be.

        Cells of the texts `missing` are empty: a block is only then read with them when it cannot be read without.
        """
        import polars as pl

        n = len(self.columns)
        names = [f"column_{k + 1}" for k in range(n + 1)]  # one more, where a line that is too long shows
        last, extra = names[-2:]
        used = {names[k] for k in at.values()}
        texts = {names[at[part]] for part in self.texts if part in at}
        pointed = self.settings.decimal == "," and b"." in block  # polars takes 12.345 for 12,345
        number = pl.String if pointed else pl.Float64
        try:
            frame = pl.read_csv(
                self.separator.encode() * n + b"\n" + block,  # polars counts the columns of the first line
                has_header=False,
                separator=self.separator,
                comment_prefix="#",
                schema={name: number if name in used - texts else pl.String for name in names},
                decimal_comma=self.settings.decimal == ",",
                null_values=list(missing) or None,
                columns=sorted(used | {last, extra}, key=names.index),
            )[1:]
            if pointed:  # a cell with a point is no number then
                cells = pl.col(sorted(used - texts)).str.strip_chars(" \t\r").str.replace(".", "?", literal=True)
                frame = frame.with_columns(cells.str.replace(",", ".", literal=True).cast(pl.Float64))
        except pl.exceptions.PolarsError:
            return None if missing else self._fast(block, at, MISSING)
        whole = frame[last].null_count() == 0 and frame[extra].null_count() == len(frame) and b'"' not in block
        separators = np.count_nonzero(np.frombuffer(block, np.uint8) == ord(self.separator))
        if not (whole and separators == (n - 1) * len(frame)) and self._lines(block) != len(frame):
            return None
        columns = {part: frame[names[k]] for part, k in at.items()}
        values = {part: column.to_numpy() for part, column in columns.items() if column.dtype == pl.Float64}
        for path, form in self._dates(at):
            parts = [columns[part] for part in self._parts(path)]
            seconds = seconds_of(parts[0] if len(parts) == 1 else parts[0] + " " + parts[1], form)
            if seconds.null_count() > sum(1 for cell in parts[0] if not (cell or "").strip()):
                return None
            values[path] = seconds.to_numpy()
        return values | {path: (columns[path].fill_null("").str.strip_chars() == word).to_numpy().astype(np.float64)
                         for path, word in self._flags(at)}  # fmt: skip

    def _dates(self, at: Mapping[str, int]) -> Iterator[tuple[str, str]]:
        """Yield the columns of dates among those that are read, with their formats."""
        return ((path, form) for path, form in self.settings.dates.items() if all(p in at for p in self._parts(path)))

    def _flags(self, at: Mapping[str, int]) -> Iterator[tuple[str, str]]:
        """Yield the columns of flags among those that are read, with the text that is 1."""
        return ((path, word.strip()) for path, word in self.settings.flags.items() if path in at)

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
        values = dict(zip(at, np.ascontiguousarray(columns), strict=True))
        for path, word in self._flags(at):
            values[path] = np.array([float(self._fields(lines[k])[at[path]].strip() == word) for k in rows])
        for path, form in self._dates(at):
            texts = [" ".join(self._fields(lines[k])[at[part]] for part in self._parts(path)) for k in rows]
            values[path] = numbers_of(texts, form)
            for k, text, value in zip(rows, texts, values[path], strict=True):
                if np.isnan(value) and text.strip() not in ("", *MISSING):
                    raise BadValue(
                        f"{self.path}: line {where(k)}, column '{path}': '{text[:40]}' is not a date as '{form}'; "
                        "correct it, or source.dates"
                    )
        return values

    def _number_of(self, block: bytes, k: int) -> int:
        """Return the number of the k-th line that is kept of the block."""
        left_out = COMMENTS if len(self.columns) == 1 else BLANK
        lines = block.removesuffix(b"\n").split(b"\n")
        again = self.again.fullmatch if self.again is not None else lambda line: None
        kept = ((k, line + b"\n") for k, line in enumerate(lines))
        numbers = (number for number, line in kept if not (left_out.fullmatch(line) or again(line)))
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
            number = 0.0 if path in self.texts else self._number(fields[place])
            if number is None:
                cell, remedy = fields[place][:40], "correct it, or leave the cell empty where the value is missing"
                if path in self.flagged:
                    remedy = f"set source.flags to {{{path}: TEXT}}, with the text of the rows that are valid"
                if self.settings.decimal == "," and "." in cell:
                    remedy = "the decimal sign is ',': remove points between thousands, or correct source.decimal"
                raise BadValue(f"{self.path}: line {where(k)}, column '{path}': '{cell}' is not a number; {remedy}")
            row.append(number)
        return row

    def _torn(self, line: str, at: dict[str, int], *, closed: bool) -> bool:
        """Return True if the last line of the file was not written to its end."""
        fields, n = self._fields(line), len(self.columns)
        if len(fields) < n or closed:
            return len(fields) < n
        return line.count('"') % 2 == 1 or (n - 1 in at.values() and self._number(fields[-1]) is None)

    def _fields(self, line: str) -> list[str]:
        return fields_of(line, self.separator)

    def _number(self, cell: str) -> float | None:
        return _number(cell.translate(COMMA) if self.settings.decimal == "," else cell)


def _ahead(items: Iterator[Item]) -> Iterator[Item]:
    """Yield items, none of them None, each made by another thread while the one before is used."""
    with ThreadPoolExecutor(1) as thread:
        made = thread.submit(next, items, None)
        while (item := made.result()) is not None:
            made = thread.submit(next, items, None)
            yield item


def _number(cell: str) -> float | None:
    """Return the number in a cell, NaN where it is empty or says so, None where there is something else."""
    if "_" in cell or not cell.isascii():  # which Python takes for part of a number
        return None
    cell = cell.strip()
    if cell[:1] in ("+", "-"):
        cell = cell[0] + cell[1:].lstrip(" ")  # a sign in a place of its own
    try:
        return np.nan if cell in ("", *MISSING) else float(cell)
    except ValueError:
        return None
