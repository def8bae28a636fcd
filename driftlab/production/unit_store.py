"""Folders of a fleet's units behind a URL (`s3://`, `gs://`, `abfs://`), through fsspec.

A store knows whole objects only: each is there whole or not at all. So the record of a unit is removed first and
written last, and where it is there, all of the unit is. Objects under driftlab's names are replaced, and those of an
earlier record that a unit has no more are removed; no other one is touched. Nothing is put aside: a bucket may keep
versions.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from driftlab.family.record import UnitRecord
from driftlab.production.remote import is_url, system_of
from driftlab.production.unit_folders import PAGE_FILE, RECORD, SCRATCH, UNITS, UnitFolders, content_of, digests
from fusion_core.errors import ConfigError, FusionError, Unwritable, describe_error, quote

HELD = "driftlab.json"  # says which fleet a store is of


def open_store(url: str, fleet: str) -> UnitStore:
    """Return the store of a fleet, by its id, behind a URL; a new one is begun where nothing is.

    Raises
    ------
    ConfigError
        If it is no URL of a store, is of another fleet, or something else is there.
    Unwritable
        If it cannot be reached.
    """
    store = UnitStore(url.rstrip("/"), fleet)
    subject = f"--store {quote(url, 200)}"
    if not is_url(url) or url.startswith(("file:", "http:", "https:")):
        raise ConfigError(
            f"{subject}: is no URL of a store; write one as s3://BUCKET/LINE, or name a folder with --out"
        )
    try:
        said = json.loads(store.get(HELD))
    except (FileNotFoundError, ValueError):
        said = None
    if said is None and store.find(""):
        raise ConfigError(f"{subject}: has objects that no fleet of driftlab wrote; name another place in the store")
    if said is not None and said != store.owner:
        raise ConfigError(f"{subject}: has the units of another fleet; name another place in the store")
    if said is None:
        store.pipe(HELD, json.dumps(store.owner).encode())
    return store


@dataclass(frozen=True)
class UnitStore(UnitFolders):
    """Folders of units behind a URL; `fleet` is the id of the fleet that they are of."""

    url: str
    fleet: str

    @property
    def root(self) -> str:
        """The URL of the units."""
        return f"{self.url}/{UNITS}"

    @property
    def owner(self) -> dict[str, str]:
        """Content of `driftlab.json`: the fleet that the store is of."""
        return {"program": "driftlab fleet", "id": self.fleet}

    def get(self, name: str) -> bytes:
        """Return the content of an object; raises FileNotFoundError."""
        return bytes(self._ask("cat_file", name))

    def pipe(self, name: str, content: bytes) -> None:
        """Write an object; raises Unwritable."""
        try:
            self._ask("pipe_file", name, content)
        except FileNotFoundError as error:
            raise Unwritable(
                f"--store {self.url}: there is no such bucket ({error}); create it, or name another"
            ) from None

    def find(self, folder: str) -> list[str]:
        """Return the names of the objects under a name, from there on."""
        system, root = system_of(self.url)
        system.invalidate_cache()
        start = f"{root.rstrip('/')}/{folder}".rstrip("/")
        try:
            return sorted(str(name)[len(start) + 1 :] for name in self._ask("find", folder))
        except FileNotFoundError:
            return []

    def remove(self, folder: str, names: Sequence[str]) -> None:
        """Remove objects under a name."""
        for name in names:
            self._ask("rm_file", f"{folder}/{name}")

    def _ask(self, method: str, name: str, *args: Any) -> Any:
        """Ask the file system about an object; raises FileNotFoundError, and Unwritable where it cannot be reached."""
        system, root = system_of(self.url)
        try:
            return getattr(system, method)(f"{root.rstrip('/')}/{name}".rstrip("/"), *args)
        except (FileNotFoundError, FusionError):
            raise
        except Exception as error:
            raise Unwritable(
                f"--store {self.url}: cannot be reached ({describe_error(error)}); see to access and network, and give "
                "the same command again, what is done stays"
            ) from error

    def reached(self) -> bool:
        """Return True if this process reaches the store, and it is of this fleet."""
        try:
            return bool(json.loads(self.get(HELD)) == self.owner)
        except (OSError, ValueError, FusionError):
            return False

    def names(self, name: str = RECORD) -> list[str]:
        """Return the names of the units that have an object, in order."""
        return [unit for unit, _, found in (path.rpartition("/") for path in self.find(UNITS)) if found == name]

    def read(self, unit: str, name: str) -> bytes:
        """Return the content of an object of a unit; raises FileNotFoundError."""
        return self.get(f"{UNITS}/{unit}/{name}")

    def holds(self, unit: str, name: str = RECORD) -> bool:
        """Return True if a unit has an object."""
        return bool(self._ask("exists", f"{UNITS}/{unit}/{name}"))

    def put(self, record: UnitRecord, files: Mapping[str, bytes]) -> UnitRecord:
        """Put a unit in its place, for the one that was there; return its record, which knows the files."""
        record, old = record.model_copy(update={"written": digests(files)}), self.record(record.unit)
        if old is not None:
            self.remove(f"{UNITS}/{old.unit}", [RECORD])
            gone = [
                name for name, known in old.written.items() if name not in files and self.is_as(old.unit, name, known)
            ]
            self.remove(f"{UNITS}/{old.unit}", gone)
        for name, content in files.items():
            self.write(record.unit, name, content)
        self.write(record.unit, RECORD, content_of(record))
        return record

    def write(self, unit: str, name: str, content: bytes) -> None:
        """Write an object of a unit."""
        self.pipe(f"{UNITS}/{unit}/{name}", content)

    def is_as(self, unit: str, name: str, known: str) -> bool:
        """Return True if an object of a unit has the SHA-256 that is known of it."""
        try:
            return sha256(self.read(unit, name)).hexdigest() == known
        except FileNotFoundError:
            return False

    def clear(self, unit: str, name: str, known: str) -> None:
        """Leave an object there until it is replaced."""

    def put_page(self, unit: str, pages: Mapping[str, bytes]) -> None:
        """Write the pages of a unit."""
        for name in sorted(pages, key=PAGE_FILE.__eq__):  # which says that they are there
            self.write(unit, name, pages[name])

    @contextmanager
    def scratch(self) -> Iterator[StoreScratch]:
        """Give a place for objects that are needed until the end of the command."""
        self.remove(SCRATCH, self.find(SCRATCH))
        try:
            yield StoreScratch(self)
        finally:
            self.remove(SCRATCH, self.find(SCRATCH))


@dataclass(frozen=True)
class StoreScratch:
    """A place for objects of one command; see `driftlab.family.partitions.Scratch`."""

    store: UnitStore

    def read(self, name: str) -> bytes:
        """Return the content of an object."""
        return self.store.get(f"{SCRATCH}/{name}")

    def write(self, name: str, content: bytes) -> None:
        """Write an object."""
        self.store.pipe(f"{SCRATCH}/{name}", content)

    @contextmanager
    def files(self, names: Sequence[str]) -> Iterator[list[Path]]:
        """Copy objects, and give the paths of the copies."""
        with TemporaryDirectory(prefix="driftlab-") as folder:
            paths = [Path(folder, name) for name in names]
            for path in paths:
                path.write_bytes(self.read(path.name))
            yield paths
