"""The filter of a config on a recording: `driftlab run`, and the files at the end of `driftlab live`."""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab import __version__
from driftlab.commands.console import print_verdict, say, say_lines, terminal
from driftlab.commands.estimates import (
    CHECKPOINT,
    EstimatesWriter,
    Stored,
    at_file_precision,
    note_first_row,
    units_of,
    write_smoothed,
)
from driftlab.commands.inputs import ConfigLike, DataLike, Place, Progress, Units, config_with
from driftlab.commands.result import Result
from driftlab.evaluation.limits import Measured, verdict
from driftlab.evaluation.measurements import normal
from driftlab.evaluation.overview import ScoredRun, accumulator_of, map_of, scored
from driftlab.evaluation.summary import in_sample, is_trusted, remarks, summarise
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, RunSegment, joined
from driftlab.recordings.identity import beforehand
from driftlab.recordings.prefetch import aside
from driftlab.reports.certificate import FILES as CERTIFICATE
from driftlab.reports.certificate import Certificate
from driftlab.reports.charts import Chart
from driftlab.reports.provenance import Sheet, sheet_of
from driftlab.reports.run import bias_chart, page_of, result_sentences
from driftlab.reports.tables import yardstick_table
from driftlab.storage.folders import output_folder
from driftlab.storage.hdf5 import Columns, reading
from driftlab.storage.json import write_json
from driftlab.storage.ownership import document
from fusion_core.contracts import FittedMap
from fusion_core.errors import ConfigError
from fusion_core.host.provenance import participants


