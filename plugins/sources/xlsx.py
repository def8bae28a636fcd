"""Recordings as sheets of a workbook of Excel (`.xlsx`), by python-calamine.

A sheet becomes lines of cells between tabs, and all that holds for a text holds for it: a title above the names, a line
of units, dates. A workbook is unpacked within the budget before the library sees it, and its cells' places are looked
at, since the library makes room for all rows and columns up to the last one.
"""

from __future__ import annotations

import io
import lzma
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import date, datetime, time, timedelta
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Literal

from fusion_core.budget import PIECE, check_size
from fusion_core.contracts import Table, foreign, head
from fusion_core.errors import MissingChannel, UnreadableFile, check_installed
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.csv import Csv, CsvLines, stream_of
from fusion_plugins.sources.unpacked import Stream, plain_file, translated

SIGNATURE = b"PK\x03\x04"
PARTS = re.compile(r"\[Content_Types\]\.xml|_rels/.*|xl/(?:[^/]*\.xml|_rels/.*|worksheets/[^/]*)")
ATTRIBUTES = (  # but for `r`
    rb"(?:[ \t\r\n]+(?!r[ \t\r\n=])[^\s=<>\"'/]+[ \t\r\n]*=[ \t\r\n]*(?:\"[^\"<]*\"|'[^'<]*'))*"
)
PLACE = re.compile(  # of a row or a cell, after the letter of its tag: column and row, or the tag's end without one
    rb"<(?:[^\s<>/:]+:)?(c|row)(?=[\s/>])(?:" + ATTRIBUTES + rb"(?:"
    rb"[ \t\r\n]+r[ \t\r\n]*=[ \t\r\n]*[\"']([A-Za-z]{0,3})(\d{1,7})[\"']|([ \t\r\n]*/?>)))?"
)
SHARED, ITEM = re.compile(rb"\bt\s*=\s*[\"']s[\"']"), re.compile(rb"<(?:[^\s<>/:]+:)?si[\s/>]")  # texts: cell, list
CELL = 64.0  # bytes that one takes
LOOKED_AT = 1000  # rows that tell which columns are moments


