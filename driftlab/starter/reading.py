"""The installed sources that read a file, and the first rows of every column in it."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from driftlab.starter.names import read_name
from fusion_core.budget import LISTED, check_all, check_size
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Channel, FileSource, Framing, Source, head, kinds_of, recognised
from fusion_core.errors import ConfigError, DataError, FusionError, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.host.config import read_document
from fusion_core.host.registry import registry
from fusion_core.units import to_si

ROWS = 200_000  # that are looked at
WIDEST = 1024  # values of an array that is a channel
GZIP = b"\x1f\x8b"
HEAD = 4096  # bytes by which a format is recognised
TRIED = 1 << 18  # bytes of an unknown file in which frames are looked for
ORDERS = {"month": "%m/%d", "day": "%d/%m"}  # of dates between strokes
FRAMES = 5  # whole ones, one behind the other as likely as not: no chance


class Doubt(NamedTuple):
    """The reason why a setting is a guess, and its possible values, the guess first."""

    why: str
    ways: tuple[str, ...]


@dataclass(frozen=True)
class FileColumns:
    """The columns of a file, by a source."""

    kind: str  # of the source
    noun: str  # its word for a column
    settings: dict[str, Any]  # of the source, for this file
    names: list[str]  # every column
    values: dict[str, Array]  # the first rows, (N,) or (N, d), of those that are numbers
    units: dict[str, str]  # as the file gives them
    more: bool  # whether the file has more rows than were looked at
    doubts: dict[str, Doubt] = field(default_factory=dict)  # by settings
    unread: dict[str, str] = field(default_factory=dict)  # columns that are no numbers, and where
    flags: bool = False  # whether the source takes a text of a column for 1, and all others for 0


@dataclass(frozen=True)
class FoundFraming:
    """A framing that finds frames in a file: the kind of source, the product that brings the framing, and how many."""

    source: str
    product: str | None
    framing: Framing
    count: int
    interval: str | None = None  # between frames without a clock


def file_sources(path: Path, first: bytes) -> Iterator[type[FileSource]]:
    """Yield the kinds of source that may read a file that begins so: by its first bytes, its name, then any."""
    installed = _file_sources()
    own = [kind for kind in kinds_of(first) if kind in installed]
    name = path.name.lower().removesuffix(".gz")
    named = [kind for kind, cls in installed.items() if name.endswith(cls.suffixes or ("\0",))]
    others = [] if recognised(first) else ["csv"]
    if path.is_dir():
        named = [kind for kind, cls in installed.items() if cls.signatures]
    for kind in dict.fromkeys([*own, *(named if not own else []), *others]):
        cls = installed.get(kind)
        if cls and "framing" not in cls.model_fields and (kind in own or not cls.product):
            yield cls


def _file_sources() -> dict[str, type[FileSource]]:
    return {kind: cls for kind, cls in registry().classes(Source).items() if issubclass(cls, FileSource)}


def beginning(path: Path, most: int) -> bytes:
    """Return the first bytes of a file, unpacked where it is a gzip archive; raises UnreadableFile as `head`."""
    first = head(path, most=most)
    if not first.startswith(GZIP):
        return first
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(first, most)
    except zlib.error:
        return first


def columns_of(path: Path, cls: type[FileSource], known: Mapping[str, Any], first: str | None = None) -> FileColumns:
    """Read the first rows of every column; `known` are settings of the user, `first` is what stands first in dates.

    Dates as 03/04/2026 are read with the day or the month first, as all of these rows can be. Raises DataError where
    the file cannot be read.
    """
    settings = dict(cls.settings_for(path, known))
    dates, doubts = settings.get("dates", {}), dict[str, Doubt]()
    if "decimal" in (settings if "decimal" not in known else ()) and _may_be_thousands(path):
        why = "all commas have three digits behind them; if they part thousands, take them out of the file"
        doubts["decimal"] = Doubt(why, ("comma",))
    usual = next((order for order, form in ORDERS.items() if any(form in text for text in dates.values())), None)
    if usual is not None:
        orders = sorted(ORDERS, key=usual.__ne__) if first is None else [first]
        ways = {order: _dated(settings, order) for order in orders}
        good = [order for order in orders if _reads(path, cls, ways[order])]
        if first is not None and not good:
            raise ConfigError(
                f"--dates {first}: the dates of {path} cannot be read so; leave it out, or write the other"
            )
        good = good or orders
        settings = ways[good[0]]
        if len(good) > 1:
            doubts["dates"] = Doubt("whichever of day and month stands first, all dates can be read", tuple(good))
    return _columns(path, cls, settings, doubts)


def _dated(settings: Mapping[str, Any], order: str) -> dict[str, Any]:
    """Return settings with the day or the month first in all dates."""
    forms = settings["dates"].items()
    return {**settings, "dates": {name: re.sub("|".join(ORDERS.values()), ORDERS[order], text) for name, text in forms}}


def _reads(path: Path, cls: type[FileSource], settings: Mapping[str, Any]) -> bool:
    """Return True if the dates of the first rows can be read."""
    try:
        _rows(_source(path, cls, settings), path, list(settings["dates"]))
    except DataError:
        return False
    return True


def _source(path: Path, cls: type[FileSource], settings: Mapping[str, Any]) -> FileSource:
    # a log's rows are those of the first channel; which column is a time, the names will tell
    return cls.model_validate({"interval": 1.0, **settings, "path": str(path), "channels": {"rows": {"path": "?"}}})


def _may_be_thousands(path: Path) -> bool:
    """Return True where each number with a comma has three digits behind it, and no zero before it."""
    text = beginning(path, TRIED).replace(b"\0", b"").decode("latin-1")
    groups = re.findall(r"(?<![\d.,])(\d+),(\d+)(?=\D)", text)
    whole = all(len(last) == 3 and len(head) <= 3 and head[0] != "0" for head, last in groups)
    return bool(groups) and whole and re.search(r"\d\.\d+,\d", text) is None


def _columns(path: Path, cls: type[FileSource], settings: dict[str, Any], doubts: dict[str, Doubt]) -> FileColumns:
    source = _source(path, cls, settings)
    with source.open(path, Faults()) as table:
        noun, names = table.noun, list(table.names)
        units = {name: unit for name in names if (unit := table.unit(name)) is not None}
    leading = next((name for name in names if read_name(name).quantity == "gyro"), names[0] if names else "?")
    source = source.model_copy(update={"channels": {"rows": Channel(path=leading)}})
    unread: dict[str, str] = {}
    values, more = _values(source, path, names, unread)
    return FileColumns(
        source.kind, noun, settings, names, values, units, more, doubts, unread, "flags" in type(source).model_fields
    )


def _values(source: FileSource, path: Path, names: list[str], unread: dict[str, str]) -> tuple[dict[str, Array], bool]:
    """Return the first rows of the columns that can be read: all together, or where that fails one by one.

    `unread` is given the others, and why.
    """
    try:
        return _rows(source, path, names)
    except DataError:
        pass
    found: dict[str, Array] = {}
    more, size = False, 0
    for name in names:
        check_all()
        try:
            own, further = _rows(source, path, [name])
        except DataError as error:
            unread[name] = str(error).removeprefix(f"{path}: ")
            continue
        more = more or further
        for values in own.values():
            if values.shape[1:] <= (WIDEST,):
                found[name], size = values, size + values.nbytes
        check_size(path, "the beginning of its columns", size)
    usual = max((len(v) for v in found.values()), default=0)
    return {name: values for name, values in found.items() if len(values) == usual}, more


def _rows(source: FileSource, path: Path, names: list[str]) -> tuple[dict[str, Array], bool]:
    parts: dict[str, list[Array]] = {name: [] for name in names}
    rows, more, size = 0, False, 0
    with source.open(path, Faults()) as table:
        for block in table.blocks(names, ROWS) if names else ():
            if rows >= ROWS or size > LISTED:
                more = True
                break
            for name in names:
                parts[name].append(np.asarray(block.read(name), dtype=np.float64))
                size += parts[name][-1].nbytes
            rows += block.rows
    whole = {name: (np.concatenate(own) if len(own) > 1 else own[0])[:ROWS] for name, own in parts.items() if own}
    flat = {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in whole.items()}
    return flat, more or rows > ROWS


def framing_of(path: Path) -> FoundFraming | None:
    """Return the installed framing that finds most frames in a file's beginning; None where none does."""
    data = beginning(path, TRIED)
    kind = next((kind for kind, cls in _file_sources().items() if "framing" in cls.model_fields), "")
    found = [FoundFraming(kind, name, framing, _count(framing, data)) for name, framing in _framings()]
    best = max(found, key=lambda frames: frames.count, default=None)
    return best if kind and best is not None and best.count >= FRAMES else None


