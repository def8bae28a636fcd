"""The way in which a text of unknown origin is a table: separator, decimal sign, line of the names, dates.

A line is cut at each separator in turn, and its cells are read with each decimal sign: that way is taken in which most
cells of the lines of most fields are numbers or dates. The names are in the line above the first row that has as many
fields; between the two there may be lines of units.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fusion_core.chunk import Array

if TYPE_CHECKING:
    import polars as pl

SEPARATORS = ("\t", ";", ",", "|", " ")
NOTHING = "".join(SEPARATORS) + "\r\n"  # of a line without a value
SAMPLE = 400  # lines that are looked at, behind a preamble of at most as many
NUMBER = {
    sign: re.compile(
        rf"(?:[+-] *)?(?:\d+(?:{re.escape(sign)}\d*)?|{re.escape(sign)}\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf)", re.I
    )
    for sign in ".,"
}
MONTHS = "jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec"
DATE = re.compile(
    r"(?!\d+\.\d*$)(?=.*\d[-/.:]\d)"  # no decimal number
    rf"\d{{1,4}}(?:[-/.:, T]+(?:\d+|{MONTHS})){{0,8}}\s?(?:[AP]M|Z|UTC|GMT|[+-]\d\d:?\d\d)?",
    re.I,
)
ZONE = r"(:\d\d[.\d]*)\s?(?:Z|UTC|GMT|[+-]\d\d:?\d\d)$"
OFFSET = r":\d\d[.\d]*\s?([+-])(\d\d):?(\d\d)$"
FRACTION = r"(\d:\d\d:\d\d)(?:,(\d)|:(\d{6}|\d{3})(\D|$))"  # of a second, behind no point
DAYS = ("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%d.%m.%Y", "%m/%d/%Y", "%d/%m/%Y", "%m/%d/%y", "%d/%m/%y", "%d.%m.%y",
        "%d-%b-%Y", "%d-%m-%Y", "%Y%m%d")  # fmt: skip
DAY = 86_400.0  # s
HOURS = ("%H:%M:%S", "%I:%M:%S %p", "%H:%M")
MOST_ABOVE = 8  # lines between the names and the first row
JOINED = " + "  # between the columns of a date and of a time


class Dialect(NamedTuple):
    """The separator and decimal sign, the numbers of the lines with the names (0: none) and the first row, dates."""

    separator: str
    decimal: str
    header: int
    first_row: int
    dates: dict[str, str]
    share: float  # of cells that are numbers or dates


def fields_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line; blanks count as one separator, and cells in quotes may hold separators."""
    line = line.rstrip("\r\n")
    if separator == " ":
        return line.split()
    if '"' in line:
        with suppress(csv.Error):
            return next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return line.split(separator)


def dialect_of(lines: Sequence[str], known: Mapping[str, Any]) -> Dialect | None:
    """Return the likeliest dialect of the first lines of a text, of those that are as `known` says; None for prose."""
    tabs = 2 * sum("\t" in line for line in lines) >= len(lines)  # blanks are then within the cells
    separators = [known["separator"]] if "separator" in known else [s for s in SEPARATORS if not (tabs and s == " ")]
    signs = [known["decimal"]] if "decimal" in known else list(NUMBER)
    found = [one for s in separators for d in signs if s != d and (one := _read(lines, s, d)) is not None]
    return max(found, key=lambda one: (round(one.share, 2), one.header > 0), default=None)


