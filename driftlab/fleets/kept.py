"""What a folder of a fleet holds of each unit, one at a time: memory does not grow with the units."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from driftlab.family.record import UnitRecord
from driftlab.family.soaked import Soaked
from fusion_core.budget import PIECE, read_whole
from fusion_core.errors import UnreadableFile

MARK = "fleet.json"  # what says that a folder is a fleet
UNITS = "units"


@dataclass(frozen=True)
class Place:
    """Where a unit of a fleet's folder is, and its lot."""

    folder: Path
    unit: str
    lot: str

    def read(self) -> tuple[Soaked, str]:
        """Return what its soaks say, and its lot; raises UnreadableFile."""
        return soaked_of(self.folder / UNITS / self.unit), self.lot


class Kept:
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

    def __iter__(self) -> Iterator[tuple[Soaked, str]]:
        """Yield what the soaks of each unit say, and its lot."""
        for place in self.places():
            yield place.read()

    def places(self) -> Iterator[Place]:
        """Yield where each unit is."""
        for name, lot in self.units:
            yield Place(self.folder, name, lot)

    def only(self, places: Collection[int]) -> Kept:
        """Return some of the units, by their places in the order."""
        return Kept(self.folder, [self.units[k] for k in sorted(places)])

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


def soaked_of(folder: Path) -> Soaked:
    """Return what the soaks of a unit say, from its folder; raises UnreadableFile."""
    path = folder / "unit.npz"
    try:
        return Soaked.from_bytes(read_whole(path, PIECE))
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
