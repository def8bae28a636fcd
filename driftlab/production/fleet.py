"""A fleet: every unit of a manifest done, what they have in common, and tables: `driftlab fleet`."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from driftlab import __version__
from driftlab.config import Config, with_recording
from driftlab.production.family import analyse
from driftlab.production.manifest import Manifest, read_manifest
from driftlab.production.ordered_map import OrderedPool
from driftlab.production.report import FAMILY, REPORT, TABLE, FleetReport, written
from driftlab.production.result import FleetResult
from driftlab.production.stamps import versions_of
from driftlab.production.store import MARK, UNITS, FleetFolder, UnitStore, as_json, fleet_folder
from driftlab.production.summary import FleetProgress, lines_of
from driftlab.production.units_pass import (
    FleetStatus,
    UnitCounts,
    UnitJobs,
    check_pages,
    count,
    do_units,
    make_pages,
    pages_missing,
)
from driftlab.production.workers import Pool, Workers
from driftlab.recordings.identity import sha256
from driftlab.storage.folders import digest
from fusion_core.errors import ConfigError, DataError
from fusion_core.host.provenance import participants

T = TypeVar("T")
SHOWN = 10  # failures that are named outside of the tables


@dataclass(frozen=True)
class FleetOptions:
    """What of a fleet is wanted, as the command's options of these names say.

    Attributes
    ----------
    workers : int or None
        Processes; as many as there are processors.
    scheduler : str or None
        Address of a Dask scheduler, in place of processes.
    explain, force : bool
    pages : collection of str
    family : Path or None
        A family that is known already.
    """

    workers: int | None = None
    scheduler: str | None = None
    explain: bool = False
    pages: Collection[str] = ()
    family: Path | None = None
    force: bool = False

    def crew(self) -> Workers:
        """Return who does the work; raises WorkersError."""
        if self.scheduler is None:
            return Pool(self.workers)
        from driftlab.production.dask import Scheduler

        return Scheduler(self.scheduler)


def fleet(
    config: Config, units: str, out: Path, wanted: FleetOptions | None = None, progress: FleetProgress | None = None
) -> FleetResult:
    """Do the units of a manifest that are not done, fit their family, and write tables and report into `out`.

    Parameters
    ----------
    config : Config
        Of every unit; its source says how recordings are read.
    units : str
        A manifest, or a pattern of file names (`driftlab.production.manifest`).
    out : Path
        The fleet's folder. What was done there before is not done again as long as it is the same.
    wanted : Wanted, optional
    progress : callable, optional
        Called with the stage that goes on.

    Raises
    ------
    ConfigError
        If the config or the manifest is wrong, or `out` must not be written to.
    DataError
        If not one unit could be done.
    """
    wanted, report = wanted or FleetOptions(), progress or (lambda stage: None)
    if wanted.scheduler is not None and wanted.workers is not None:
        raise ConfigError("--workers and --scheduler: both are given; a scheduler has its own workers, leave one out")
    manifest = read_manifest(units)
    with_recording(config, next(iter(manifest.units[0].recordings.values()))[0])  # which refuses a source of no files
    how = UnitJobs(config.as_yaml(), versions_of(config), wanted.explain, wanted.pages, wanted.force)
    check_pages(manifest, how)
    with fleet_folder(out, [] if wanted.family is None else [wanted.family]) as folder:
        made = _Making(config, manifest, folder, how, wanted, report)
        summary = made.all()
        if not made.found.done:
            unit, why = made.found.failed[0]
            raise DataError(f"all {len(made.found.failed)} units failed; the first is {unit}: {why}")
        return FleetResult(out, summary)


class _Making:
    """One command on a fleet's folder, stage by stage."""

    def __init__(
        self,
        config: Config,
        manifest: Manifest,
        folder: FleetFolder,
        how: UnitJobs,
        wanted: FleetOptions,
        progress: FleetProgress,
    ) -> None:
        self.config, self.manifest, self.folder, self.how = config, manifest, folder, how
        self.wanted, self.progress = wanted, progress
        self.seconds: dict[str, float] = {}
        self.found, self.went = FleetStatus(), UnitCounts()

    def all(self) -> dict[str, Any]:
        """Go through the stages; return the content of `fleet.json`."""
        manifest, folder, crew = self.manifest, self.folder, self.wanted.crew
        from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

        self.went = self._timed("units", lambda: do_units(manifest, folder, self.how, crew, self.progress))
        self.found = self._timed("reading", lambda: count(manifest, folder))
        key, before = self._key(), folder.mark
        fitted = before.get("family", {}).get("fitted", True)
        as_it_was = before.get("key") == key and before.get("complete") and written(folder.path, family=fitted)
        if as_it_was and not pages_missing(manifest, folder, self.how, before["pages"]):
            return self._mark({name: before[name] for name in ("complete", "key", "family", "pages")})
        self._mark({"complete": False})
        kept = UnitStore(folder.path, self.found.done)
        known, telling = self.wanted.family, FleetReport(manifest, folder, self.found, self.config)
        # of matrices of forty rows more threads make less
        with threadpool_limits(1), OrderedPool(len(kept), self.wanted.workers) as each:
            learned = self._timed("family", lambda: analyse(kept, self.found, self.config, known, self.progress, each))
            odd = learned.reasons
            pages = self._timed("pages", lambda: make_pages(manifest, folder, self.how, odd, crew, self.progress))
            self._timed("tables", lambda: telling.write(learned, pages, self.progress, each))
        told = {
            "units": len(self.found.done), "fitted": learned.family is not None, "odd": odd, "lines": learned.lines,
            "line": learned.line.sentences, "judged": learned.judged,
        }  # fmt: skip
        return self._mark({"complete": True, "key": key, "family": told, "pages": pages})

    def _timed(self, name: str, stage: Callable[[], T]) -> T:
        begun = time.monotonic()
        found = stage()
        self.seconds[name] = round(time.monotonic() - begun, 3)
        return found

    def _key(self) -> str:
        """Return what tells whether family, tables and report are of what there is now."""
        family = "" if self.wanted.family is None else sha256(self.wanted.family)
        return hashlib.sha256(repr((self.found.key, self.how.config, self.how.versions, family)).encode()).hexdigest()

    def _mark(self, more: Mapping[str, Any]) -> dict[str, Any]:
        """Write `fleet.json`."""
        names = {entry.unit for entry in self.manifest.units}
        here = (path for path in (self.folder.path / UNITS).iterdir() if (path / "unit.json").is_file())
        left = sorted(path.name for path in here if path.name not in names)
        content: dict[str, Any] = {
            "schema": 1,
            "program": "driftlab fleet",
            "complete": False,
            "driftlab": __version__,
            "plugins": participants(self.config),
            "units_from": self.manifest.name,
            "counts": {
                "units": len(names),
                "done": len(self.found.done),
                "failed": len(self.found.failed),
                "done_now": self.went.done,
                "left": len(left),
            },
            "limits": self.found.limits,
            "pass_with_hysteresis": self.found.beside,
            "replaced": self.went.again,
            "kept_without_recordings": self.went.without_recordings,
            "left": left,
            "failed": dict(self.found.failed[:SHOWN]),
            "seconds": self.seconds,
            **more,
        }
        content["lines"] = lines_of(content)
        content["config"] = self.how.config
        if content["complete"]:
            paths = (self.folder.path / name for name in (TABLE, FAMILY, REPORT))
            content["written"] = {path.name: digest(path) for path in paths if path.is_file()}
        self.folder.write(MARK, as_json(content))
        return content