class RunResult(Result):
    """A run: the columns of `estimates.h5` by name, and what the summary and the report say of it.

    `t` (N,), `bias` and `bias_sigma` (N, d), `coast` and `coast_sigma` (N, d), `x` and `sigma` (N, n), and the rest of
    `estimates.h5`. Of a run that was written to a folder, an array is read when it is asked for.
    """

    def __init__(self, run: ScoredRun, columns: Columns, recorded: Path | None = None) -> None:
        config, model = run.config, run.model
        self.run, self.config, self.model, self.journal, self.overview = run, config, model, run.journal, run.overview
        self.recorded = recorded  # the file in which a live run has kept what came
        self.judged = run.judged
        self.limits_verdict = self.verdict = verdict(self.judged)
        self.name = f"{config.file.stem}: {config.recording}" if config.file else config.recording
        self.units, self._columns = units_of(model), columns
        states, axes = tuple(model.labels), tuple(model.tracked.axes)
        self.labels = {"x": states, "sigma": states, "innovations": states[: model.m], "white": states[: model.m]}
        self.labels |= dict.fromkeys(("rate", "bias", "bias_sigma", "coast", "coast_sigma", "calibration"), axes)
        self.summary = {
            "schema": 1,
            "driftlab": __version__,
            "recording": config.recording,
            "plugins": participants(config),
            "serial": config.serial,
            "limits": [row.as_json(run.unit) for row in self.judged],
            **summarise(run),
        }

    def lines(self) -> list[str]:
        """Return the notes on the run, a sentence each."""
        return [*remarks(self.run), *self._unused_map]

    @cached_property
    def _unused_map(self) -> list[str]:
        """A remark on a map beside the config that was not used."""
        file, sensor = self.config.file, self.run.sensor
        if map_of(self.config) is not None:
            return []
        beside = Path() if file is None else file.with_name(f"{file.stem}.map.json")
        record = document(beside).get("record") if file is not None and not self.config.tracked_maps() else None
        if not isinstance(record, dict) or record.get("channel") != sensor.channel:
            return []
        line = f"{sensor.section}.calibration: {{kind: {record.get('kind')}, path: {beside.name}}}"
        return [f"{beside.name} is beside the config, which names no map, so none was used; write {line}"]

    @property
    def smoothed(self) -> Mapping[str, NDArray[Any]]:
        """States `x`, `sigma` (N, n) and `bias` (N, d) given all of the recording; empty where none was asked for."""
        return Stored(self._columns.path, "smoothed") if isinstance(self._columns, Stored) else {}

    def _chart(self) -> Chart:
        """Return the bias, its prediction and the temperature over time, and the errors below."""
        return bias_chart(self.run, errors=True)

    def save(self, out: str | os.PathLike[str], *, force: bool = False, certificate: bool = False) -> None:
        """Write `estimates.h5`, `summary.json` and `report.html` into the folder `out`, as `driftlab run` does.

        A `certificate` too, where it is asked for.
        """
        with output_folder(Path(out), read=self.config.files(), force=force) as folder:
            with closing(EstimatesWriter(folder, self.config, self.journal)) as estimates:
                estimates.open(self.model)
                estimates.add(dict(self))
            note_first_row(folder / "estimates.h5", self.journal.faults.first_row)
            self._write(folder, certificate=certificate)

    def _write(self, folder: Path, *, certificate: bool = False) -> None:
        write_json(folder / "summary.json", self.summary)
        recording = None if self.recorded is None else [str(self.recorded)]
        sheet = sheet_of(self.config, recording, judged=self.judged, plugins=self.summary["plugins"])
        fitted, notes = map_of(self.config), self._unused_map
        page = page_of(self.run, self.summary, title=self.name, sheet=sheet, fitted=fitted, notes=notes)
        (folder / "report.html").write_text(page, encoding="utf-8")
        if certificate:
            signed = self._certificate(sheet)
            for name, text in zip(CERTIFICATE, (signed.page(), signed.text()), strict=True):
                (folder / name).write_text(text, encoding="utf-8")

    def _certificate(self, sheet: Sheet) -> Certificate:
        overview, T, fitted = self.overview, self.overview.curves.get("temperature_raw"), map_of(self.config)
        bias = Measured(overview.bias, self.model.tracked.axes, otherwise="the filter's deviations are not confirmed")
        if is_trusted(self.run):
            bias = normal(bias, overview.sigma, np.nan)
        measured = None if T is None else (float(np.min(T)), float(np.max(T)))
        return Certificate(
            "run", self.config, sheet, self.judged, {"bias": bias, **self.run.measured}, fitted,
            seconds=overview.count * self.run.alignment.dt * (1 - overview.yardsticks.moved),
            domain=measured, remarks=self._remarks(fitted, measured, sheet),
        )  # fmt: skip

    def _remarks(self, fitted: FittedMap | None, measured: tuple[float, float] | None, sheet: Sheet) -> list[str]:
        """Return the remarks of a certificate: what of it this run has not measured."""
        if fitted is None or measured is None:
            return []
        record, unit = fitted.record, self.run.unit
        both = in_sample(fitted, (str(one["name"]) for one in sheet.recordings))
        remarks = [f"the map was fitted on {name} too, so it predicts what it has seen" for name in both]
        if not both:
            low, high = measured
            at = f"this one was at {low:.2f} to {high:.2f} °C"
            remarks = [f"the bias over temperature is the map's, of another recording; {at}"]
        T = float(self.overview.curves["temperature_raw"][-1])
        if record.domain[0] <= T <= record.domain[1]:
            less = (self.overview.bias - fitted.bias(np.array([T]))[0]) * unit.factor
            values = ", ".join(f"{axis} {v:.3g}" for axis, v in zip(self.model.tracked.axes, less, strict=True))
            remarks.append(f"the bias at the end less the map's there is {values} {unit.shown}")
        return remarks


