"""The pass over the units of a manifest: those that are done already, as they are now, are not done again.

A unit's key is a hash of its recordings' contents, its stamp one of their state on disk: their lengths, and the times
of their last change. Pages are made of the units that are asked for, and of those that stand out.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from fnmatch import filter as matching
from fnmatch import fnmatchcase
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Any, Self

from driftlab import __version__
from driftlab.config import Config, part_of
from driftlab.evaluation.limits import verdict_of_units, worst
from driftlab.family.partitions import Engine
from driftlab.family.record import UnitRecord
from driftlab.family.unit_records import RecordsOfUnits, UnitRecords
from driftlab.production.fleet_folder import FleetFolder
from driftlab.production.manifest import Manifest, ManifestEntry
from driftlab.production.remote import is_url, look
from driftlab.production.summary import MAX_PAGES, FleetProgress, Stage
from driftlab.production.unit import STIMULUS, Task, UnitResult, certificate_of, config_of, key_of, work
from driftlab.production.unit_folders import PAGE_FILE, UnitFolders
from driftlab.production.workers import Pool, WorkerLost, Workers
from driftlab.reports.provenance import sheet_of
from driftlab.spc.stratification import COLUMNS
from fusion_core.errors import ConfigError, FusionError, quote
from fusion_core.host.provenance import participants

MISSING = 10_000  # units without their recordings, over as many as have theirs


@dataclass(frozen=True)
class FleetOptions:
    """Options of `driftlab fleet`, by their names."""

    workers: int | None = None  # processes; None: as many as there are processors
    scheduler: str | None = None  # address of one of Dask, in place of processes
    explain: bool = False
    pages: Collection[str] = ()  # patterns of the units whose pages are wanted; `all`
    certificate: bool = False  # of each unit that is done
    family: Path | None = None  # one that is known already
    rules: str | None = None  # run rules of the charts
    by: tuple[str, ...] = ()  # columns by which the yield is grouped
    appraiser: str = ""  # column of the gauge study
    notes: Mapping[str, str] = field(default_factory=dict)  # on alarms, by unit
    operator: str | None = None  # who wrote them; None: the account
    force: bool = False

    def crew(self) -> Workers:
        """Return the pool of workers; raises WorkersError."""
        if self.scheduler is None:
            return Pool(self.workers)
        from driftlab.production.dask import Scheduler

        return Scheduler(self.scheduler)

    def check_pages(self, manifest: Manifest) -> None:
        """Raise ConfigError where pages are asked for of units that there are not."""
        names = manifest.names
        for pattern in self.pages:
            if pattern != "all" and not matching(names, pattern):
                raise ConfigError(
                    f"--pages {pattern}: no unit is called so; name one of {names[0]} to {names[-1]}, or all"
                )

    def check_columns(self, manifest: Manifest) -> None:
        """Raise ConfigError where yield or gauge study are asked for by a column that there is not."""
        known = dict.fromkeys([*COLUMNS, *(name for entry in manifest.units for name in entry.more)])
        for name in self.by:
            if name not in known:
                raise ConfigError(f"--by {quote(name)}: no such column; choose {', '.join(known)}")
        own = [name for name in known if name not in COLUMNS]
        if self.appraiser and self.appraiser not in own:
            which = f"choose {', '.join(own)}" if own else "the manifest has none of its own"
            raise ConfigError(f"--appraiser {quote(self.appraiser)}: no such column; {which}")


@dataclass
class UnitJobs:
    """The work on the units of a manifest, in a fleet's folder."""

    manifest: Manifest
    folder: FleetFolder
    config: str  # the whole, as YAML
    versions: str  # of driftlab and its plugins
    options: FleetOptions
    progress: FleetProgress
    done: int = 0  # units that were done by this command
    again: list[str] = field(default_factory=list)  # units of these that were replaced
    without_recordings: list[str] = field(default_factory=list)  # units that were left as they are

    def __enter__(self) -> Self:
        self._held = ExitStack()
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()

    @cached_property
    def workers(self) -> Workers:
        """The workers of the whole command, from when they are asked for the first time; raises WorkersError."""
        return self._held.enter_context(self.options.crew())

    def engine(self) -> tuple[Engine, UnitFolders]:
        """Return those who go through the units, and whose scratch they see.

        The workers, if they reach the units; else some processes of our own.
        """
        folder = self.folder
        if self.workers.all_say(folder.units.reached):
            here = folder.units is folder.place or self.workers.all_say(folder.place.reached)
            return self.workers.ordered, folder.place if here else folder.units
        return self._held.enter_context(Pool(self.options.workers)).ordered, folder.place

    def do(self) -> None:
        """Do every unit that is not done, and put it into the folder."""
        stamps = dict(self._to_do())
        stage = Stage("units", total=len(stamps))
        self.progress(stage)
        tasks = self._tasks(stamps, stage)
        first = next(tasks, None)
        if first is None:
            return
        self.folder.begin()
        done = partial(work_in_place, self.folder.units)
        for task, result in self.workers.map(done, chain([first], tasks)):
            if isinstance(result, WorkerLost):
                result = UnitResult(_failed(task, result), {})
            record = result.record if isinstance(result, UnitResult) else result
            stamp = stamps[task.unit] if record.key else ""  # without: to be done again
            if isinstance(result, UnitResult):
                self.folder.put(record, result.files, stamp)
            else:
                self.folder.noted(record, stamp)
            self.done += 1
            stage.done += 1
            stage.failed += record.state == "failed"
            self.progress(stage)

    def _to_do(self) -> Iterator[tuple[str, str]]:
        """Yield the units whose stamp is another than when they were done, with the stamp.

        Raises ConfigError where the recordings of most are not there: each takes its time, and there may be any number.
        """
        folder, units, lost, first = self.folder, self.manifest.units, 0, ""
        for name, entry in zip(self.manifest.names, units, strict=True):
            task = self._task(entry)
            stamp, record = stamp_of(task, self.versions), folder.brief(name)
            if not stamp and record is None and missing(task):
                lost, first = lost + 1, first or entry.unit
            if lost > MISSING + len(units) - lost:
                raise ConfigError(
                    f"--units {self.manifest.name}: the recordings of {lost:,} of {len(units):,} units are not there, "
                    f"the first is {first}; at most {MISSING:,} may be missing beside as many as are there, name those"
                )
            if self.options.force or record is None or not folder.as_it_was(name, stamp):
                yield name, stamp

    def _tasks(self, stamps: Mapping[str, str], stage: Stage) -> Iterator[Task]:
        """Yield the tasks, as they are needed; units of another stamp whose contents are the same are left out."""
        for entry in (entry for entry in self.manifest.units if entry.unit in stamps):
            task = self._task(entry, page=self._wants_page(entry.unit))
            record = None if self.options.force else self.folder.brief(entry.unit)
            if record is not None and self._stays(record, task):
                self.folder.stamp(entry.unit, record.key, stamps[entry.unit])
                stage.total -= 1
                continue
            if self.folder.units.holds(entry.unit):
                self.again.append(entry.unit)
            yield task

    def _task(self, entry: ManifestEntry, *, page: bool = False) -> Task:
        here, explain = os.getcwd(), self.options.explain
        return Task(**vars(entry), config=self.config, folder=here, explain=explain, page=page)

    def _stays(self, record: UnitRecord, task: Task) -> bool:
        """Return True if a unit of another stamp is the same as before, or could not be done again."""
        if record.state == "done" and missing(task):
            self.without_recordings.append(task.unit)
            return True
        with suppress(FusionError, OSError):
            return bool(record.key) and key_of(task) == record.key
        return False

    def status(self) -> FleetStatus:
        """Return the status of all units; lot, date and the rest are noted as the manifest has them now."""
        key = hashlib.sha256()
        for entry in self.manifest.units:
            record = self.folder.brief(entry.unit)
            if record is None:  # it cannot be: it was written by this command, or read by it
                raise RuntimeError(f"unit {entry.unit} has no record")
            given = {"lot": entry.lot, "date": entry.date, "more": dict(entry.more)}
            if given != {name: getattr(record, name) for name in given}:
                whole = self.folder.units.record(entry.unit)
                assert whole is not None
                self.folder.note(whole.model_copy(update=given))
            key.update(repr((entry.unit, record.key, record.state, given, entry.of_soaks)).encode())
        return FleetStatus(self.folder.records.of(self.manifest.names), key.hexdigest())

    def _wants_page(self, unit: str) -> bool:
        return any(pattern == "all" or fnmatchcase(unit, pattern) for pattern in self.options.pages)

    def _has_page(self, unit: str) -> bool:
        return self.folder.units.holds(unit, PAGE_FILE)

    def pages_missing(self, known: Collection[str]) -> bool:
        """Return True if a page is asked for that is not there, or that the report does not know of."""
        wanted = (entry.unit for entry in self.manifest.units if self._wants_page(entry.unit))
        return any(unit not in known or not self._has_page(unit) for unit in wanted)

    def make_pages(self, odd: Mapping[str, Any]) -> list[str]:
        """Make the pages that are asked for, and those of the first MAX_PAGES units that stand out; return their units.

        Of a unit that has one already none is made.
        """
        stand_out = set(list(odd)[:MAX_PAGES])
        wanted = [one for one in self.manifest.units if one.unit in stand_out or self._wants_page(one.unit)]
        missing = [entry for entry in wanted if not self._has_page(entry.unit)]
        stage = Stage("pages", total=len(missing))
        self.progress(stage)
        records = ((entry, self.folder.brief(entry.unit)) for entry in missing)
        todo = [self._task(entry, page=True) for entry, record in records if record and record.state == "done"]
        for task, result in self.workers.map(work, todo) if todo else ():
            if not isinstance(result, WorkerLost):
                self.folder.put_page(task.unit, result.files)
            stage.done += 1
            self.progress(stage)
        return [entry.unit for entry in wanted if self._has_page(entry.unit)]

    def make_certificates(self, config: Config, units: Sequence[str]) -> list[str]:
        """Make the certificates of units that are done, where they are wanted; return why there is none of a unit."""
        if not self.options.certificate:
            return []
        sheet = sheet_of(config.model_copy(update={"source": None, "filter": None}), [])  # units say the rest
        sheet, failed = replace(sheet, config_sha256=hashlib.sha256(self.config.encode()).hexdigest()), []
        stage = Stage("certificates", total=len(units))
        for unit in units:
            self.progress(stage)
            record = self.folder.units.record(unit)
            assert record is not None
            try:
                if record.unit in self.without_recordings:
                    raise ConfigError("its recordings are not there, and it may be of another config")
                with self.folder.units.file(unit, record.map_file) as path:
                    signed = certificate_of(record, path, config, sheet)
            except FusionError as error:
                failed.append(f"unit {record.unit} has no certificate: {error}")
                continue
            files = {"certificate.html": signed.page().encode(), "certificate.json": signed.text().encode()}
            self.folder.put_certificate(record.unit, signed.content, files)
            stage.done += 1
        self.progress(stage)
        return failed