def _read(lines: Sequence[str], separator: str, decimal: str) -> Dialect | None:
    cut = [fields_of(line, separator) for line in lines]
    number = NUMBER[decimal].fullmatch
    good = [sum(bool(number(c.strip()) or DATE.fullmatch(c.strip())) for c in cells) for cells in cut]
    filled = [sum(bool(cell.strip()) for cell in cells) for cells in cut]  # of a sensor's rows others' cells are empty
    widths = Counter(len(bare(cut[k])) for k in range(len(cut))[-SAMPLE:] if 2 * good[k] >= filled[k] > 0)
    if not widths:
        return None
    width = widths.most_common(1)[0][0]
    rows = [k for k, cells in enumerate(cut) if 0 <= len(bare(cells)) - width <= 1 and 3 * good[k] >= filled[k] > 0]
    most = max((good[k] for k in rows), default=0)
    usual = [k for k in rows if 2 * good[k] >= most]
    if not usual:
        return None
    few = {k for k, count in enumerate(filled) if 2 <= count == good[k] and len(cut[k]) >= width}  # most cells empty
    first = _longest_run(usual, lines, few)
    share = sum(good[k] for k in few.union(usual) if k >= first) / sum(filled[first:])
    header = _header(lines, first, width, separator, decimal)
    names = names_of(lines[header], separator) if header is not None else [str(k + 1) for k in range(width)]
    texts = {
        name: [cut[k][j].strip() for k in usual if j < len(cut[k])]
        for j, name in enumerate(names)
        if name and names.count(name) == 1
    }
    dates = _dates({n: t for n, t in texts.items() if any(t) and not any(c and number(c) for c in t)})
    return Dialect(
        separator, decimal, 0 if header is None else header + 1, first + 1, dates, share if width > 1 else share / 4
    )


def _longest_run(rows: Sequence[int], lines: Sequence[str], few: Collection[int]) -> int:
    """Return the first of the most rows that only lines of few numbers, comments and lines without a value part."""
    begin, best, longest = 0, 0, 0
    above = {line.strip() for line in lines[: rows[0]]}  # where the names are: a logger writes them again as it begins
    for k in range(1, len(rows) + 1):
        inside = (j for j in range(rows[k - 1] + 1, rows[k]) if j not in few) if k < len(rows) else ()
        between = [lines[j] for j in inside] if k < len(rows) else ["-"]
        if any(line.strip(NOTHING) and not line.startswith("#") and line.strip() not in above for line in between):
            if k - begin > longest:
                best, longest = rows[begin], k - begin
            begin = k
    while best - 1 in few:
        best -= 1
    return best


def names_of(line: str, separator: str) -> list[str]:
    """Return the names of the columns in a line, which may be a comment."""
    return called(fields_of(line.strip("\ufeff\r\n ").lstrip("#").lstrip(" "), separator))


def called(cells: Sequence[str]) -> list[str]:
    """Return the names in cells; a first one that has none is called 1."""
    names = [cell.strip() for cell in cells]
    return ["1", *names[1:]] if any(names) and not names[0] and "1" not in names else names


def bare(cells: list[str]) -> list[str]:
    """Return the cells of a line without an empty one behind the last separator."""
    return cells[:-1] if len(cells) > 1 and not cells[-1].strip() else cells


def _header(lines: Sequence[str], first: int, width: int, separator: str, sign: str) -> int | None:
    """Return the line of the names: of those above the first row with as many fields, that of most different ones."""
    above: dict[int, int] = {}
    for k in range(first - 1, max(first - MOST_ABOVE, -1), -1):
        names = bare(names_of(lines[k], separator))
        if any(names):
            if abs(len(names) - width) > 1:
                break
            above[k] = len({name for name in names if not NUMBER[sign].fullmatch(name)})
    return max(above, key=lambda k: (above[k], -k), default=None)


def _dates(texts: dict[str, list[str]]) -> dict[str, str]:
    """Return the formats of columns of dates; a column of days and one of times are one column, joined."""
    found = {name: form for name, cells in texts.items() if (form := _format(cells)) is not None}
    days = [name for name, form in found.items() if form in DAYS]
    times = [name for name, form in found.items() if form in HOURS]
    if days and times:
        day, time = days[0], times[0]
        return {f"{day}{JOINED}{time}": f"{found[day]} {found[time]}"}
    return {name: form for name, form in found.items() if name not in days}


