"""Files of a map: its own, its page and its report, which are new or in the place of an earlier one."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from driftlab.storage.folders import check_writable, refusals
from driftlab.storage.ownership import check_own, put, seal, seal_of, why_not_own
from driftlab.storage.system import sync
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.errors import ConfigError, FusionError, MapError
from fusion_core.host.registry import registry


def check_place(path: Path, read: Collection[Path], command: str) -> None:
    """Make the folder of a map's file, and see that the file may be written.

    Raises
    ------
    ConfigError, Unwritable
        If it is something else than a map of the same command, is one of the files that are read, or cannot be written.
    """
    if any(os.path.realpath(path) == os.path.realpath(other) for other in read):
        raise ConfigError(f"map {path}: is read here, and would be lost; name another file with --out")
    check_file(path, command, f"map {path}", "name another file with --out")


def check_file(path: Path, command: str, subject: str, remedy: str) -> None:
    """Make the folder of a file of a command, and see that the file may be written; raises as `check_place`."""
    check_own(path, command, subject, remedy)
    folder = Path(os.path.realpath(path)).parent
    with refusals(str(path), "name a folder that can be"):
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)


def beside(path: Path, folder: Path | None, names: Iterable[str]) -> list[Path]:
    """Return the places of files of a map: in the folder, or beside the map under its name."""
    return [path.with_name(f"{path.stem}.{name}") if folder is None else folder / name for name in names]


def check_all(path: Path, folder: Path | None, read: Collection[Path], names: Sequence[str], command: str) -> None:
    """See that a map's file and those beside it may be written; raises as `check_place`."""
    check_place(path, read, command)
    for name in beside(path, folder, names):
        check_file(name, command, str(name), "name another folder with --report")


def write_beside(
    path: Path, folder: Path | None, texts: Mapping[str, str], command: str, stale: Sequence[str] = ()
) -> list[Path]:
    """Write texts by the names of their files, and delete those that an earlier map left; return the places."""
    places = beside(path, folder, texts)
    for place, text in zip(places, texts.values(), strict=True):
        write_text(place, text, command)
    for place in beside(path, folder, [name for name in stale if name not in texts]):
        if place.is_file() and not why_not_own(place, command):
            place.unlink()
    return places


def write_text(path: Path, text: str, command: str) -> None:
    """Write a page, a figure, a text of JSON, or one with a place for its SHA-256, whole; raises as `save`."""
    known = f"{text}<!-- {seal_of(command)} -->\n"
    if text[0] == "{":
        known = f'{{\n  "sha256": "{seal_of(command)}",{text[1:]}'
    elif seal_of(command) in text:
        known = text
    with _sealed(path, command, str(path)) as new:
        new.write_text(known, encoding="utf-8")


def save(fitted: FittedMap, path: Path, command: str) -> None:
    """Write a map's file, in the place that a link leads to; raises MapError, Unwritable or ConfigError."""
    others = {name: text for name, text in fitted.record.provenance.items() if name != "written"}
    about = {"written": seal_of(command), **others}  # first, so that no other text is taken for it
    record = fitted.record.model_copy(update={"provenance": about})
    with _sealed(path, command, f"map {path}") as new:
        try:
            replace(fitted, record=record).save(new)
        except MapError as error:
            raise MapError(str(error).replace(str(new), str(path))) from None


@contextmanager
def _sealed(path: Path, command: str, subject: str) -> Iterator[Path]:
    """Give a name to write a file under, which then gets its SHA-256, and its place."""
    place = Path(os.path.realpath(path))
    with (
        refusals(subject, "make room, or name another place", usage=False),
        TemporaryDirectory(prefix=".driftlab-", dir=place.parent) as folder,
    ):
        new = Path(folder) / place.name
        yield new
        seal(new)
        sync(new)
        put(new, path, command, subject)


def read_map(path: Path) -> FittedMap:
    """Read the map of a file, of whatever installed kind it is; raises MapError where none can read it."""
    if path.is_dir():
        raise MapError(f"map file {path} is a folder; name a file in it")
    if not path.is_file():
        raise MapError(f"map file {path} does not exist; fit it with `driftlab fit-map`")
    why = []
    for kind, cls in registry().classes(ThermalMap).items():
        settings: Any = cls.model_validate({"kind": kind, "path": str(path.absolute())})
        try:
            return settings.load()  # type: ignore[no-any-return]
        except FusionError as error:
            if settings.suffix == path.suffix:
                why.append(str(error).partition(";")[0])
    reasons = f" ({', '.join(why)})" if why else ""
    raise MapError(f"{path}: is a map of no installed kind{reasons}; name one that `driftlab fit-map` wrote")
