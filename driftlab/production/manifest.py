"""The units of a fleet and their recordings: a manifest (CSV), or a pattern of file names.

A manifest has a row a recording::

    unit,role,path,lot,date,chamber
    0001,calibration,soaks/0001.h5,L00,2026-01-05,K2
    0001,holdout,days/0001.h5,L00,2026-01-09,K2

Paths are relative to it. Of `unit` and `path` there must be columns; what is beyond `role`, `lot` and `date` goes to
the tables as it is.

Both may be here or in a bucket (`s3://`, `memory://`, `file://`, through fsspec).
"""

from __future__ import annotations

import csv
import errno
import glob
import json
import os
import re
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import overload

import numpy as np

from driftlab.production.remote import is_url, system_of
from fusion_core.budget import COUNT, PIECE, TEXT, read_whole, size_of
from fusion_core.errors import ConfigError, describe_error, quote
from fusion_core.escaping import is_plain

ROLES = {
    "": "calibration",
    "calibration": "calibration",
    "soak": "calibration",
    "train": "train",
    "test": "holdout",
    "holdout": "holdout",
    "stimulus": "stimulus",
}
COLUMNS = ("unit", "role", "path", "lot", "date")  # those with a meaning here
CELLS = 10 * COUNT
LISTED = 1000  # mistakes of which the first are listed
LONGEST = 200  # bytes of a unit's name: names of files have 255 at most


@dataclass(frozen=True)
class ManifestEntry:
    """One unit of a manifest."""

    unit: str
    lot: str = ""
    date: str = ""  # ISO 8601
    recordings: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # by role, one of ROLES
    more: Mapping[str, str] = field(default_factory=dict)  # the other columns
    of_soaks: tuple[Mapping[str, str], ...] = ()  # the same of each soak, where it has several


class ManifestUnits(Sequence[ManifestEntry]):
    """Units of a manifest as a string each in one buffer: as objects a million of them would take a gigabyte."""

    def __init__(self, entries: Iterable[ManifestEntry]) -> None:
        self._texts, self._ends = bytearray(), array("Q", [0])
        for entry in entries:
            self._texts += json.dumps([*vars(entry).values()], separators=(",", ":")).encode()
            self._ends.append(len(self._texts))

    def __len__(self) -> int:
        return len(self._ends) - 1

    @overload
    def __getitem__(self, k: int) -> ManifestEntry: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[ManifestEntry, ...]: ...
    def __getitem__(self, k: int | slice) -> ManifestEntry | tuple[ManifestEntry, ...]:
        if isinstance(k, slice):
            return tuple(map(self.__getitem__, range(len(self))[k]))
        place = range(len(self))[k]
        unit, lot, date, recordings, more, soaks = json.loads(self._texts[self._ends[place] : self._ends[place + 1]])
        return ManifestEntry(unit, lot, date, {role: tuple(p) for role, p in recordings.items()}, more, tuple(soaks))


@dataclass(frozen=True)
class Manifest:
    """Units in their order, with paths from where we are; `name` is that of the manifest, or the pattern."""

    units: Sequence[ManifestEntry]
    name: str

    @cached_property
    def names(self) -> list[str]:
        """The names of the units."""
        return [entry.unit for entry in self.units]


def read_manifest(given: str) -> Manifest:
    """Return the units of a manifest (`.csv`, `.tsv`), or those whose files a pattern finds.

    Raises
    ------
    ConfigError
        If there is none, or one is wrong; the message has a line for each mistake of a manifest.
    """
    pattern = re.search(r"[*?[]", given) is not None and not os.path.exists(given)
    if pattern or not given.lower().endswith((".csv", ".tsv")):
        return _of_pattern(given)
    folder = given.rpartition("/")[0] if is_url(given) else os.path.dirname(given)
    return Manifest(_entries(read_text(given), given, folder), given)


def _placed(folder: str, path: str) -> str:
    """Return a path of a manifest in a folder, from where we are."""
    return path if is_url(path) else f"{folder}/{path}" if is_url(folder) else os.path.join(folder, path)