def run(
    config: ConfigLike,
    data: DataLike = None,
    *,
    units: Units | None = None,
    out: Place | None = None,
    channel: str | None = None,
    smooth: bool = False,
    certificate: bool = False,
    detail: bool = False,
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> RunResult:
    """Run the filter on a recording.

    Writes estimates.h5, summary.json and report.html.

    Parameters
    ----------
    config : path, YAML text, dict or Config
        The unit and its filter; `source` says how files are read, arrays need none.
    data : path, mapping, data frame or Chunk, optional
        The recording.
        The config's own where it is left out. Of a mapping, each value is an array, time first, or a pair of an array
        and its unit.
    units : mapping of str to str, optional
        Units of the channels that have none in `data`.
    out : path, optional
        Folder for the results.
        Arrays are then read from there. Nothing is written where it is left out.
    channel : str, optional
        Sensor whose bias it is about, e.g. accel; default: the config's.
    smooth : bool
        Add what is known given all of the recording (group `smoothed`).
        It is `smoothed` of the result, with `x`, `sigma` (N, n) and `bias` (N, d), and needs `out`.
    certificate : bool
        Write a certificate too: one sheet with results, uncertainty and limits.
        As certificate.html and certificate.json into `out`, which it needs.
    detail : bool
        Keep more of each update: the innovations made white, and the temperature's rate.
        They are `white` (N, m) and `temperature_rate` (N,).
    resume : bool
        Go on where the same run was broken off.
        It needs `out`, in which that run left a checkpoint.
    force : bool
        Replace results that cannot be computed again.
    progress : callable, optional
        Called with the recording's time in s and the number of updates so far, or with a text.

    Returns
    -------
    RunResult
        `t` (N,), `bias`, `bias_sigma`, `coast`, `coast_sigma` (N, d), `x`, `sigma` (N, n), `nis` (N,), ... in SI.

    Raises
    ------
    DataError, ConfigError, UnitError
        If the config or the recording cannot be used, the checkpoint is of another run, or `out` must not be replaced.
    Unwritable
        If the disk is full, or the like.
    """
    understood, journal = config_with(config, data, units).tracking(channel), RunLog()
    if out is None:
        _check_in_memory(smooth, certificate)
        running = Run(understood, journal)
        columns = at_file_precision(joined(_segments(running, journal, progress)))
        return RunResult(scored(running, columns), at_file_precision(columns, detail=detail))
    with output_folder(Path(out), read=understood.files(), resume=resume, force=force) as folder:
        estimates = EstimatesWriter(folder, understood, journal, smooth=smooth, detail=detail)
        before = (estimates.load_checkpoint() or {}).get("run") if resume else None
        hashed = beforehand(understood.source)
        running = Run(understood, journal, resume=before, settled=estimates.write_checkpoint, keep_model=smooth)
        estimates.open(running.model)
        with closing(estimates), closing(_segments(running, journal, progress)) as segments, aside() as do:
            for segment in segments:
                kept = estimates.append(segment)
                if before is None and not smooth:  # else what the file has by its end is looked at
                    estimates.observed = estimates.observed or accumulator_of(running, estimates.whiteness)
                    do(estimates.observed.add, kept)
        if estimates.spool is not None:
            write_smoothed(folder / "estimates.h5", estimates.spool, running.model, progress)
        hashed()
        return finish(estimates, running, Path(out), certificate=certificate)


def _check_in_memory(smooth: bool, certificate: bool) -> None:
    """Raise ConfigError where something is asked for that only files can hold."""
    if certificate:
        raise ConfigError("--certificate: is a file of the results; give --out, a folder")
    if smooth:
        raise ConfigError("--smooth: the way back goes over what a file has kept; give --out, a folder")


def _segments(running: Run, journal: RunLog, progress: Progress | None) -> Generator[RunSegment]:
    """Yield the segments of a run, and report how far it is."""
    count = 0
    with closing(iter(running)) as segments:
        for segment in segments:
            yield segment
            count += len(segment.epochs)
            if progress is not None:
                progress(journal.faults.since(float(segment.epochs.t[-1])), count)


def finish(
    estimates: EstimatesWriter,
    run: Run,
    out: Path,
    recorded: Path | None = None,
    *,
    certificate: bool = False,
) -> RunResult:
    """Write `summary.json`, `report.html` and a certificate of the estimates into their folder, to be called `out`.

    `recorded` is the file in which a live run has kept what came. The estimates are read back where they were not
    observed while they were made.
    """
    folder, path = estimates.folder, estimates.folder / "estimates.h5"
    note_first_row(path, run.journal.faults.first_row)
    if estimates.observed is None:
        with reading(path) as file:
            estimates.observed = accumulator_of(run, estimates.whiteness).read(file)
    result = RunResult(scored(run, estimates.observed), Stored(out / "estimates.h5"), recorded)
    result._write(folder, certificate=certificate)
    (folder / CHECKPOINT).unlink(missing_ok=True)  # it is not needed any more
    return result


def show(result: RunResult, given: Mapping[str, Any]) -> None:
    """Print the verdict on the limits, the table of errors and the notes."""
    config, run = result.config, result.run
    print_verdict(result.verdict)
    say_lines((row.line(run.unit) for row in result.judged if row.verdict != "pass"), "  ")
    name = config.file.stem if config.file else config.name
    say(f"{result_sentences(run)[0]}\n")
    terminal().print(yardstick_table({name: run.yardsticks}, config.recording, run.sensor))
    say_lines(result.lines(), "note: ")
    signed = ", certificate.html, certificate.json" * given.get("certificate", False)
    say(f"written to {given['out']}/: estimates.h5, summary.json, report.html{signed}\n")
