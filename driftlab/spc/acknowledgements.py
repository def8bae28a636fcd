"""Alarms of units, and acknowledgements of them: a note that stays as long as the alarm is the same one.

An alarm is the same while what it is about is: figure, axis and kind, the unit's own value of a figure, the unit's
recordings, and the family whose limits are frozen. Limits that move with every unit of a line change no alarm. A unit
is acknowledged where its notes are about all of its alarms.
"""

from __future__ import annotations

import getpass
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from driftlab.family.outlier_tests import FIGURES
from driftlab.family.outliers import Outlier
from driftlab.family.record import UnitRecord
from fusion_core.errors import ConfigError, quote
from fusion_core.escaping import is_plain
from fusion_core.faults import DOUBT

LONGEST = 1000  # characters of a note


@dataclass(frozen=True)
class Alarm:
    """A reason to look at a unit: `about`, by which it is known again, and its text."""

    about: str
    text: str


def of_outlier(outlier: Outlier) -> Alarm:
    """Return the alarm of a unit that is not as in its family."""
    if outlier.what == DOUBT:
        return Alarm(outlier.sentence, outlier.sentence)
    value = f" {outlier.value:.3g}" if outlier.what in FIGURES else ""
    return Alarm(f"{outlier.axis} {outlier.what}{value}: odd", outlier.sentence)


class Acknowledgement(BaseModel):
    """A note on the alarms of a unit.

    Attributes
    ----------
    unit, note, by : str
        `by` is the name of who wrote it.
    at : str
        Time, ISO 8601 with its zone.
    about, reasons : list of str
        What the alarms were about, and their texts.
    basis : str
        Hash of the unit's recordings and of the family with the frozen limits.
    """

    model_config = ConfigDict(frozen=True)

    unit: str
    note: str
    by: str
    at: str
    about: list[str]
    reasons: list[str]
    basis: str

    def text(self) -> str:
        """Return the note, its author and its day."""
        return f"{self.note} ({self.by}, {self.at[:10]})"

    def brief(self) -> dict[str, str]:
        """Return note, author and time."""
        return {"note": self.note, "by": self.by, "at": self.at}


def basis_of(record: UnitRecord, family: str) -> str:
    """Return the hash of a unit's recordings, by their own, and of a family's file by its SHA-256."""
    own = [[role, [one.get("sha256", "") for one in named]] for role, named in sorted(record.recordings.items())]
    return sha256(repr((own, family)).encode()).hexdigest()[:32]


def checked(notes: Mapping[str, str], operator: str | None, units: Iterable[str]) -> str:
    """Return the name of who writes notes, by default that of the account; raises ConfigError where one is wrong."""
    for unit in notes.keys() - set(units):
        raise ConfigError(f"--acknowledge {quote(unit)}: no unit is called so; name one of the manifest, as UNIT=NOTE")
    for unit, note in notes.items():
        if not note or not is_plain(note) or len(note) > LONGEST:
            raise ConfigError(
                f"--acknowledge {quote(unit)}: '{quote(note)}' is no note of one line; write why it is known"
            )
    try:
        by = getpass.getuser() if operator is None and notes else operator or ""
    except (OSError, KeyError):
        by = ""
    if notes and not (by.strip() and is_plain(by) and len(by) <= LONGEST):
        raise ConfigError(f"--operator '{quote(by)}': is no name of one line; write who acknowledges")
    return by.strip()


def known_notes(mark: Mapping[str, Any], subject: str) -> list[Acknowledgement]:
    """Return the notes that `fleet.json` has; raises ConfigError where another version wrote them otherwise."""
    try:
        return TypeAdapter(list[Acknowledgement]).validate_python(mark.get("acknowledgements", []))
    except ValidationError:
        raise ConfigError(
            f"{subject}: fleet.json has acknowledgements as this version does not know them; use the version of "
            "driftlab that wrote it, or name another folder"
        ) from None


def new_notes(
    notes: Mapping[str, str], by: str, alarms: Mapping[str, Sequence[Alarm]], basis: Mapping[str, str]
) -> list[Acknowledgement]:
    """Return the acknowledgements of new notes by unit, each of all alarms of its unit; none of a unit without one."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return [
        Acknowledgement(
            unit=unit, note=note, by=by, at=now, about=[one.about for one in alarms[unit]],
            reasons=[one.text for one in alarms[unit]], basis=basis[unit],
        )
        for unit, note in notes.items() if unit in alarms
    ]  # fmt: skip


def in_force(
    known: Iterable[Acknowledgement], alarms: Mapping[str, Sequence[Alarm]], basis: Mapping[str, str]
) -> dict[str, Acknowledgement]:
    """Return the last note on each unit whose alarms are all acknowledged, in the order of `alarms`."""
    by_unit: dict[str, list[Acknowledgement]] = {}
    for one in known:
        if one.unit in alarms and one.basis == basis[one.unit]:
            by_unit.setdefault(one.unit, []).append(one)
    found = {}
    for unit, of_unit in alarms.items():
        notes = by_unit.get(unit, [])
        if notes and {one.about for one in of_unit} <= {about for note in notes for about in note.about}:
            found[unit] = notes[-1]
    return found
