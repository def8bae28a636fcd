"""Folders of a fleet's units: of each its record, its soaks' information, map, pages and certificate.

They lie in the fleet's own folder (`UnitPlace`), or behind a URL (`driftlab.production.unit_store`). A worker or the
command itself puts a unit there, whole or not at all; its record, which knows the other files, says that it is.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryDirectory

from pydantic import ValidationError

from driftlab.family.partitions import Scratch, ScratchFolder
from driftlab.family.record import UnitRecord
from driftlab.family.unit_information import UnitInformation
from driftlab.storage import ownership
from driftlab.storage.folders import LOCK, remove
from driftlab.storage.ownership import OWN, foreign, free, is_as, why_not_own
from fusion_core.budget import PIECE, read_whole
from fusion_core.errors import UnreadableFile

MARK = "fleet.json"  # of a fleet's folder
UNITS, RECORD, INFORMATION = "units", "unit.json", "unit.npz"  # folder of the units, and files in each of theirs
FAMILY_MAP, COMMAND = "family_map.json", "fleet"  # in the folder of a unit, which knows itself and this command
PAGE, PAGE_FILE = "page", "page/map.report.html"  # folder of a unit's pages, and the one that is always there
INSIDE = (PAGE, "explained", "")  # folders of a unit in which driftlab writes; the one with the record is the last
SCRATCH = ".family.new"  # what workers keep for the passes of a family
NEW, OLD = ".new", ".old"  # of hidden names; no unit's name begins with a dot


class UnitFolders(ABC):
    """Folders of a fleet's units, as long as a command holds the fleet; they may be sent to a worker."""

    @property
    @abstractmethod
    def root(self) -> str:
        """Folder of the units, as links have it."""

    @property
    def address(self) -> str:
        """Folder of the units, as messages have it."""
        return self.root

    @abstractmethod
    def reached(self) -> bool:
        """Return True if this process sees the folders, and the command still holds them."""

    @abstractmethod
    def names(self, name: str = RECORD) -> list[str]:
        """Return the names of the units that have a file, in order."""

    @abstractmethod
    def read(self, unit: str, name: str) -> bytes:
        """Return the content of a file of a unit; raises OSError where it is not there."""

    @abstractmethod
    def holds(self, unit: str, name: str = RECORD) -> bool:
        """Return True if a unit has a file."""

    @abstractmethod
    def put(self, record: UnitRecord, files: Mapping[str, bytes]) -> UnitRecord:
        """Put a unit in its place, for the one that was there; return its record, which knows the files."""

    @abstractmethod
    def write(self, unit: str, name: str, content: bytes) -> None:
        """Write a file of a unit that is there, whole or not at all."""

    @abstractmethod
    def is_as(self, unit: str, name: str, known: str) -> bool:
        """Return True if a file of a unit has the SHA-256 that is known of it."""

    @abstractmethod
    def clear(self, unit: str, name: str, known: str) -> None:
        """Make room for a file of which the SHA-256 is known, if one is there; another one is put aside."""

    @abstractmethod
    def put_page(self, unit: str, pages: Mapping[str, bytes]) -> None:
        """Put the folder of a unit's pages into its place, for the one that was there."""

    @abstractmethod
    def scratch(self) -> AbstractContextManager[Scratch]:
        """Give a place for files that are needed until the end of the command."""

    @contextmanager
    def file(self, unit: str, name: str) -> Iterator[Path]:
        """Give a file of a unit a path, until the end of the block; where it is not there, none is at the path."""
        with TemporaryDirectory(prefix="driftlab-") as folder:
            path = Path(folder, Path(name).name)
            if self.holds(unit, name):
                path.write_bytes(self.read(unit, name))
            yield path

    def record(self, unit: str) -> UnitRecord | None:
        """Return the record of a unit; None where there is none that can be read."""
        try:
            return UnitRecord.model_validate_json(self.read(unit, RECORD))
        except (OSError, ValidationError):
            return None

    def information(self, unit: str) -> UnitInformation:
        """Return the information of a unit's soaks; raises UnreadableFile where its file is damaged."""
        try:
            return UnitInformation.from_bytes(self.read(unit, INFORMATION))
        except Exception:  # of a damaged archive nearly any
            raise UnreadableFile(
                f"{self.address}/{unit}/{INFORMATION}: is missing or damaged; remove the folder and give the same "
                "command again"
            ) from None


