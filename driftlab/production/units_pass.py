"""Every unit of a manifest done once: those that are, as they are now, are not done again.

Pages of units: of those that are asked for, and of those that stand out.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

from driftlab.evaluation.limits import worst
from driftlab.family.record import UnitRecord
from driftlab.production.manifest import Manifest, ManifestEntry
from driftlab.production.stamps import missing, stamp_of
from driftlab.production.store import NEW, FleetFolder, record_of
from driftlab.production.summary import MOST, FleetProgress, Stage
from driftlab.production.unit import Task, key_of, work
from driftlab.production.workers import WorkerLost, Workers
from driftlab.storage.folders import remove
from fusion_core.errors import ConfigError, FusionError

MISSING = 10_000  # units without their recordings, over as many as have theirs


@dataclass(frozen=True)
class UnitJobs:
    """How the units are done.

    Attributes
    ----------
    config, versions : str
        YAML of the whole config; versions of driftlab and its plugins.
    explain : bool
        Whether the loop is closed for each.
    pages : collection of str
        Patterns of the units whose pages are wanted; `all`.
    force : bool
        Whether all are done, also those that are.
    """

    config: str
    versions: str
    explain: bool = False
    pages: Collection[str] = ()
    force: bool = False

    def task(self, entry: ManifestEntry, *, page: bool = False) -> Task:
        """Return what is to be done for a unit."""
        return Task(
            entry.unit, entry.recordings, self.config, lot=entry.lot, date=entry.date, more=entry.more,
            folder=os.getcwd(), explain=self.explain, page=page,
        )  # fmt: skip

    def wants_page(self, unit: str) -> bool:
        """Whether the page of a unit was asked for."""
        return any(pattern == "all" or fnmatchcase(unit, pattern) for pattern in self.pages)


@dataclass
class UnitCounts:
    """How it went: units done now, those of them that were replaced, and those kept without their recordings."""

    done: int = 0
    again: list[str] = field(default_factory=list)
    without_recordings: list[str] = field(default_factory=list)


def do_units(
    manifest: Manifest, folder: FleetFolder, how: UnitJobs, workers: Callable[[], Workers], progress: FleetProgress
) -> UnitCounts:
    """Do every unit of a manifest that is not done, and put it into the folder.

    Parameters
    ----------
    workers : callable
        Who does it, asked for if there is something to do.
    """
    went = UnitCounts()
    stamps = dict(_to_do(manifest, folder, how))
    stage = Stage("units", total=len(stamps))
    progress(stage)
    tasks = _tasks(manifest, folder, how, stamps, went, stage)
    first = next(tasks, None)
    if first is None:
        return went
    with workers() as working:
        for task, done in working.map(work, _with(first, tasks)):
            record, files = (failed(task, done), {}) if isinstance(done, WorkerLost) else (done.record, done.files)
            folder.put(record, files, stamps[task.unit] if record.key else "")  # without a key: to be done again
            went.done += 1
            stage.done += 1
            stage.failed += record.state == "failed"
            progress(stage)
    return went


def _to_do(manifest: Manifest, folder: FleetFolder, how: UnitJobs) -> Iterator[tuple[str, str]]:
    """Yield the units that do not look as they did when they were done, with what they look like.

    Raises ConfigError where the recordings of most are not there: each takes its time, and there may be any number.
    """
    lost, first = 0, ""
    for entry in manifest.units:
        task = how.task(entry)
        stamp = stamp_of(task, how.versions)
        if not stamp and missing(task) and record_of(folder.unit(entry.unit)) is None:
            lost, first = lost + 1, first or entry.unit
        if lost > MISSING + len(manifest.units) - lost:
            raise ConfigError(
                f"--units {manifest.name}: the recordings of {lost:,} of {len(manifest.units):,} units are not there, "
                f"the first is {first}; at most {MISSING:,} may be missing beside as many as are there, name those"
            )
        as_it_was = bool(stamp) and folder.stamps.get(entry.unit, ("", ""))[1] == stamp
        if how.force or not as_it_was or record_of(folder.unit(entry.unit)) is None:
            yield entry.unit, stamp


def _tasks(
    manifest: Manifest, folder: FleetFolder, how: UnitJobs, stamps: dict[str, str], went: UnitCounts, stage: Stage
) -> Iterator[Task]:
    """Yield what is to be done, as it is needed: units that only look otherwise are found out by their contents."""
    for entry in manifest.units:
        if entry.unit not in stamps:
            continue
        task = how.task(entry, page=how.wants_page(entry.unit))
        record = None if how.force else record_of(folder.unit(entry.unit))
        if record is not None and _stays(record, task, went):
            folder.stamp(entry.unit, record.key, stamps[entry.unit])
            stage.total -= 1
            continue
        if folder.unit(entry.unit).exists():
            went.again.append(entry.unit)
        yield task


def _stays(record: UnitRecord, task: Task, went: UnitCounts) -> bool:
    """Whether a unit that looks otherwise is what it was, or could not be done again."""
    if record.state == "done" and missing(task):
        went.without_recordings.append(task.unit)
        return True
    with suppress(FusionError, OSError):
        return bool(record.key) and key_of(task) == record.key
    return False


def failed(task: Task, lost: WorkerLost) -> UnitRecord:
    """Return the record of a unit whose worker was lost: without a key, so the next command does it again."""
    return UnitRecord(
        key="", unit=task.unit, lot=task.lot, date=task.date, more=dict(task.more), state="failed", error=lost.why
    )


def _with(first: Task, others: Iterator[Task]) -> Iterator[Task]:
    yield first
    yield from others


@dataclass
class FleetStatus:
    """The units of a manifest as they are in the folder.

    Attributes
    ----------
    done : list of (str, str)
        Names and lots of those that were done.
    failed : list of (str, str)
        Names of those that failed, and why.
    axes, channel, bias_unit : of the first that was done
    limits : dict of str to int
        Units by the verdict on the limits of the config; empty where it has none.
    beside : int
        Units that pass, of which more is seen than limits are set for.
    key : str
        Hash of what the family stands on: the keys of the units, their lots and dates.
    """

    done: list[tuple[str, str]] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)
    channel: str = ""
    bias_unit: str = ""
    limits: dict[str, int] = field(default_factory=dict)
    beside: int = 0
    key: str = ""


def count(manifest: Manifest, folder: FleetFolder) -> FleetStatus:
    """Go through the units once; lot, date and the rest are noted as the manifest has them now."""
    found, said = FleetStatus(), hashlib.sha256()
    for entry in manifest.units:
        record = record_of(folder.unit(entry.unit))
        if record is None:  # it cannot be: it was written by this command, or read by it
            raise RuntimeError(f"unit {entry.unit} has no record")
        told = {"lot": entry.lot, "date": entry.date, "more": dict(entry.more)}
        if told != {name: getattr(record, name) for name in told}:
            record = record.model_copy(update=told)
            content = record.model_dump_json(by_alias=True, indent=1) + "\n"
            folder.write(f"units/{entry.unit}/unit.json", content.encode())
        said.update(repr((entry.unit, record.key, record.state, told)).encode())
        if record.state == "failed":
            found.failed.append((entry.unit, record.error))
            continue
        found.done.append((entry.unit, entry.lot))
        if (verdict := worst(record.limits)) is not None:
            found.limits[verdict] = found.limits.get(verdict, 0) + 1
            found.beside += verdict == "pass" and any(row.get("beside") for row in record.limits)
        found.channel, found.bias_unit = found.channel or record.channel, found.bias_unit or record.bias_unit
    found.key = said.hexdigest()
    return found


PAGE = "page"


def check_pages(manifest: Manifest, how: UnitJobs) -> None:
    """Raise ConfigError where pages are asked for of units that there are not."""
    names = [entry.unit for entry in manifest.units]
    for pattern in how.pages:
        alone = UnitJobs(how.config, how.versions, pages=[pattern])
        if not any(map(alone.wants_page, names)):
            raise ConfigError(f"--pages {pattern}: no unit is called so; name one of {names[0]} to {names[-1]}, or all")


def pages_missing(manifest: Manifest, folder: FleetFolder, how: UnitJobs, known: Collection[str]) -> bool:
    """Whether a page is asked for that is not there, or that the report does not know of."""
    wanted = [entry.unit for entry in manifest.units if how.wants_page(entry.unit)]
    return any(unit not in known or not (folder.unit(unit) / PAGE).is_dir() for unit in wanted)


def make_pages(
    manifest: Manifest,
    folder: FleetFolder,
    how: UnitJobs,
    odd: Mapping[str, Any],
    workers: Callable[[], Workers],
    progress: FleetProgress,
) -> list[str]:
    """Make the pages that are asked for, and those of the first MOST units that stand out; return whose there are.

    Of a unit that has one already none is made.
    """
    stand_out = set(list(odd)[:MOST])
    wanted = [entry for entry in manifest.units if entry.unit in stand_out or how.wants_page(entry.unit)]
    missing = [entry for entry in wanted if not (folder.unit(entry.unit) / PAGE).is_dir()]
    stage = Stage("pages", total=len(missing))
    progress(stage)

    def tasks() -> Iterator[Task]:
        for entry in missing:
            record = record_of(folder.unit(entry.unit))
            if record is not None and record.state == "done":
                yield how.task(entry, page=True)

    todo = list(tasks())
    if todo:
        with workers() as working:
            for task, done in working.map(work, todo):
                if not isinstance(done, WorkerLost):
                    _put_page(folder, task.unit, done.files)
                stage.done += 1
                progress(stage)
    return [entry.unit for entry in wanted if (folder.unit(entry.unit) / PAGE).is_dir()]


def _put_page(folder: FleetFolder, unit: str, files: Mapping[str, bytes]) -> None:
    """Put the page of a unit into its folder, whole or not at all."""
    pages = {name: content for name, content in files.items() if name.startswith(f"{PAGE}/")}
    place = folder.unit(unit)
    new = place.with_name(f".{unit}.{PAGE}{NEW}")
    remove(new)
    for name, content in pages.items():
        path = new / name.removeprefix(f"{PAGE}/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    if pages:
        os.rename(new, place / PAGE)