def work_in_place(folders: UnitFolders, task: Task) -> UnitRecord | UnitResult:
    """Do a unit and put it into its folder, where that is reached from here; return its record, else all of it."""
    result = work(task)
    return folders.put(result.record, result.files) if folders.reached() else result


def _failed(task: Task, lost: WorkerLost) -> UnitRecord:
    """Return the record of a unit whose worker was lost: without a key, so the next command does it again."""
    return UnitRecord(
        key="", unit=task.unit, lot=task.lot, date=task.date, more=dict(task.more), state="failed", error=lost.why
    )


def versions_of(config: Config) -> str:
    """Return the versions of driftlab and of the plugins that a config names, as one text."""
    return json.dumps([__version__, participants(config)])


def stamp_of(task: Task, versions: str) -> str:
    """Return the stamp of a unit: a hash of its task and of the state of its recordings.

    Empty where that is not known: a recording is not there, or its server does not say.
    """
    work = [task.config, task.explain, task.folder, {role: list(names) for role, names in task.recordings.items()}]
    try:
        fitted = config_of(task.config, task.folder).files_to_fit() if STIMULUS in task.recordings else []
        names = [*task.names, *(os.path.abspath(path) for path in fitted if path.is_file())]
        looks = [look for name in names for look in _looks(task.folder, name)]
    except OSError:
        return ""
    if None in looks:
        return ""
    return hashlib.sha256(json.dumps([work, versions, looks]).encode()).hexdigest()


