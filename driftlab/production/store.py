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
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from secrets import token_hex
from typing import Any

from pydantic import ValidationError

from driftlab.family.partitions import SIZE, Engine, Partitions, UnitOfLot, serial
from driftlab.family.record import UnitRecord
from driftlab.family.unit_information import UnitInformation
from driftlab.production.unit_records import UnitRecords
from driftlab.storage import ownership
from driftlab.storage.folders import FULL, LOCK, Lock, check_writable, refusals, remove
from driftlab.storage.hdf5 import reason
from driftlab.storage.json import plain
from driftlab.storage.ownership import OWN, check_folder, foreign, free, is_as
from fusion_core.budget import PIECE, read_whole
from fusion_core.errors import ConfigError, UnreadableFile, Unwritable

INSIDE = ("page", "explained", "")  # folders of a unit in which driftlab writes; the one with the record is the last
LONGEST = 1 << 20  # bytes of a line
SCRATCH = ".family.new"  # folder in which workers keep what the family's passes need
STAMPS = "inputs.ndjson"  # of each unit that was done: its key, and what its recordings looked like then
PAGE = "page"  # folder of a unit's pages
NEW, OLD = ".new", ".old"  # of hidden names; no unit's name begins with a dot


class FleetFolder:
    """A fleet's folder, held for one command.

    Attributes
    ----------
    path : Path
    mark : dict
        The content of `fleet.json`.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.path = out, Path(os.path.realpath(out))
        self._read_mark()
        self.path.mkdir(parents=True, exist_ok=True)
        check_writable(self.path)
        self.lock = Lock(self.path / LOCK, f"--out {out}")
        try:
            self.lock.sign()
            self._read_mark()  # as whoever had the lock has left it
            if not self.mark:
                self.write_mark({"schema": 1, "program": "driftlab fleet", "complete": False})
            (self.path / UNITS).mkdir(exist_ok=True)
            self._finish()
            self._shorten()
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
        if not self.mark and names - {LOCK, f".{MARK}{NEW}"}:
            raise ConfigError(
                f"--out {self.out}: exists and is not the output of an earlier fleet; move it away, or name another "
                "folder"
            )
        if self.mark and not self.written:
            raise ConfigError(
                f"--out {self.out}: is of a version that kept no SHA-256 of its files; move it away, or name another "
                "folder"
            )
        changed = foreign(self.path, MARK, {MARK, *({*OF_ALL} & names)}) if self.mark else []
        check_folder(f"--out {self.out}", changed if self.mark.get("complete") or MARK in changed else [])

    def unit(self, name: str) -> Path:
        """Return the folder of a unit."""
        return self.path / UNITS / name

    def record(self, name: str) -> UnitRecord | None:
        """Return the record of a unit; None where there is none that can be read."""
        return record_of(self.unit(name))

    def brief(self, name: str) -> UnitRecord | None:
        """Return the record of a unit in brief, of which the file is read once; None where it cannot be read."""
        if name not in self.records:
            record = self.record(name)
            if record is None:
                return None
            self.records[name] = record
        return self.records[name]

    @property
    def place(self) -> UnitPlace:
        """The place of the units, for whoever puts some there for this command."""
        return UnitPlace(self.path, (self.path / LOCK).read_bytes())

    def begin(self) -> None:
        """Note that what was made of all units will not be of these any more."""
        if self.mark.get("complete"):
            self.write_mark({**self.mark, "complete": False})

    def put(self, record: UnitRecord, files: Mapping[str, bytes], stamp: str) -> None:
        """Put a unit in its place, for the one that was there; what others put there is taken along."""
        self.begin()
        self.noted(self.place.put(record, files), stamp)

    def noted(self, record: UnitRecord, stamp: str) -> None:
        """Note a unit that was put in its place."""
        self.records[record.unit] = record
        self.stamp(record.unit, record.key, stamp)

    def put_page(self, unit: str, files: Mapping[str, bytes]) -> None:
        """Put the pages among the files of a unit into its folder, whole or not at all.

        The map there stays, though it was fitted again for them: they name that one, and so does the record.
        """
        record, place = self.record(unit), self.unit(unit) / PAGE
        pages = {name: text for name, text in files.items() if name.startswith(f"{PAGE}/")}
        if pages and record is not None:
            for name in files.keys() & record.written.keys() - pages.keys():
                made, known = _digests(files)[name].encode(), record.written[name].encode()
                pages = {page: text.replace(made, known) for page, text in pages.items()}
            self.note(record.model_copy(update={"written": record.written | _digests(pages)}))
            if os.path.lexists(place):  # somebody's
                os.rename(place, free(place))
            named = {Path(name).name: pages[name] for name in pages}
            os.rename(_made(self.path / UNITS / f".{unit}.{PAGE}{NEW}", named), place)

    def put_certificate(self, unit: str, content: Mapping[str, Any], files: Mapping[str, bytes]) -> None:
        """Put a certificate among the files of a unit, in the place of an earlier one of other results.

        One that was edited is put aside; one of the same results stays, and so does its date of issue.
        """
        record, place = self.record(unit), self.unit(unit)
        assert record is not None
        as_written = [is_as(place / name, record.written.get(name, "")) for name in files]
        before = [ownership.document(place / name) for name in files if name.endswith(".json")]
        if all(as_written) and all(one.get("identification") == content["identification"] for one in before):
            return
        for name, own in zip(files, as_written, strict=True):
            if own:
                remove(place / name)
            elif os.path.lexists(place / name):
                os.rename(place / name, free(place / name))
        self.note(
            record.model_copy(update={"written": record.written | _digests(files)})
        )  # known before they are there
        for name in files:
            self.write(f"{UNITS}/{unit}/{name}", files[name])

    def note(self, record: UnitRecord) -> None:
        """Write the record of a unit anew, which is there already; one that was edited is put aside."""
        self.write(f"{UNITS}/{record.unit}/{RECORD}", _content(record))
        self.records[record.unit] = record

    def stamps(self) -> dict[str, str]:
        """Return the stamps of the units that were done here, by name."""
        return {unit: stamp for unit, _, stamp in _stamps(self.path / STAMPS)}

    def _shorten(self) -> None:
        """Write the notes on stamps anew without those that later ones replace, where these are half of them."""
        last, count = dict[str, int](), 0
        for count, (unit, _, _) in enumerate(_stamps(self.path / STAMPS), 1):
            last[unit] = count
        if len(last) * 2 < count:
            notes = (note for k, note in enumerate(_stamps(self.path / STAMPS), 1) if last[note[0]] == k)
            self.write(STAMPS, "".join(json.dumps(note) + "\n" for note in notes).encode())

    def stamp(self, unit: str, key: str, stamp: str) -> None:
        """Note the state of a unit's recordings: as long as it stays, their contents need not be read."""
        self._journal.write(json.dumps([unit, key, stamp]).encode() + b"\n")
        self._journal.flush()

    def write(self, name: str, content: bytes) -> None:
        """Write a file that is there whole or not at all; one that says its own SHA-256, and was edited, is put aside.

        `name` is relative to the fleet's folder.
        """
        path = self.path / name
        new = path.with_name(f".{path.name}{NEW}")
        new.write_bytes(content)
        if path.name in (MARK, RECORD) and os.path.lexists(path) and foreign(path.parent, path.name, [path.name]):
            os.rename(path, free(path))
        os.replace(new, path)

    def write_mark(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Write `fleet.json` and return its content: it knows itself and the files of all units."""
        self.write(MARK, ownership.signed(plain(dict(content)), MARK, self.written).encode())
        self.mark = {**content, "written": ownership.document(self.path / MARK)["written"]}
        return self.mark

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Give a folder for files that are needed until the end of the command."""
        path = self.path / SCRATCH
        remove(path)
        path.mkdir(mode=0o700)
        try:
            yield path
        finally:
            remove(path)

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

    def _finish(self) -> None:
        """Finish what a command that was killed had begun to replace."""
        remove(self.path / SCRATCH)
        for path in sorted(path for path in (self.path / UNITS).iterdir() if path.name[0] == "."):
            if path.name.endswith(OLD):
                place = path.with_name(path.name[1:].removesuffix(OLD))
                if os.path.lexists(place):
                    _take_along(path, place)
                else:
                    os.rename(path, place)
            elif path.name.endswith(NEW):
                remove(path)

    def close(self) -> None:
        """Give the folder back."""
        try:
            self._journal.close()
        finally:
            self.lock.release()


@dataclass(frozen=True)
class UnitPlace:
    """The place of the units of a fleet's folder, as long as a command holds that: `signed` is its lock's content."""

    path: Path
    signed: bytes

    def reached(self) -> bool:
        """Return True if this process sees the folder, and the command still holds it."""
        try:
            return (self.path / LOCK).read_bytes() == self.signed
        except OSError:
            return False

    def put(self, record: UnitRecord, files: Mapping[str, bytes]) -> UnitRecord:
        """Put a unit in its place, for the one that was there; what others put there is taken along.

        Return its record, which knows the files. Whoever else does the same writes beside it, not over it.
        """
        record = record.model_copy(update={"written": _digests(files)})
        place, hidden = self.path / UNITS / record.unit, f".{record.unit}"
        old = place.with_name(f"{hidden}{OLD}")
        new = _made(place.with_name(f"{hidden}.{token_hex(6)}{NEW}"), {**files, RECORD: _content(record)})
        if os.path.lexists(place):
            _take_along(old, place)  # of one who ended here
            os.rename(place, old)
        os.rename(new, place)
        _take_along(old, place)
        return record


def _made(folder: Path, files: Mapping[str, bytes]) -> Path:
    """Return a new folder with files in it."""
    remove(folder)
    for file, content in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(content)
    return folder


def _content(record: UnitRecord) -> bytes:
    record = record.model_copy(update={"written": {**record.written, RECORD: OWN}})
    return ownership.with_own(record.model_dump_json(by_alias=True, indent=1) + "\n").encode()


def _digests(files: Mapping[str, bytes]) -> dict[str, str]:
    return {name: sha256(content).hexdigest() for name, content in files.items()}


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
            others = [
                n for n in foreign(old, RECORD, names) if n != FAMILY_MAP or ownership.why_not_own(old / n, COMMAND)
            ]
            for name in sorted(names, key=RECORD.__eq__):  # the record, which knows the others, is the last
                if name in others:
                    os.rename(old / name, free(place / name.replace("/", "-")))
                else:
                    remove(old / name)
            folder.rmdir()


def _stamps(path: Path) -> Iterator[tuple[str, str, str]]:
    """Yield name, key and stamp of each unit, the last note last; a line that was broken off is none."""
    with suppress(FileNotFoundError), path.open("rb") as file:
        while line := file.readline(LONGEST):
            with suppress(ValueError, RecursionError):
                unit, key, stamp = json.loads(line)
                yield unit, key, stamp


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
    with refusals(f"--out {out}", "name a folder that can be"):
        held = FleetFolder(out)
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


MARK = "fleet.json"  # mark of a fleet's folder
TABLE, FAMILY, REPORT = "units.parquet", "family.json", "report.html"  # of all units
OF_ALL = (TABLE, FAMILY, REPORT)
UNITS, RECORD = "units", "unit.json"  # folder of the units, and the record in each of theirs
FAMILY_MAP, COMMAND = "family_map.json", "fleet"  # in the folder of a unit, which knows itself and this command


@dataclass(frozen=True)
class StoredUnits(Sequence[UnitOfLot]):
    """A partition of units of a fleet's `folder`, by names and lots; each is read when it is asked for."""

    folder: Path
    names: tuple[str, ...]
    lots: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def read(self) -> StoredUnits:
        """Return it."""
        return self

    def __getitem__(self, k: Any) -> Any:
        """Return the information of a unit's soaks, and its lot; raises UnreadableFile if a file is damaged."""
        path = self.folder / UNITS / self.names[k] / "unit.npz"
        try:
            return UnitInformation.from_bytes(read_whole(path, PIECE)), self.lots[k]
        except IndexError:
            raise
        except Exception:  # of a damaged archive nearly any
            raise UnreadableFile(
                f"{path}: is missing or damaged; remove the folder and give the same command again"
            ) from None


def stored_units(
    folder: Path, units: Sequence[str], lots: Sequence[str], engine: Engine = serial, scratch: Path | None = None
) -> Partitions[Sequence[UnitOfLot]]:  # fmt: skip
    """Return units of a fleet's folder by names and lots; workers keep files in `scratch`."""
    cuts = [slice(k, k + SIZE) for k in range(0, len(units), SIZE)]
    return Partitions([StoredUnits(folder, tuple(units[k]), tuple(lots[k])) for k in cuts], engine, scratch)


def record_of(folder: Path) -> UnitRecord | None:
    """Return the record in a unit's folder; None where there is none that can be read."""
    try:
        return UnitRecord.model_validate_json(read_whole(folder / RECORD))
    except (OSError, ValidationError):
        return None
