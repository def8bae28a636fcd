"""Recordings as sheets of a workbook of Excel (`.xlsx`), by python-calamine.

A sheet becomes lines of cells between tabs, and all that holds for a text holds for it: a title above the names, a line
of units, dates. A workbook is unpacked within the budget before the library sees it, and its cells' places are looked
at, since the library makes room for all rows and columns up to the last one.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime, time, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal

from fusion_core.budget import PIECE, check_size
from fusion_core.contracts import Source, foreign, head
from fusion_core.errors import ConfigError, MissingChannel
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.csv import Csv, stream_of
from fusion_plugins.sources.unpacked import Stream, plain_file, translated

SIGNATURE = b"PK\x03\x04"
PARTS = re.compile(r"\[Content_Types\]\.xml|_rels/.*|xl/(?:[^/]*\.xml|_rels/.*|worksheets/[^/]*)")
PLACE = re.compile(rb"\br\s*=\s*[\"']([A-Za-z]{0,3})(\d{1,9})[\"']")  # of a row or a cell
CELL = 64.0  # bytes that one takes


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
        with _workbook(path) as book:
            rows = {name: book.get_sheet_by_name(name).total_height for name in book.sheet_names}
        most = max(rows, key=lambda name: rows[name])
        named = {} if most == next(iter(rows)) else {"sheet": most}
        return super().settings_for(path, {**named, **known})

    @contextmanager
    def lines_of(self, path: Path) -> Iterator[Stream]:
        """Open a sheet as text; raises MissingChannel where there is none of its name."""
        with _workbook(path) as book:
            names = book.sheet_names
            if self.sheet is not None and self.sheet not in names:
                raise MissingChannel(
                    f"{path}: has no sheet '{self.sheet}', it has {', '.join(names)}; correct source.sheet"
                )
            rows = book.get_sheet_by_name(self.sheet or names[0]).iter_rows()
            lines = ("\t".join(map(_text, row)) + "\n" for row in rows)
            with stream_of(path, lines) as text:
                yield text


@contextmanager
def _workbook(path: Path) -> Iterator[Any]:
    """Open a workbook; raises ConfigError without python-calamine, UnreadableFile where it is damaged or none."""
    if find_spec("python_calamine") is None:
        raise ConfigError(
            "xlsx: the package python-calamine is not installed, it was expected for workbooks of Excel; "
            "pip install 'driftlab[excel]', or export the sheet as CSV"
        )
    from python_calamine import CalamineError, CalamineWorkbook

    with plain_file(path) as place:
        first = head(place)
        if not first.startswith(SIGNATURE):
            raise foreign(path, first, "xlsx")
        with translated(path, zipfile.BadZipFile, CalamineError, ValueError, LookupError, NotImplementedError, OSError):
            book = CalamineWorkbook.from_filelike(_repacked(place))
        yield book


def _repacked(path: Path) -> io.BytesIO:
    """Return the parts of a workbook that are read, unpacked; raises UnreadableFile where they are too large."""
    plain = io.BytesIO()
    with zipfile.ZipFile(path) as packed, zipfile.ZipFile(plain, "w") as parts:
        entries = [entry for entry in packed.infolist() if PARTS.fullmatch(entry.filename)]
        if not any(entry.filename == "xl/workbook.xml" for entry in entries):
            raise ValueError("a zip archive that is no workbook")
        check_size(path, "the workbook", sum(entry.file_size for entry in entries))
        for entry in entries:
            content = packed.read(entry)
            if entry.filename.startswith("xl/worksheets/"):
                places = PLACE.findall(content)
                columns = {letters.upper() for letters, _ in places}
                width = max(
                    (sum((c - 64) * 26**k for k, c in enumerate(reversed(name))) for name in columns), default=0
                )
                height = max((int(number) for _, number in places), default=0)
                check_size(path, f"a sheet of {height:,} rows and {width:,} columns", CELL * height * width, 2 * PIECE)
            parts.writestr(entry.filename, content)
    plain.seek(0)
    return plain


def _text(cell: Any) -> str:
    """Return a cell as text: a date in ISO 8601, a duration in s."""
    if isinstance(cell, datetime):
        return cell.isoformat(" ", "microseconds")
    if isinstance(cell, timedelta):
        return f"{cell.total_seconds():.9g}"
    if isinstance(cell, time):
        return cell.isoformat("microseconds")
    return " ".join(cell.split()) if isinstance(cell, str) else str(float(cell) if isinstance(cell, bool) else cell)


@hookimpl
def sources() -> list[type[Source]]:
    """Register the plugin."""
    return [Xlsx]
