"""The folder of a fleet, which grows in place: each unit is there whole or not at all.

A fleet takes hours, so what is done is not kept back until all is (docs/adr/0052). The rules of all folders hold: one
writer, by a lock; what driftlab did not write is never removed, not even from a unit's folder; and what cannot be done
again, since its recordings are not there any more, is replaced only on demand.

Records of units (`unit.json`) are read once a command, and kept in brief; their soaks (`unit.npz`) are read one at a
time, as they are needed.
"""

from __future__ import annotations

import errno
import json
import os
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from driftlab.family.partitions import A_FEW, SIZE, Engine, Partitions, Scratch, UnitOfLot, serial
from driftlab.family.record import UnitRecord
from driftlab.family.unit_records import UnitRecords
from driftlab.production.unit_folders import (
    MARK,
    NEW,
    PAGE,
    RECORD,
    SCRATCH,
    UnitFolders,
    UnitPlace,
    content_of,
    digests,
    write_whole,
)
from driftlab.production.unit_store import open_store
from driftlab.storage import ownership
from driftlab.storage.folders import FULL, LOCK, Lock, check_writable, refusals, remove
from driftlab.storage.hdf5 import reason
from driftlab.storage.json import plain
from driftlab.storage.ownership import check_folder, foreign, free, is_as
from fusion_core.errors import ConfigError, Unwritable, quote

TABLE, FAMILY, REPORT = "units.parquet", "family.json", "report.html"  # of all units
OF_ALL = (TABLE, FAMILY, REPORT)
LONGEST = 1 << 20  # bytes of a line
STAMPS = "inputs.ndjson"  # of each unit that was done: its key, and what its recordings looked like then