@dataclass(frozen=True)
class UnitPlace(UnitFolders):
    """Folders of units in a fleet's folder, as long as a command holds that: `signed` is its lock's content."""

    path: Path
    signed: bytes

    @property
    def root(self) -> str:
        """Folder of the units, relative to the fleet's."""
        return UNITS

    @property
    def address(self) -> str:
        """Path of the folder of the units."""
        return str(self.path / UNITS)

    def unit(self, name: str) -> Path:
        """Return the folder of a unit."""
        return Path(f"{self.address}/{name}")  # a path keeps its parts: a million names would stay known to Python

    def reached(self) -> bool:
        """Return True if this process sees the folder, and the command still holds it."""
        try:
            return (self.path / LOCK).read_bytes() == self.signed
        except OSError:
            return False

    def names(self, name: str = RECORD) -> list[str]:
        """Return the names of the units that have a file, in order."""
        return sorted(unit for unit in os.listdir(self.address) if os.path.isfile(f"{self.address}/{unit}/{name}"))

    def read(self, unit: str, name: str) -> bytes:
        """Return the content of a file of a unit; raises OSError."""
        return read_whole(self.unit(unit) / name, PIECE)

    def holds(self, unit: str, name: str = RECORD) -> bool:
        """Return True if a unit has a file."""
        return (self.unit(unit) / name).exists()

    def put(self, record: UnitRecord, files: Mapping[str, bytes]) -> UnitRecord:
        """Put a unit in its place, for the one that was there; what others put there is taken along.

        Return its record, which knows the files. Whoever else does the same writes beside it, not over it.
        """
        record = record.model_copy(update={"written": digests(files)})
        place, hidden = self.unit(record.unit), f".{record.unit}"
        old = place.with_name(f"{hidden}{OLD}")
        new = _made(place.with_name(f"{hidden}.{token_hex(6)}{NEW}"), {**files, RECORD: content_of(record)})
        if os.path.lexists(place):
            _take_along(old, place)  # of one who ended here
            os.rename(place, old)
        os.rename(new, place)
        _take_along(old, place)
        return record

    def write(self, unit: str, name: str, content: bytes) -> None:
        """Write a file of a unit, whole or not at all; one that says its own SHA-256, and was edited, is put aside."""
        write_whole(self.unit(unit) / name, content)

    def is_as(self, unit: str, name: str, known: str) -> bool:
        """Return True if a file of a unit has the SHA-256 that is known of it."""
        return is_as(self.unit(unit) / name, known)

    def clear(self, unit: str, name: str, known: str) -> None:
        """Remove a file of which the SHA-256 is known; one that was edited is put aside."""
        path = self.unit(unit) / name
        if is_as(path, known):
            remove(path)
        elif os.path.lexists(path):
            os.rename(path, free(path))

    def put_page(self, unit: str, pages: Mapping[str, bytes]) -> None:
        """Put the folder of a unit's pages into its place, whole or not at all; somebody's is put aside."""
        place = self.unit(unit) / PAGE
        if os.path.lexists(place):
            os.rename(place, free(place))
        named = {Path(name).name: content for name, content in pages.items()}
        os.rename(_made(self.path / UNITS / f".{unit}.{PAGE}{NEW}", named), place)

    @contextmanager
    def scratch(self) -> Iterator[Scratch]:
        """Give a folder for files that are needed until the end of the command."""
        path = self.path / SCRATCH
        remove(path)
        path.mkdir(mode=0o700)
        try:
            yield ScratchFolder(path)
        finally:
            remove(path)

    @contextmanager
    def file(self, unit: str, name: str) -> Iterator[Path]:
        """Give the path of a file of a unit."""
        yield self.unit(unit) / name

    def finish(self) -> None:
        """Finish what a command or a worker that was killed had begun to replace."""
        (self.path / UNITS).mkdir(exist_ok=True)
        for path in sorted(self.path / UNITS / name for name in os.listdir(self.address) if name[0] == "."):
            if path.name.endswith(OLD):
                place = path.with_name(path.name[1:].removesuffix(OLD))
                if os.path.lexists(place):
                    _take_along(path, place)
                else:
                    os.rename(path, place)
            elif path.name.endswith(NEW):
                remove(path)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is there whole or not at all; one that says its own SHA-256, and was edited, is put aside."""
    new = path.with_name(f".{path.name}{NEW}")
    new.write_bytes(content)
    own = path.name in (MARK, RECORD)
    edited = own and foreign(path.parent, path.name, [path.name])
    if os.path.lexists(path) and (edited or (path.name == FAMILY_MAP and why_not_own(path, COMMAND))):
        os.rename(path, free(path))
    os.replace(new, path)


def content_of(record: UnitRecord) -> bytes:
    """Return the content of a record's file, which knows the others and itself."""
    record = record.model_copy(update={"written": {**record.written, RECORD: OWN}})
    return ownership.with_own(record.model_dump_json(by_alias=True, indent=1) + "\n").encode()


def digests(files: Mapping[str, bytes]) -> dict[str, str]:
    """Return the SHA-256 of each file."""
    return {name: sha256(content).hexdigest() for name, content in files.items()}


def _made(folder: Path, files: Mapping[str, bytes]) -> Path:
    """Return a new folder with files in it."""
    remove(folder)
    for file, content in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(content)
    return folder


def _take_along(old: Path, place: Path) -> None:
    """Remove a unit's folder that was replaced, but for what driftlab did not write so: that goes to the new one."""
    if not os.path.lexists(old):
        return
    if old.is_symlink() or not old.is_dir():  # somebody's
        os.rename(old, free(place / place.name))
        return
    for inside in INSIDE:
        folder = old / inside
        if folder.is_dir() and not folder.is_symlink():
            names = [f"{inside}/{name}" if inside else name for name in os.listdir(folder)]
            others = [n for n in foreign(old, RECORD, names) if n != FAMILY_MAP or why_not_own(old / n, COMMAND)]
            for name in sorted(names, key=RECORD.__eq__):  # the record, which knows the others, is the last
                if name in others:
                    os.rename(old / name, free(place / name.replace("/", "-")))
                else:
                    remove(old / name)
            folder.rmdir()
