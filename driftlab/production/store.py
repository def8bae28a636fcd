"""The folder of a fleet, which grows in place: each unit is there whole or not at all.

A fleet takes hours, so what is done is not kept back until all is (docs/adr/0052). The rules of all folders hold: one
writer, by a lock; what driftlab did not write is never removed, not even from a unit's folder; and what cannot be done
again, since its recordings are not there any more, is replaced only on demand.

What a folder of a fleet holds of each unit, one at a time: memory does not grow with the units.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from driftlab.family.record import UnitRecord
from driftlab.family.unit_information import UnitInformation
from driftlab.storage.folders import FILES, FULL, LOCK, Lock, check_writable, digest, matches, remove
from driftlab.storage.hdf5 import reason
from fusion_core.budget import PIECE, read_whole
from fusion_core.errors import ConfigError, UnreadableFile, Unwritable

OF_A_UNIT = {  # what driftlab writes there, beside the map that the record names
    "": ("unit.json", "unit.npz", "family_map.json"),
    "page": ("report.html", "map.report.html"),
    "explained": FILES["explain"],
}
LONGEST = 1 << 20  # bytes of a line
STAMPS = "inputs.ndjson"  # of each unit that was done: its key, and what its recordings looked like then
NEW, OLD = ".new", ".old"  # of hidden names; no unit's name begins with a dot


class FleetFolder:
    """A fleet's folder, held for one command.

    Attributes
    ----------
    path : Path
    mark : dict
        The content of `fleet.json` as it was found.
    stamps : dict of str to (str, str)
        Key and stamp of the units that were done here, by name.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.path = out, Path(os.path.realpath(out))
        names = os.listdir(self.path) if self.path.exists() else []
        self.mark = mark_of(self.path)
        if names and not self.mark and set(names) - {LOCK, f".{MARK}{NEW}"}:
            raise ConfigError(f"--out {out}: exists and is not the output of an earlier fleet; name another folder")
        for name, said in dict(self.mark.get("written") or {}).items():
            if (self.path / name).exists() and digest(self.path / name) != said:
                raise ConfigError(
                    f"--out {out}: holds {name}, which was changed since driftlab wrote it; move it away, or name "
                    "another folder"
                )
        (self.path / UNITS).mkdir(parents=True, exist_ok=True)
        check_writable(self.path)
        self.lock = Lock(self.path / LOCK, f"--out {out}")
        self.lock.sign()
        if not self.mark:
            self.write(MARK, b'{"schema": 1, "program": "driftlab fleet", "complete": false}\n')
        self._finish()
        self.stamps = dict(_stamps(self.path / STAMPS))
        self._journal = (self.path / STAMPS).open("ab")

    def unit(self, name: str) -> Path:
        """Return the folder of a unit."""
        return self.path / UNITS / name

    def put(self, record: UnitRecord, files: Mapping[str, bytes], stamp: str) -> None:
        """Put a unit in its place, for the one that was there; what others put there is taken along.

        What was made of all units is not of these any more, so the mark says first that it is not complete.
        """
        if self.mark.get("complete"):
            self.mark = {**self.mark, "complete": False}
            self.write(MARK, as_json(self.mark))
        new = self.path / UNITS / f".{record.unit}{NEW}"
        remove(new)
        for name, content in files.items():
            path = new / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        new.mkdir(exist_ok=True)
        (new / "unit.json").write_text(record.model_dump_json(by_alias=True, indent=1) + "\n", encoding="utf-8")
        self._replace(record.unit)
        self.stamp(record.unit, record.key, stamp)

    def stamp(self, unit: str, key: str, stamp: str) -> None:
        """Note what a unit's recordings looked like: as long as they do, it need not be asked what is in them."""
        self.stamps[unit] = key, stamp
        self._journal.write(json.dumps([unit, key, stamp]).encode() + b"\n")
        self._journal.flush()

    def write(self, name: str, content: bytes) -> None:
        """Write a file that is there whole or not at all; `name` is relative to the fleet's folder."""
        path = self.path / name
        new = path.with_name(f".{path.name}{NEW}")
        new.write_bytes(content)
        os.replace(new, path)

    def _replace(self, unit: str) -> None:
        place = self.unit(unit)
        new, old = (place.with_name(f".{unit}{ending}") for ending in (NEW, OLD))
        if place.exists():
            os.rename(place, old)
        os.rename(new, place)
        _take_along(old, place)

    def _finish(self) -> None:
        """Finish what a command that was killed had begun to replace."""
        for path in sorted(path for path in (self.path / UNITS).iterdir() if path.name[0] == "."):
            place = path.with_name(path.name[1:].removesuffix(OLD).removesuffix(NEW))
            if path.name.endswith(OLD):
                if place.exists():
                    _take_along(path, place)
                else:
                    os.rename(path, place)
            elif path.name.endswith(NEW):
                remove(path)

    def close(self) -> None:
        """Give the folder back."""
        self._journal.close()
        if len(self.stamps) * 2 < sum(1 for _ in _stamps(self.path / STAMPS)):
            lines = (json.dumps([unit, *said]) + "\n" for unit, said in self.stamps.items())
            self.write(STAMPS, "".join(lines).encode())
        self.lock.release()


def _take_along(old: Path, place: Path) -> None:
    """Remove a unit's folder that was replaced, but for what driftlab did not write: that goes to the new one."""
    if not old.exists():
        return
    record = record_of(old)
    for inside, ours in OF_A_UNIT.items():
        folder = old / inside
        if folder.is_dir() and not folder.is_symlink():
            for name in set(os.listdir(folder)) - set(OF_A_UNIT):
                if matches(name, ours) or (not inside and record is not None and name == record.map_file):
                    remove(folder / name)
                else:
                    os.rename(folder / name, _free(place / (f"{inside}-{name}" if inside else name)))
    for inside in filter(None, OF_A_UNIT):
        remove(old / inside)
    old.rmdir()