class FleetFolder:
    """A fleet's folder, held for one command.

    Attributes
    ----------
    path : Path
    mark : dict
        The content of `fleet.json`.
    units : UnitFolders
        Those of the units: in the folder, or behind the URL `store`.
    """

    def __init__(self, out: Path, store: str | None = None) -> None:
        self.out, self.path = out, Path(os.path.realpath(out))
        self._read_mark()
        self.path.mkdir(parents=True, exist_ok=True)
        check_writable(self.path)
        self.lock = Lock(self.path / LOCK, f"--out {out}")
        try:
            self.lock.sign()
            self._read_mark()  # as whoever had the lock has left it
            url = self._url(store)
            if not self.mark:
                more = {} if url is None else {"store": url, "id": uuid4().hex}
                self.write_mark({"schema": 1, "program": "driftlab fleet", "complete": False, **more})
            remove(self.path / SCRATCH)
            self.place = UnitPlace(self.path, (self.path / LOCK).read_bytes())
            self.units: UnitFolders = self.place
            if url is None:
                self.place.finish()
            else:
                self.units = open_store(url, self.mark["id"])
            self._stamps = _Stamps(self.path / STAMPS)
            if self._stamps.replaced:
                self.write(STAMPS, "".join(json.dumps(note) + "\n" for note in self._stamps.last()).encode())
            self.records = UnitRecords()
            self._journal = (self.path / STAMPS).open("ab")
        except BaseException:
            self.lock.release()
            raise

    def _read_mark(self) -> None:
        """Read the mark; raises ConfigError where the folder is no fleet's, or is complete and was edited since."""
        names = set(os.listdir(self.path)) if self.path.exists() else set()
        mark = ownership.document(self.path / MARK)
        self.mark, self.written = mark if "schema" in mark else {}, ownership.written(self.path / MARK)
        if not self.written and names - {LOCK, f".{MARK}{NEW}"}:
            raise ConfigError(
                f"--out {self.out}: exists and is not the output of an earlier fleet; move it away, or name another "
                "folder"
            )
        changed = foreign(self.path, MARK, {MARK, *({*OF_ALL} & names)}) if self.mark else []
        check_folder(f"--out {self.out}", changed if self.mark.get("complete") or MARK in changed else [])

    def _url(self, store: str | None) -> str | None:
        """Return the URL of the units' folders, None if here; raises ConfigError if they were put elsewhere."""
        known = self.mark.get("store")
        if self.mark and store not in (None, known):
            raise ConfigError(
                f"--store {quote(store or '', 200)}: the units of {self.out} are in {known or 'the folder itself'}; "
                "leave --store out, or name another folder with --out"
            )
        return known or store

    def brief(self, name: str) -> UnitRecord | None:
        """Return the record of a unit in brief, of which the file is read once; None where it cannot be read."""
        if name not in self.records:
            record = self.units.record(name)
            if record is None:
                return None
            self.records[name] = record
        return self.records[name]

    def begin(self) -> None:
        """Note that what was made of all units will not be of these any more."""
        if self.mark.get("complete"):
            self.write_mark({**self.mark, "complete": False})

    def put(self, record: UnitRecord, files: Mapping[str, bytes], stamp: str) -> None:
        """Put a unit in its place, for the one that was there; what others put there is taken along."""
        self.begin()
        self.noted(self.units.put(record, files), stamp)

    def noted(self, record: UnitRecord, stamp: str) -> None:
        """Note a unit that was put in its place."""
        self.records[record.unit] = record
        self.stamp(record.unit, record.key, stamp)

    def put_page(self, unit: str, files: Mapping[str, bytes]) -> None:
        """Put the pages among the files of a unit into its folder, whole or not at all.

        The map there stays, though it was fitted again for them: they name that one, and so does the record.
        """
        record = self.units.record(unit)
        pages = {name: text for name, text in files.items() if name.startswith(f"{PAGE}/")}
        if pages and record is not None:
            for name in files.keys() & record.written.keys() - pages.keys():
                made, known = digests(files)[name].encode(), record.written[name].encode()
                pages = {page: text.replace(made, known) for page, text in pages.items()}
            self.note(record.model_copy(update={"written": record.written | digests(pages)}))
            self.units.put_page(unit, pages)

    def put_certificate(self, unit: str, content: Mapping[str, Any], files: Mapping[str, bytes]) -> None:
        """Put a certificate among the files of a unit, in the place of an earlier one of other results.

        One that was edited is put aside; one of the same results stays, and so does its date of issue.
        """
        record = self.units.record(unit)
        assert record is not None
        (name,) = (name for name in files if name.endswith(".json"))
        with self.units.file(unit, name) as path:
            before = ownership.document(path).get("identification")
        if before == content["identification"] and all(
            self.units.is_as(unit, name, record.written.get(name, "")) for name in files
        ):
            return
        for name in files:
            self.units.clear(unit, name, record.written.get(name, ""))
        known = record.written | digests(files)
        self.note(record.model_copy(update={"written": known}))  # known before they are there
        for name in files:
            self.units.write(unit, name, files[name])

    def note(self, record: UnitRecord) -> None:
        """Write the record of a unit anew, which is there already; one that was edited is put aside."""
        self.units.write(record.unit, RECORD, content_of(record))
        self.records[record.unit] = record

    def as_it_was(self, unit: str, stamp: str) -> bool:
        """Return True if a unit had this stamp when it was last done, before this command."""
        return bool(stamp) and self._stamps.is_last(unit, stamp)

    def stamp(self, unit: str, key: str, stamp: str) -> None:
        """Note the state of a unit's recordings: as long as it stays, their contents need not be read."""
        self._journal.write(json.dumps([unit, key, stamp]).encode() + b"\n")
        self._journal.flush()

    def write(self, name: str, content: bytes) -> None:
        """Write a file that is there whole or not at all; one that says its own SHA-256, and was edited, is put aside.

        `name` is relative to the fleet's folder.
        """
        write_whole(self.path / name, content)

    def write_mark(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Write `fleet.json` and return its content: it knows itself and the files of all units."""
        self.write(MARK, ownership.signed(plain(dict(content)), MARK, self.written).encode())
        self.mark = {**content, "written": ownership.document(self.path / MARK)["written"]}
        return self.mark

    def hidden(self, name: str) -> Path:
        """Return the name of a file of all units until it is published."""
        return self.path / f".{name}{NEW}"

    def publish(self, names: Collection[str]) -> None:
        """Put files of all units in their places; others of such names go, or are put aside where they were edited.

        The mark knows them first, as they were written: whatever is there is known at any moment.
        """
        for path in (self.path / name for name in OF_ALL):
            if is_as(path, self.written.get(path.name, "")):
                remove(path)
            elif os.path.lexists(path):
                os.rename(path, free(path))
        self.written = {name: ownership.digest(self.hidden(name)) for name in names}
        self.write_mark(self.mark)
        for name in names:
            os.replace(self.hidden(name), self.path / name)

    def close(self) -> None:
        """Give the folder back."""
        try:
            self._journal.close()
        finally:
            self.lock.release()


class _Stamps:
    """The notes on stamps when a fleet is opened, as hashes: the names of a million units are a quarter of a gigabyte.

    `replaced` is True where later notes replace half of them.
    """

    def __init__(self, path: Path) -> None:
        self.path, units, stamps = path, array("q"), array("q")
        for unit, _, stamp in self._notes():
            units.append(hash(unit))
            stamps.append(hash(stamp))
        back, self.count = np.frombuffer(units, dtype=np.int64)[::-1], len(units)
        self._units, places = np.unique(back, return_index=True)
        self._last = self.count - 1 - places
        self._known = np.frombuffer(stamps, dtype=np.int64)[self._last]
        self.replaced = len(self._last) * 2 < self.count

    def _notes(self) -> Iterator[tuple[str, str, str]]:
        """Yield name, key and stamp of each unit, the last note last; a line that was broken off is none."""
        with suppress(FileNotFoundError), self.path.open("rb") as file:
            while line := file.readline(LONGEST):
                with suppress(ValueError, RecursionError):
                    unit, key, stamp = json.loads(line)
                    yield str(unit), key, str(stamp)

    def last(self) -> Iterator[tuple[str, str, str]]:
        """Yield the last note on each unit."""
        some = np.zeros(self.count, dtype=bool)
        some[self._last] = True
        return compress(self._notes(), some)

    def is_last(self, unit: str, stamp: str) -> bool:
        """Return True if the last note on a unit has a stamp."""
        place = int(np.searchsorted(self._units, hash(unit)))
        return place < len(self._units) and self._units[place] == hash(unit) and self._known[place] == hash(stamp)


@contextmanager
def fleet_folder(out: Path, read: Collection[Path] = (), store: str | None = None) -> Iterator[FleetFolder]:
    """Give the folder of a fleet to grow in; `read` are files that are needed and must not be in it.

    `store` is a URL under which the folders of units are to be, if not in it.

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
    with refusals(f"--out {out}", "name a folder that can be"):
        held = FleetFolder(out, store)
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


@dataclass(frozen=True)
class StoredUnits(Sequence[UnitOfLot]):
    """A partition of the units in `folders`, by names and lots; each is read when it is asked for."""

    folders: UnitFolders
    names: tuple[str, ...]
    lots: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def read(self) -> StoredUnits:
        """Return it."""
        return self

    def __getitem__(self, k: Any) -> Any:
        """Return the information of a unit's soaks, and its lot; raises UnreadableFile if a file is damaged."""
        return self.folders.information(self.names[k]), self.lots[k]


def stored_units(
    folders: UnitFolders, units: Sequence[str], lots: Sequence[str], engine: Engine = serial,
    scratch: Scratch | None = None,
) -> Partitions[Sequence[UnitOfLot]]:  # fmt: skip
    """Return units in folders by names and lots; workers keep files in `scratch`. Of few units all have some to do."""
    size = max(A_FEW, min(SIZE, -(-len(units) // A_FEW)))
    cuts = [slice(k, k + size) for k in range(0, len(units), size)]
    return Partitions([StoredUnits(folders, tuple(units[k]), tuple(lots[k])) for k in cuts], engine, scratch)