def _format(cells: list[str]) -> str | None:
    import polars as pl

    forms = [*(f"{day}{sep}{hour}" for hour in HOURS for day in DAYS for sep in (" ", "T")), *HOURS, *DAYS]
    filled = [cell for cell in cells if cell]
    if all(re.fullmatch(r"[\d.eE+-]+ sec", cell) for cell in filled):
        return "sec"  # as MATLAB writes a duration
    if not all(map(DATE.fullmatch, filled)):
        return None
    years = "%Y" if all(re.search(r"\d{4}", cell.partition(":")[0]) for cell in filled) else "%y"
    few, all_of = pl.Series(filled[:50]), pl.Series(filled)
    forms = [form for form in forms if (years in form or form in HOURS) and _may_be(form, filled[0])]
    forms = [form for form in forms if seconds_of(few, form).is_not_null().all()]
    spans = {form: _span(seconds_of(all_of, form)) for form in forms}
    return min(spans, key=lambda form: spans[form], default=None)  # of days and months in turn: that of fewer days


def _may_be(form: str, cell: str) -> bool:
    """Return False where a cell lacks a sign that stands between the parts of a format."""
    between = re.sub(r"%[-_0]?.", "", form)
    return all(cell.count(sign) >= between.count(sign) for sign in "-/:T")


def _span(seconds: pl.Series) -> float:
    """Return from the first to the last moment, s; infinity where one is not known."""
    if seconds.null_count():
        return math.inf
    return float(seconds.max() - seconds.min())  # type: ignore[operator, arg-type]


def seconds_of(texts: pl.Series, form: str) -> pl.Series:
    """Return dates as seconds since 1970, those without a day since midnight; null where a text is none.

    Fractions of a second may stand behind a point or a comma, 3 or 6 digits behind a colon. With an offset from UTC
    they are of UTC; the name of a zone is left out.
    """
    import polars as pl

    if "%" not in form:
        return texts.str.strip_suffix(form).str.strip_chars().cast(pl.Float64, strict=False)
    plain = texts.str.strip_chars().str.replace(ZONE, "${1}").str.replace(FRACTION, "${1}.${2}${3}${4}")
    if not has_day(form):
        plain, form = "1970-01-01 " + plain, f"%Y-%m-%d {form}"
    moments = plain.str.to_datetime(form.replace("%S", "%S%.f"), time_unit="ns", strict=False)
    seconds = moments.dt.timestamp("ns").cast(pl.Float64) / 1e9
    zoned = texts.str.strip_chars()
    if not zoned.str.contains(OFFSET).any():
        return seconds
    sign, hours, minutes = (zoned.str.extract(OFFSET, k).fill_null("0") for k in (1, 2, 3))
    ahead = 3600 * hours.cast(pl.Float64) + 60 * minutes.cast(pl.Float64)
    return seconds - ahead * (1 - 2 * (sign == "-").cast(pl.Float64))


def has_day(form: str) -> bool:
    """Return True where a format says more than the time of a day."""
    return "%" not in form or re.search(r"%[-_0]?[cdDeFjsvx+]", form) is not None


def numbers_of(cells: Sequence[str], form: str) -> Array:
    """Return the dates of cells (N,) in s; NaN where one is none."""
    import polars as pl

    return seconds_of(pl.Series(cells, dtype=pl.String), form).to_numpy().astype(float)


class TimeOfDay:
    """A time of day, which goes on over midnight: a fall of more than half a day is a new day."""

    def __init__(self) -> None:
        self.last, self.days = np.nan, 0

    def unwrapped(self, t: Array) -> Array:
        """Return the next times of day (N,) in s since the first midnight."""
        known = np.flatnonzero(np.isfinite(t))
        days = self.days + np.cumsum(np.diff(t[known], prepend=self.last) < -DAY / 2)
        if len(known):
            self.last, self.days = t[known[-1]], days[-1]
        whole = t.copy()
        whole[known] += DAY * days
        return whole