@hookimpl
class Xlsx(Csv):
    """A sheet of a workbook of Excel."""

    signatures: ClassVar[tuple[bytes, ...]] = (SIGNATURE,)
    suffixes: ClassVar[tuple[str, ...]] = (".xlsx", ".xlsm")

    kind: Literal["xlsx"] = "xlsx"  # type: ignore[assignment]
    separator: Literal["\t"] = "\t"
    sheet: str | None = None
    """Name of the sheet; the first by default."""

    @classmethod
    def settings_for(cls, path: Path, known: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings under which a sheet can be read: that of most rows."""
        book, names = _workbook(path)
        rows = {name: _sheet(path, book, name).total_height for name in names}
        most = max(rows, key=lambda name: rows[name])
        named = {} if most == names[0] else {"sheet": most}
        found = super().settings_for(path, {"separator": "\t", **named, **known})
        return {name: value for name, value in found.items() if name != "separator" or name in known}

    @contextmanager
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the sheet; raises UnreadableFile where the file is of another kind."""
        with self.lines_of(path) as file:
            yield _Rows(path, file, self, faults)

    @contextmanager
    def lines_of(self, path: Path) -> Iterator[Stream]:
        """Open a sheet as text; raises MissingChannel where there is none of its name."""
        book, names = _workbook(path)
        if self.sheet is not None and self.sheet not in names:
            raise MissingChannel(
                f"{path}: has no sheet '{self.sheet}', it has {', '.join(names)}; correct source.sheet"
            )
        sheet = _sheet(path, book, self.sheet or names[0])
        moments = _moments(islice(_rows(path, sheet), LOOKED_AT))
        with stream_of(path, ("\t".join(_texts(row, moments)) + "\n" for row in _rows(path, sheet))) as text:
            yield text


class _Rows(CsvLines):
    """The rows of a sheet as lines."""

    def _check_header(self) -> None:
        sign = next((s for s in ",;" if s in self.columns[0]), None)
        if len(self.columns) == 1 and sign:
            raise MissingChannel(
                f"{self.path}: the header is the single cell '{self.columns[0][:40]}', a cell for each column was "
                f"expected; split column A into columns at '{sign}'"
            )
        super()._check_header()


def _workbook(path: Path) -> tuple[Any, list[str]]:
    """Return a workbook and the names of its sheets of cells.

    Raises ConfigError without python-calamine, UnreadableFile where it is damaged or none.
    """
    with plain_file(path) as place:
        first = head(place)
        if not first.startswith(SIGNATURE):
            raise foreign(path, first, "xlsx")
        with translated(path, zipfile.BadZipFile, zlib.error, lzma.LZMAError, RuntimeError, EOFError, ValueError,
                        LookupError, OSError):  # fmt: skip
            content = _repacked(place)
    check_installed("xlsx", "python-calamine", "workbooks of Excel", "excel", ", or export the sheet as CSV")
    from python_calamine import CalamineWorkbook, SheetTypeEnum

    with translated(path, Exception):
        book = CalamineWorkbook.from_filelike(content)
    names = [sheet.name for sheet in book.sheets_metadata if sheet.typ is SheetTypeEnum.WorkSheet]
    if not names:
        raise UnreadableFile(f"{path}: has no sheet of cells, one with the recording was expected; check the path")
    return book, names


def _sheet(path: Path, book: Any, name: str) -> Any:
    """Return a sheet; raises UnreadableFile where it is damaged."""
    with translated(path, Exception):
        return book.get_sheet_by_name(name)


def _rows(path: Path, sheet: Any) -> Iterator[list[Any]]:
    """Yield the rows of a sheet; raises UnreadableFile where a cell is none."""
    with translated(path, Exception):
        yield from sheet.iter_rows()


def _repacked(path: Path) -> io.BytesIO:
    """Return the parts of a workbook that are read, unpacked; raises UnreadableFile where they are too large."""
    plain = io.BytesIO()
    longest = cells = 0  # of the texts that cells share, and of the cells of a sheet that do
    with zipfile.ZipFile(path) as packed, zipfile.ZipFile(plain, "w") as parts:
        entries = [entry for entry in packed.infolist() if PARTS.fullmatch(entry.filename)]
        if not any(entry.filename == "xl/workbook.xml" for entry in entries):
            raise UnreadableFile(
                f"{path}: is a zip archive, a workbook of Excel was expected; unpack it, or save the workbook as .xlsx"
            )
        check_size(path, "the workbook", sum(entry.file_size for entry in entries))
        for entry in entries:
            content = packed.read(entry)
            _check_places(path, entry.filename, content)
            items = [len(item) for item in ITEM.split(content)[1:]]
            plainly = b"<!" not in content and content.count(b"<?") < 2  # else an item may seem to end early
            longest = max(longest, max(items) if items and plainly else len(content) * bool(items))
            cells = max(cells, sum(1 for _ in SHARED.finditer(content)))
            parts.writestr(entry.filename, content)
    check_size(path, f"a sheet of {cells:,} texts of up to {longest:,} bytes", float(longest) * cells, 2 * PIECE)
    plain.seek(0)
    return plain


def _check_places(path: Path, part: str, content: bytes) -> None:
    """Raise UnreadableFile where the cells of a part need too much room, or have a place that is none.

    A row or a cell without a place follows the one before it.
    """
    row = column = height = width = count = 0
    known: dict[bytes, int] = {}
    for tag, letters, number, end in PLACE.findall(content):
        if not (end or (number and bool(letters) == (tag == b"c"))):
            raise UnreadableFile(
                f"{path}: {part} has a cell at a place that is none, one from A1 to XFD1048576 was expected; "
                "save it with Excel, or export the sheet as CSV"
            )
        if tag == b"row":
            row, column = int(number) if number else row + 1, 0
            continue
        if letters and letters not in known:
            known[letters] = sum((c - 64) * 26**k for k, c in enumerate(reversed(letters.upper())))
        column = known[letters] if letters else column + 1
        count, width, height = count + 1, max(width, column), max(height, int(number) if number else row)
    what = f"a sheet of {height:,} rows and {width:,} columns"
    check_size(path, what, CELL * max(height * width, count), 2 * PIECE)


def _moments(rows: Iterable[list[Any]]) -> set[int]:
    """Return the columns of moments: of their days most have a time, and a midnight has none."""
    more = Counter[int]()
    for row in rows:
        for k, cell in enumerate(row):
            if isinstance(cell, date):
                more[k] += 1 if isinstance(cell, datetime) else -1
    return {k for k, count in more.items() if count > 0}


def _texts(row: list[Any], moments: Collection[int]) -> Iterator[str]:
    """Yield the cells of a row as texts; a day in a column of `moments` is its midnight, as which it comes."""
    for k, cell in enumerate(row):
        midnight = k in moments and isinstance(cell, date) and not isinstance(cell, datetime)
        yield _text(datetime.combine(cell, time()) if midnight else cell)


def _text(cell: Any) -> str:
    """Return a cell as text: a date in ISO 8601, a duration in s."""
    if isinstance(cell, datetime):
        return cell.isoformat(" ", "microseconds")
    if isinstance(cell, timedelta):
        return f"{cell.total_seconds():.9g}"
    if isinstance(cell, time):
        return cell.isoformat("microseconds")
    return " ".join(cell.split()) if isinstance(cell, str) else str(float(cell) if isinstance(cell, bool) else cell)