def missing(task: Task) -> bool:
    """Return True if a recording on a file system is not there."""
    return any(not is_url(name) and not os.path.exists(_path(task.folder, name)) for name in task.names)


def _path(folder: str, name: str) -> str:
    return os.path.join(folder, part_of(name)[0])


def _looks(folder: str, name: str) -> Iterator[tuple[int | str, ...] | None]:
    """Yield length, times of change and number of a file, or of each in a folder; of a URL, length and tag.

    None where a server does not say. Raises OSError.
    """
    if is_url(name):
        state = None
        with suppress(FusionError):
            state = look(name)
        yield state
        return
    path = _path(folder, name)
    folders = os.path.isdir(path)
    parts = sorted(part for part in Path(path).rglob("*") if part.is_file()) if folders else [path]
    for part in parts:
        file = os.stat(part)
        yield file.st_size, file.st_mtime_ns, file.st_ctime_ns, file.st_ino


@dataclass(frozen=True)
class FleetStatus:
    """The units of a manifest as they are in the folder."""

    records: RecordsOfUnits = field(default_factory=lambda: UnitRecords().of(()))  # in the order of the manifest
    key: str = ""  # hash of all that family and page stand on: the keys of the units, and the manifest's columns

    @cached_property
    def done(self) -> RecordsOfUnits:
        """The records of the units that were done."""
        return self.records.in_state("done")

    @cached_property
    def sound(self) -> RecordsOfUnits:
        """The records of the units that were done and are not in doubt: what is learnt of the line stands on them."""
        return self.records.in_state("done", in_doubt=False)

    @cached_property
    def doubted(self) -> RecordsOfUnits:
        """Those of the units that were done and are in doubt."""
        return self.records.in_state("done", in_doubt=True)

    @cached_property
    def failed(self) -> RecordsOfUnits:
        """Those of the units that failed."""
        return self.records.in_state("failed")

    @property
    def channel(self) -> str:
        """The channel whose bias it is about."""
        return next((record.channel for record in self.done if record.channel), "")

    @property
    def bias_unit(self) -> str:
        """The SI unit of that bias."""
        return next((record.bias_unit for record in self.done if record.bias_unit), "")

    @property
    def limits(self) -> dict[str, int]:
        """Units by the verdict on the limits of the config; empty where it has none."""
        return dict(Counter(verdict for record in self.done if (verdict := worst(record.limits)) is not None))

    @property
    def acceptance(self) -> str:
        """The units by verdict, and the limits that decide; empty where the config has none."""
        return verdict_of_units(record.limits for record in self.done)

    @property
    def beside(self) -> int:
        """Number of units that pass, and show more than limits are set for."""
        passing = (record.limits for record in self.done if worst(record.limits) == "pass")
        return sum(any(row.get("beside") for row in rows) for rows in passing)