def _free(path: Path) -> Path:
    """Return a path, or one like it, under which nothing is."""
    number = 0
    found = path
    while os.path.lexists(found):
        number += 1
        found = path.with_name(f"{path.name}.before-{number}")
    return found


def _stamps(path: Path) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield what was noted of each unit, the last one last; a line that was broken off is none."""
    with suppress(FileNotFoundError), path.open("rb") as file:
        while line := file.readline(LONGEST):
            with suppress(ValueError, RecursionError):
                unit, key, stamp = json.loads(line)
                yield unit, (key, stamp)


@contextmanager
def fleet_folder(out: Path, read: Collection[Path] = ()) -> Iterator[FleetFolder]:
    """Give the folder of a fleet to grow in; `read` are files that are needed and must not be in it.

    Raises
    ------
    ConfigError
        If it is not driftlab's, cannot be written, or is being written.
    Unwritable
        If the disk is full, or the like.
    """
    inside = Path(os.path.realpath(out))
    for path in read:
        if Path(os.path.realpath(path)).is_relative_to(inside):
            raise ConfigError(f"--out {out}: holds {path}, which is used here; name another folder")
    try:
        held = FleetFolder(out)
    except OSError as error:
        kind = Unwritable if error.errno in FULL else ConfigError
        raise kind(f"--out {out}: cannot be written ({reason(error)}); name a folder that can be") from None
    try:
        yield held
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.errno not in {*FULL, errno.EACCES, errno.EPERM}:
            raise
        raise Unwritable(
            f"--out {out}: cannot be written ({reason(error)}); make room and give the same command again, what is "
            "done stays"
        ) from error
    finally:
        held.close()


def as_json(content: Mapping[str, Any]) -> bytes:
    """Return the content of a JSON file."""
    from driftlab.storage.json import plain

    return (json.dumps(plain(dict(content)), indent=1, allow_nan=False) + "\n").encode()


MARK = "fleet.json"  # what says that a folder is a fleet
UNITS = "units"


@dataclass(frozen=True)
class UnitRef:
    """Where a unit of a fleet's folder is, and its lot."""

    folder: Path
    unit: str
    lot: str

    def read(self) -> tuple[UnitInformation, str]:
        """Return what its soaks say, and its lot; raises UnreadableFile."""
        return soaked_of(self.folder / UNITS / self.unit), self.lot


class UnitStore:
    """The units of a fleet's folder that were soaked, in the order of their names; may be gone through again and again.

    Parameters
    ----------
    folder : Path
        Of the fleet.
    units : sequence of (str, str), optional
        Names and lots of those that count, in their order; all that are done and did not leave the manifest where it is
        left out.

    Raises
    ------
    UnreadableFile
        If the folder is no fleet; while one goes through it, if a file is damaged.
    """

    def __init__(self, folder: Path, units: Sequence[tuple[str, str]] | None = None) -> None:
        self.folder = folder
        self.units = list(_units_of(folder) if units is None else units)

    def __len__(self) -> int:
        return len(self.units)

    def __iter__(self) -> Iterator[tuple[UnitInformation, str]]:
        """Yield what the soaks of each unit say, and its lot."""
        for place in self.places():
            yield place.read()

    def places(self) -> Iterator[UnitRef]:
        """Yield where each unit is."""
        for name, lot in self.units:
            yield UnitRef(self.folder, name, lot)

    def only(self, places: Collection[int]) -> UnitStore:
        """Return some of the units, by their places in the order."""
        return UnitStore(self.folder, [self.units[k] for k in sorted(places)])

    def records(self) -> Iterator[UnitRecord]:
        """Yield the record of each unit."""
        for name, _ in self.units:
            record = record_of(self.folder / UNITS / name)
            if record is None:
                raise UnreadableFile(f"{self.folder / UNITS / name / 'unit.json'}: {AGAIN}")
            yield record


AGAIN = "is missing or damaged; give the same command again, it does this unit anew"


def record_of(folder: Path) -> UnitRecord | None:
    """Return the record in a unit's folder; None where there is none that can be read."""
    try:
        return UnitRecord.model_validate_json(read_whole(folder / "unit.json"))
    except (OSError, ValidationError):
        return None


def soaked_of(folder: Path) -> UnitInformation:
    """Return what the soaks of a unit say, from its folder; raises UnreadableFile."""
    path = folder / "unit.npz"
    try:
        return UnitInformation.from_bytes(read_whole(path, PIECE))
    except Exception:  # of a damaged archive nearly any
        raise UnreadableFile(
            f"{path}: is missing or damaged; remove the folder and give the same command again"
        ) from None


def mark_of(folder: Path) -> dict[str, Any]:
    """Return the content of `fleet.json`; empty where there is none that can be read."""
    try:
        found = json.loads(read_whole(folder / MARK, PIECE))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and "schema" in found else {}


def _units_of(folder: Path) -> Iterator[tuple[str, str]]:
    mark = mark_of(folder)
    if not mark:
        raise UnreadableFile(
            f"{folder}: is no fleet, it has no {MARK} that can be read; name the --out of driftlab fleet"
        )
    gone = set(mark.get("left", ()))
    for path in sorted((folder / UNITS).iterdir()):
        if path.name[0] != "." and path.name not in gone:
            record = record_of(path)
            if record is not None and record.state == "done":
                yield record.unit, record.lot