def _of_pattern(pattern: str) -> Manifest:
    """Return a unit a file, named by what differs between their paths."""
    paths = matching(pattern)
    if not paths:
        raise ConfigError(
            f"--units {pattern}: no file is called so; write a pattern in quotes, as 'units/*/soak.h5', or name a "
            "manifest, as units.csv"
        )
    parts = [_wildcards(pattern, path) for path in paths]
    differing = [k for k in range(len(parts[0])) if len({part[k] for part in parts}) > 1] or range(len(parts[0]))
    names = ["-".join(part[k].replace("/", "-") for k in differing if part[k]) for part in parts]
    if not any(names):  # a single file, without a wildcard
        names = [Path(path).stem for path in paths]
    first: dict[str, str] = {}
    for name, path in zip(names, paths, strict=True):
        if why := _name_mistake(name):
            raise ConfigError(f"--units {pattern}: {path} makes a unit '{quote(name)}', which {why}; write a manifest")
        if (other := first.setdefault(name, path)) != path:
            raise ConfigError(f"--units {pattern}: {other} and {path} are both of unit {name}; write a manifest")
    entries = (
        ManifestEntry(name, recordings={"calibration": (path,)}) for name, path in zip(names, paths, strict=True)
    )
    return Manifest(ManifestUnits(entries), pattern)


def _wildcards(pattern: str, path: str) -> tuple[str, ...]:
    """Return the texts that the wildcards of a pattern stand for in a path that it matches."""
    pattern, path = (re.sub("^[a-z0-9]+://+", "/", text) for text in (pattern, path))
    parts = re.split(r"(\*\*/|\*+|\?+|\[[^]]+\])", pattern)
    with_groups = {"*": r"([^/]*)", "?": r"([^/])", "[": r"([^/])"}
    expression = "".join(
        re.escape(part) if k % 2 == 0 else r"((?:.*/)?)" if part == "**/" else
        f"([^/]{{{len(part)}}})" if part[0] == "?" else with_groups[part[0]]
        for k, part in enumerate(parts)
    )  # fmt: skip
    match = re.search(f"{expression}$", path)
    return tuple(text.strip("/") for text in match.groups()) if match else (path,)


def _name_mistake(name: str) -> str:
    """Return the reason why a unit's folder cannot have a name; empty where it can."""
    if not name:
        return "is empty"
    if name[0] == "." or "/" in name or "\\" in name or not name.isprintable() or name != name.strip():
        return "can be no folder's name"
    return f"has more than {LONGEST} bytes" if len(name.encode()) > LONGEST else ""


def _entries(text: str, name: str, folder: str) -> ManifestUnits:
    """Return the units of a manifest; raises ConfigError with a line for each of its first mistakes."""
    wrong, columns, units = _Mistakes(name), list[str](), dict[str, int]()
    rows, starts, numbers, of_units, paths = bytearray(), array("Q", [0]), array("Q"), array("I"), array("q")

    def row(k: int) -> dict[str, str]:
        return dict(zip(columns, json.loads(rows[starts[k] : starts[k + 1]]), strict=True))

    for number, cells in _rows(text, name, wrong):
        for what in _mistakes_of(cells):
            wrong.add(number, what)
        if cells["role"].lower() in ROLES:
            columns = columns or [*cells]
            rows += json.dumps([*cells.values()]).encode()
            starts.append(len(rows))
            numbers.append(number)
            paths.append(hash(_file(cells["path"])))
            of_units.append(units.setdefault(cells["unit"], len(units)))
    for k, before in _again(paths):
        one, other = row(before), row(k)
        roles = {ROLES[of["role"].lower()] for of in (one, other)}
        if _file(one["path"]) == _file(other["path"]) and not (
            one["unit"] == other["unit"] and roles == {"calibration", "train"}
        ):
            path = quote(other["path"], 200)
            wrong.add(numbers[k], f"path {path} is in line {numbers[before]} already; name each recording once")
    order = np.argsort(np.frombuffer(of_units, dtype=np.uint32), kind="stable")
    cuts = np.searchsorted(np.frombuffer(of_units, dtype=np.uint32)[order], np.arange(len(units) + 1))
    entries = ManifestUnits(
        _entry(unit, [(numbers[k], row(k)) for k in order[cuts[u] : cuts[u + 1]].tolist()], folder, wrong)
        for unit, u in units.items()
    )
    wrong.raise_any()
    if not len(entries):
        raise ConfigError(f"--units {name}: has no unit; write a line a recording below the header")
    return entries


