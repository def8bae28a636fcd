"""A fleet: every unit of a manifest done, their family, and tables and report of all: `driftlab fleet`."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from driftlab.commands.console import say, terminal
from driftlab.commands.inputs import ConfigLike, Place, config_of
from driftlab.config import Config, with_recording
from driftlab.family.partitions import serial
from driftlab.family.unit_records import RecordsOfUnits
from driftlab.production.database import Database, tables_of
from driftlab.production.family import FamilyAnalysis, analyse
from driftlab.production.fleet_folder import FAMILY, REPORT, TABLE, fleet_folder, stored_units
from driftlab.production.manifest import Manifest, read_manifest
from driftlab.production.result import FleetResult
from driftlab.production.summary import FamilySummary, FleetProgress, FleetSummary, Stage, fleet_progress, some
from driftlab.production.tables import write_fleet
from driftlab.production.unit import STIMULUS
from driftlab.production.unit_terms import terms_of_units
from driftlab.production.units_pass import FleetOptions, FleetStatus, UnitJobs, versions_of
from driftlab.recordings.identity import sha256
from driftlab.spc.acknowledgements import (
    Acknowledgement,
    Alarm,
    basis_of,
    checked,
    in_force,
    known_notes,
    new_notes,
    of_outlier,
)
from driftlab.spc.gauge_study import GaugeStudy, gauge_study
from driftlab.spc.run_rules import RULES
from driftlab.spc.sentences import alarms
from driftlab.spc.yields import Yield, yields_of
from fusion_core.errors import ConfigError, DataError, quote
from fusion_core.host.provenance import participants
from fusion_core.threads import one_thread

__all__ = ["FleetOptions", "fleet"]

T = TypeVar("T")
SHOWN = 10  # failures that are named outside of the tables
ALONE = 20  # units for whose family no further process is asked


def fleet(
    config: ConfigLike,
    units: Place,
    out: Place,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    explain: bool = False,
    pages: Sequence[str] = (),
    certificate: bool = False,
    family: Place | None = None,
    rules: str | None = None,
    by: Sequence[str] = (),
    appraiser: str | None = None,
    acknowledge: Mapping[str, str] | None = None,
    operator: str | None = None,
    to: str | None = None,
    store: str | None = None,
    force: bool = False,
    channel: str | None = None,
    progress: FleetProgress | None = None,
) -> FleetResult:
    """Calibrate the units of a line, and learn their family.

    Finds the odd ones. The same command again goes on where it ended.

    Parameters
    ----------
    config : as that of `run`
        Of every unit; its source says how recordings are read.
    units : str or path
        Recordings, a unit each; or a table of unit, role and path.
        A pattern of file names, or a manifest (`driftlab.production.manifest`).
    out : path
        Folder; what is done there is not done again.
    workers : int, optional
        Processes; default: one a processor.
    scheduler : str, optional
        Of Dask, e.g. tcp://host:8786: its workers do it.
    explain : bool
        Close the loop for each unit with recordings to train and to judge by.
    pages : sequence of str
        Units whose pages to write; may be repeated.
        Names, patterns, or `all`.
    certificate : bool
        Write a certificate of each unit too: one sheet with results, uncertainty and limits.
        As certificate.html and certificate.json in its folder; one of the same results stays as it is.
    family : path, optional
        A family that is known: none is fitted, and units are charted against its limits.
        Its `family.json`.
    rules : str, optional
        Run rules of the control charts, beside three sigma.
        `western-electric` or `nelson`; they alarm more often, also of a line in control.
    by : sequence of str
        Column by which yield and reasons are reported, e.g. lot; may be repeated.
        `lot`, `date`, `channel`, `driftlab`, `T_low`, `T_high`, `hours` or one of the manifest's own; numbers of which
        there are many are grouped in quarters. Without it by lot, where the units have lots.
    appraiser : str, optional
        Column of the appraisers of the gauge R&R, e.g. chamber.
        Of units that were soaked twice or more (`driftlab.spc.gauge_study`).
    acknowledge : mapping of str to str, optional
        Acknowledge the alarms of a unit with a note, e.g. '0021=cable replaced'; may be repeated.
        It stays in the folder as long as the alarms are the same.
    operator : str, optional
        Name of who acknowledges; default: that of the account.
    to : str, optional
        SQL database that takes the results as tables, e.g. sqlite:///line.db.
        A URL as SQLAlchemy has it (`driftlab.production.database`); needs driftlab[sql].
    store : str, optional
        URL for the folders of the units, e.g. s3://bucket/line; default: in `out`.
        Workers put them there themselves (`driftlab.production.unit_store`); needs fsspec and what it needs for it.
    force : bool
        Do every unit again.
    channel : as that of `run`
    progress : callable, optional
        Called with the `Stage` that goes on: `name`, `total`, `done`, `failed`, `text()`.

    Returns
    -------
    FleetResult
        Of the units that are done `unit`, `odd` (U,), `noise`, `walk`, `coast` (U, d), ...; `to_polars()` is the table.

    Raises
    ------
    ConfigError, UnitError
        If the config or the manifest is wrong, or `out` must not be written to.
    DataError
        If not one unit could be done.
    Unwritable
        If folder or database cannot be written.
    """
    understood, report = config_of(config).tracking(channel), progress or (lambda stage: None)
    options = FleetOptions(
        workers, scheduler, explain, tuple(pages), certificate, None if family is None else Path(family), rules,
        tuple(by), appraiser or "", dict(acknowledge or {}), operator, force,
    )  # fmt: skip
    manifest, options = _checked(understood, str(units), options)
    read = [] if options.family is None else [options.family]
    held = nullcontext() if to is None else closing(Database(to))  # reached before anything is computed
    with held as database, fleet_folder(Path(out), read, store) as folder:
        plain = understood.model_copy(update={"certificate": None})  # its texts change no result
        jobs = UnitJobs(manifest, folder, plain.as_yaml(), versions_of(understood), options, report)
        command = _Command(understood, jobs, folder.mark.get("id") or (uuid4().hex if database else None))
        summary = command.all()
        if database is not None:
            command.to_database(database, summary)
        command.check(str(units), summary["family"] or {})
        return FleetResult(Path(out), summary)


def _none_done(failed: RecordsOfUnits, units: str) -> DataError:
    if Path(units).is_dir():
        return DataError(
            f"--units {units}: is a folder, of which no source reads a recording ({failed[0].error}); write a pattern "
            f"of its files in quotes, as '{units.rstrip('/')}/*.csv', or name a manifest"
        )
    if len(failed) == 1:
        return DataError(f"the only unit, {failed[0].unit}, failed: {failed[0].error}")
    return DataError(
        f"all {len(failed)} units failed; the first is {failed[0].unit}: {failed[0].error}; the others' errors are in "
        "the column `error` of units.parquet"
    )


def _checked(config: Config, units: str, options: FleetOptions) -> tuple[Manifest, FleetOptions]:
    """Return the manifest, and the options with the name of who acknowledges; raises ConfigError."""
    if options.rules not in (None, *RULES):
        raise ConfigError(
            f"--rules {quote(options.rules)}: no such rules; choose {' or '.join(RULES)}, or leave it out"
        )
    if options.scheduler is not None and options.workers is not None:
        raise ConfigError("--workers and --scheduler: both are given; a scheduler has its own workers, leave one out")
    manifest = read_manifest(units)
    # which refuses a source of no files
    with_recording(config, next(iter(manifest.units[0].recordings.values()))[0])
    _check_stimulus(config, manifest)
    options.check_pages(manifest)
    options.check_columns(manifest)
    author = checked(options.notes, options.operator, manifest.names)
    return manifest, replace(options, operator=author)


def _check_stimulus(config: Config, manifest: Manifest) -> None:
    """Raise ConfigError where units have a stimulus, and the config describes none or is not that of gyros.

    An accelerometer's bias in a soak holds the terms of gravity, so that it must be fitted together with them.
    """
    unit = next((entry.unit for entry in manifest.units if STIMULUS in entry.recordings), None)
    if unit is None:
        return
    has = f"--units {manifest.name}: unit {quote(unit)} has a recording of the role stimulus"
    if config.filter is None or config.filter.tracked.channel != "gyro":
        raise ConfigError(
            f"{has}, which is for gyros; fit other sensors with `driftlab fit-map --terms bias,scale,misalignment`"
        )
    if config.stimulus is None:
        raise ConfigError(f"{has}, and the config no stimulus; add `stimulus: {{kind: rate_table}}` with its segments")


@contextmanager
def progress_of(arguments: Mapping[str, Any]) -> Iterator[FleetProgress]:
    """Show the progress of the command; an interruption says how it goes on."""
    try:
        with fleet_progress() as report:
            yield report
    except KeyboardInterrupt:
        out = arguments["out"]
        raise KeyboardInterrupt(f"what is done is in {out}, and the same command goes on from there") from None


def show(result: FleetResult, given: Mapping[str, Any]) -> None:
    """Print the notes on the fleet."""
    for line in result.lines():
        terminal().print(line, soft_wrap=True)
    say(f"written to {given['out']}/: {', '.join(result.written)}\n")


@dataclass
class _Command:
    """One command on a fleet's folder, stage by stage."""

    config: Config
    jobs: UnitJobs
    id: str | None  # of the fleet in databases
    seconds: dict[str, float] = field(default_factory=dict)  # of each stage
    status: FleetStatus = field(default_factory=FleetStatus)
    failed: list[str] = field(default_factory=list)  # of the certificates
    yields: Yield | None = None  # once the odd units are known
    gauge: GaugeStudy | None = None
    notes: list[Acknowledgement] = field(default_factory=list)  # all that were ever written here

    def all(self) -> dict[str, Any]:
        """Go through the stages; return the content of `fleet.json`."""
        with self.jobs:
            content = self._stages()
            folder = self.jobs.folder
            if folder.units is folder.place:
                folder.place.finish()  # what a worker that was killed had begun to write
            return content

    def _stages(self) -> dict[str, Any]:
        jobs, folder, options, progress = self.jobs, self.jobs.folder, self.jobs.options, self.jobs.progress
        self.notes = known_notes(folder.mark, f"--out {folder.out}")
        self._timed("units", jobs.do)
        status = self.status = self._timed("reading", jobs.status)
        self.failed = self._timed("certificates", partial(jobs.make_certificates, self.config, status.done.units))
        key, before = self._key(), folder.mark
        files = (TABLE, REPORT, *([FAMILY] if before.get("family", {}).get("fitted", True) else ()))
        as_it_was = before.get("key") == key and before.get("complete") and not options.notes
        as_it_was = as_it_was and all((folder.path / name).is_file() for name in files)
        if as_it_was and not jobs.pages_missing(before["pages"]):
            self._tell(before["family"].get("odd", {}))
            return self._mark(**{name: before[name] for name in ("complete", "key", "family", "pages")})
        self._mark()
        # of matrices of forty rows more threads make less
        engine, seen = jobs.engine() if len(status.done) > ALONE else (serial, folder.place)
        with one_thread(), seen.scratch() as scratch:
            stored = partial(stored_units, folder.units, engine=engine, scratch=scratch)
            whole = stored(status.records.units, [record.lot for record in status.records])
            doubted, units = (
                stored(some.units, [record.lot for record in some]) if len(some) < len(status.records) else whole
                for some in (status.doubted, status.sound)
            )
            learned = partial(
                analyse, units, doubted, status, self.config, options.family, progress, options.rules, options.by
            )
            analysis = self._timed("family", learned)
            odd = analysis.reasons
            self._tell(odd)
            acknowledged, about = self._acknowledged(analysis)
            pages = self._timed("pages", partial(jobs.make_pages, odd))
            beside = {"yields": self.yields, "gauge": self.gauge, "acknowledged": acknowledged, "notes": self.notes}
            written = partial(
                write_fleet, folder, status, self.config, analysis, beside, pages, progress, whole, scratch
            )
            self._timed("tables", written)
        family = self._family(analysis, acknowledged, about)
        return self._mark(complete=True, key=key, family=family, pages=pages)

    def check(self, units: str, family: Mapping[str, Any]) -> None:
        """Raise DataError where no unit is done, ConfigError where there is a note on a unit without an alarm."""
        if not self.status.done:
            raise _none_done(self.status.failed, units)
        known = family.get("acknowledged", {})
        if none := sorted(self.jobs.options.notes.keys() - known.keys()):
            alarmed = sorted({*family.get("open", ()), *known})
            verb, notes = ("has", "its note is") if len(none) == 1 else ("have", "their notes are")
            raise ConfigError(
                f"--acknowledge: {some([quote(one) for one in none])} {verb} no alarm, so {notes} not kept (all else "
                f"is done and written); {f'units with an alarm: {some(alarmed)}' if alarmed else 'no unit has one'}"
            )

    def to_database(self, database: Database, summary: Mapping[str, Any]) -> None:
        """Replace the rows of the fleet in a database by those of `fleet.json`, table and records."""
        self.jobs.progress(Stage("database"))
        folder, records = self.jobs.folder, self.status.records
        own = dict.fromkeys(column for record in records for column in record.more)
        whole = filter(None, map(folder.units.record, records.units))
        name = folder.out.name or folder.path.name
        database.replace(summary["id"], tables_of(name, summary, own, whole, folder.path / TABLE))

    def _family(
        self, analysis: FamilyAnalysis, acknowledged: Mapping[str, Acknowledgement], about: Collection[str]
    ) -> FamilySummary:
        """Return the family's part of the summary; `about` are the units with an alarm."""
        line = analysis.line
        return FamilySummary(
            units=len(self.status.done), fitted=analysis.family is not None, odd=analysis.reasons, lines=analysis.lines,
            line=line.sentences, judged=analysis.judged,
            alarms={line.units[k]: [one.text for one in why] for k, why in alarms(line).items()},
            acknowledged={unit: note.brief() for unit, note in acknowledged.items()},
            open=[unit for unit in about if unit not in acknowledged],
            capability=[
                row.as_json(line.shown(row.quantity).si, line.units[row.since]) for row in line.capability
            ],
            charts=[chart.as_json(line) for chart in line.controls],
            differences=[one.as_json(line.shown(one.quantity).si) for one in line.differences],
        )  # fmt: skip

    def _acknowledged(self, analysis: FamilyAnalysis) -> tuple[dict[str, Acknowledgement], dict[str, list[Alarm]]]:
        """Add the new notes to those that are known; return those in force, and the alarms, by unit."""
        options, about = self.jobs.options, dict[str, list[Alarm]]()
        for unit, outliers in analysis.odd.items():
            about.setdefault(unit, []).extend(map(of_outlier, outliers))
        for k, why in alarms(analysis.line).items():
            about.setdefault(analysis.line.units[k], []).extend(why)
        about = {unit: why for unit, why in about.items() if why}
        frozen = "" if options.family is None else sha256(options.family)
        records = {unit: self.jobs.folder.units.record(unit) for unit in about}
        basis = {unit: "" if record is None else basis_of(record, frozen) for unit, record in records.items()}
        said = {unit: (note.note, note.by) for unit, note in in_force(self.notes, about, basis).items()}
        new = new_notes(options.notes, options.operator or "", about, basis)
        self.notes += [note for note in new if said.get(note.unit) != (note.note, note.by)]
        return in_force(self.notes, about, basis), about

    def _tell(self, odd: Collection[str]) -> None:
        """Count the yield by the columns that were asked for, or by lot; study the gauge."""
        records = self.status.records
        usual = ("lot",) if any(record.lot for record in records) else ()
        self.yields = yields_of(records, odd, self.jobs.options.by or usual)
        columns = {entry.unit: entry.of_soaks for entry in self.jobs.manifest.units if entry.of_soaks}
        self.gauge = gauge_study(self.status.sound, self.config.limits, self.jobs.options.appraiser, columns)

    def _timed(self, name: str, stage: Callable[[], T]) -> T:
        begun = time.monotonic()
        result = stage()
        self.seconds[name] = round(time.monotonic() - begun, 3)
        return result

    def _key(self) -> str:
        """Return the key of family, tables and report: a hash of all that they are made of."""
        jobs, options = self.jobs, self.jobs.options
        family = "" if options.family is None else sha256(options.family)
        parts = (self.status.key, jobs.config, jobs.versions, family, options.rules, options.by, options.appraiser)
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def _mark(self, **more: Any) -> dict[str, Any]:
        """Write `fleet.json`, and return its content."""
        jobs, folder, status = self.jobs, self.jobs.folder, self.status
        left = [unit for unit in folder.units.names() if unit not in folder.records]
        counts = {"units": len(status.records), "done": len(status.done), "failed": len(status.failed)}
        counts["in_doubt"] = len(status.doubted)
        summary = FleetSummary(
            plugins=participants(self.config),
            units_from=jobs.manifest.name,
            counts={**counts, "done_now": jobs.done, "left": len(left)},
            limits=status.limits,
            acceptance=status.acceptance,
            pass_with_hysteresis=status.beside,
            terms=terms_of_units(status.sound),
            yields=self.yields,
            gauge=self.gauge,
            acknowledgements=self.notes,
            id=self.id,
            store=folder.mark.get("store"),
            replaced=jobs.again,
            kept_without_recordings=jobs.without_recordings,
            same_recordings=status.done.same_recordings(),
            left=left,
            failed={record.unit: record.error for record in status.failed[:SHOWN]},
            certificates_failed=self.failed,
            seconds=self.seconds,
            config=jobs.config,
            **more,
        )
        return folder.write_mark(summary.content())