def samples_of(path: Path, frames: FoundFraming, interval: str | None) -> tuple[FoundFraming, Chunk | None]:
    """Return the framing with its interval, and the first samples in SI; None without clock and interval.

    A framing whose values are those of an interval, as angles are, has that of the clock, or the given one.
    """
    timed, framing = {} if interval is None else {"interval": interval}, frames.framing
    for known in ({}, timed):
        settings = {"kind": frames.source, "path": str(path), "framing": framing, **known}
        with suppress(ValidationError):
            source = _file_sources()[frames.source].model_validate(settings)
            samples = next(source.chunks(ROWS, Faults()), None)
            if getattr(framing, "interval", None) is not None and samples is not None:
                step = float(np.median(np.diff(samples.t))) if interval is None else to_si(interval, "s")
                framing = framing.model_validate({**framing.model_dump(), "interval": f"{step:.9g} s"})
                source = source.model_validate({**settings, "framing": framing})
                samples = next(source.chunks(ROWS, Faults()), None)
            return replace(frames, framing=framing, interval=interval if known else None), samples
    return frames, None


def _count(framing: Framing, data: bytes) -> int:
    try:
        return framing.decode(data, None)[0].N
    except DataError:
        return 0


def _framings() -> Iterator[tuple[str | None, Framing]]:
    """Yield the framings of products by name, then the examples of all."""
    kinds = registry().classes(Framing)
    for name, path in registry().products().items():
        own = read_document(path, registry().products()).data.get("source", {}).get("framing", {})
        if own.get("kind") in kinds:
            framing = kinds[own["kind"]].model_validate(own)
            assert isinstance(framing, Framing)
            yield name, framing
    for cls in kinds.values():
        for example in cls.examples():
            assert isinstance(example, Framing)
            yield None, example


def nothing_reads(path: Path, tried: list[FusionError]) -> UnreadableFile:
    """Return the error of a file, or a folder, that no source reads."""
    if path.is_dir():
        return UnreadableFile(f"{path}: is a folder, and none of a bag that can be read; name a file in it")
    why = f" ({tried[0]})" if tried else ""
    return UnreadableFile(
        f"{path}: no installed source reads it{why}, and no framing finds frames in it; convert it to CSV, or describe "
        "its frames under source.framing"
    )