def _file(path: str) -> str:
    return path if is_url(path) else os.path.normpath(path)


def _again(paths: array[int]) -> Iterator[tuple[int, int]]:
    """Yield places of hashes that were there before, and where they were first."""
    hashes = np.frombuffer(paths, dtype=np.int64)
    order = np.argsort(hashes, kind="stable")
    same = np.flatnonzero(np.diff(hashes[order]) == 0)
    first: dict[int, int] = {}
    for k in same.tolist():
        yield int(order[k + 1]), first.setdefault(int(hashes[order[k]]), int(order[k]))


def _rows(text: str, name: str, wrong: _Mistakes) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield each row with the number of its line; empty ones, and those of another number of cells, are left out."""
    head = text.partition("\n")[0]
    lines = (line.group() for line in re.finditer(r"[^\r\n]*(?:\r\n?|\n|\Z)", text))
    reader = csv.reader(lines, delimiter=max(",;\t", key=head.count))
    header = [column.strip() for column in next(reader, [])]
    names = [column.lower() if column.lower() in COLUMNS else column for column in header]
    for column in ("unit", "path"):
        if column not in names:
            has = f"it has {', '.join(map(quote, names))}" if any(names) else "it is empty"
            raise ConfigError(f"--units {name}: has no column '{column}' ({has}); a manifest needs unit and path")
    twice = sorted({column for column in names if names.count(column) > 1})
    if twice:
        raise ConfigError(f"--units {name}: column '{quote(twice[0])}' is there twice; name each once")
    rows = 0
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(names):
                wrong.add(reader.line_num, f"has {len(cells)} cells, the header {len(names)}; write as many")
                continue
            rows += 1
            if rows > COUNT or rows * len(names) > CELLS:
                raise ConfigError(
                    f"--units {name}: has more than {COUNT:,} recordings, or {CELLS:,} cells; make several fleets of it"
                )
            row = {n: cell.strip() for n, cell in zip(names, cells, strict=True) if n}
            yield reader.line_num, dict.fromkeys(COLUMNS, "") | row
    except csv.Error as error:
        raise ConfigError(f"--units {name}: line {reader.line_num} is no CSV ({error}); write it as UTF-8") from None


def _mistakes_of(row: Mapping[str, str]) -> Iterator[str]:
    """Yield the mistakes of a row that show in it alone."""
    unit, role, date = row["unit"], row["role"].lower(), row["date"]
    if why := _name_mistake(unit):
        yield f"unit '{quote(unit)}' {why}; name it otherwise"
    if role not in ROLES:
        yield f"role '{quote(role)}' is not known; write calibration (or soak), train, holdout or stimulus"
        return
    if not row["path"]:
        yield f"unit {quote(unit)} has no path; name its recording"
    for column, text in row.items():
        if not (is_plain(column) and is_plain(text) and len(text) <= TEXT):
            yield f"column {quote(column)} has '{quote(text)}', which is no text of one line; mend it"
    if date and not _iso(date):
        yield f"date '{quote(date)}' is no date, or two; write it as 2026-01-31, 31.01.2026 or 2026-01-31T14:05"


def _iso(date: str) -> str:
    """Return a date in ISO 8601: of one with points the day is first, of one with slashes where no month is so large.

    Empty where it is none, or may be two.
    """
    if match := re.fullmatch(r"(\d\d?)([./])(\d\d?)\2(\d{4})((?:[ T].*)?)", date):
        first, sign, second, year, clock = match.groups()
        if sign == "/" and first != second and max(int(first), int(second)) <= 12:
            return ""
        day, month = (second, first) if sign == "/" and int(second) > 12 else (first, second)
        date = f"{year}-{month:0>2}-{day:0>2}{clock}"
    try:
        datetime.fromisoformat(date)
    except ValueError:
        return ""
    return date


def _entry(unit: str, rows: Sequence[tuple[int, dict[str, str]]], folder: str, wrong: _Mistakes) -> ManifestEntry:
    recordings: dict[str, list[str]] = {}
    more: dict[str, dict[str, None]] = {}
    soaks: list[dict[str, str]] = []
    lots: dict[str, int] = {}
    dates: dict[str, str] = {}
    for number, row in rows:
        role = ROLES[row["role"].lower()]
        recordings.setdefault(role, []).append(_placed(folder, row["path"]))
        if role == "calibration":
            soaks.append({column: value for column, value in row.items() if column not in COLUMNS})
        if row["lot"]:
            lots.setdefault(row["lot"], number)
        if row["date"]:
            dates.setdefault(role, _iso(row["date"]))
        for column, value in row.items():
            if column not in COLUMNS and value:
                more.setdefault(column, {})[value] = None
    if len(lots) > 1:
        (one, _), (other, number) = list(lots.items())[:2]
        wrong.add(number, f"unit {quote(unit)} is of lot {quote(other)} here and of {quote(one)} before; name one")
    if "calibration" not in recordings:
        wrong.add(rows[0][0], f"unit {quote(unit)} has no recording to fit on; give it one of the role calibration")
    date = dates.get("calibration", next(iter(dates.values()), ""))
    others = {column: ", ".join(values) for column, values in more.items()}
    of_roles = {role: tuple(paths) for role, paths in recordings.items()}
    return ManifestEntry(unit, next(iter(lots), ""), date, of_roles, others, tuple(soaks) if len(soaks) > 1 else ())


class _Mistakes:
    """The mistakes of a manifest: how many there are, and the first with their lines."""

    def __init__(self, name: str) -> None:
        self.name, self.found, self.count = name, list[tuple[int, str]](), 0

    def add(self, line: int, what: str) -> None:
        self.count += 1
        if len(self.found) < LISTED:
            self.found.append((line, what))

    def raise_any(self) -> None:
        """Raise ConfigError if there was any."""
        if self.found:
            lines = [f"--units {self.name}: line {line}: {what}" for line, what in sorted(self.found)[:5]]
            lines += [f"and {self.count - 5} more of the kind"] if self.count > 5 else []
            raise ConfigError("\n".join(lines))


MANIFEST = PIECE // 2  # bytes of a manifest: more than a million units


def matching(pattern: str) -> list[str]:
    """Return the files of a pattern, in the order of their names; raises ConfigError."""
    if not is_url(pattern):
        return sorted(glob.glob(pattern, recursive=True))
    system, path = system_of(pattern)
    try:
        return sorted(map(system.unstrip_protocol, system.glob(path)))
    except Exception as error:  # of any of its back ends
        raise ConfigError(
            f"--units {pattern}: cannot be listed ({describe_error(error)}); check address and rights"
        ) from None


def read_text(path: str) -> str:
    """Return the content of a text file, here or in a bucket; raises ConfigError."""
    try:
        if not is_url(path):
            return read_whole(Path(path), MANIFEST).decode("utf-8-sig")
        system, name = system_of(path)
        with system.open(name, "rb") as file:
            data = bytes(file.read(MANIFEST + 1))
        if len(data) > MANIFEST:
            raise OSError(errno.EFBIG, f"it has more than {size_of(MANIFEST)}")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(f"--units {path}: is not UTF-8 text; save it as CSV in UTF-8") from None
    except OSError as error:
        raise ConfigError(
            f"--units {path}: cannot be read ({error.strerror or describe_error(error)}); name a file that can be"
        ) from None
