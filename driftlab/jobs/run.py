"""From a config to the files of a run: `driftlab run`, and the end of `driftlab live`."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from driftlab import __version__
from driftlab.config import Config
from driftlab.evaluation.limits import LimitResult, verdict
from driftlab.evaluation.overview import Overview, overview_of, survey
from driftlab.evaluation.run_limits import averages_of, judged, map_of
from driftlab.evaluation.summary import remarks, summarise
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, RunSegment, joined
from driftlab.jobs.estimates import Stored, kept, note_first_row, units_of, write_smoothed
from driftlab.jobs.estimating import CHECKPOINT, Columns, EstimatesWriter
from driftlab.recordings.identity import beforehand
from driftlab.reports.provenance import sheet_of
from driftlab.reports.run import bias_chart, write_report
from driftlab.results import Result
from driftlab.storage.folders import output_folder
from driftlab.storage.json import write_json
from driftlab.units import unit_of
from fusion_core.contracts import FileSource, MeasurementModel
from fusion_core.errors import ConfigError
from fusion_core.host.provenance import participants

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[..., None]  # with time in s and count, or with a text: what is done now


class RunResult(Result):
    """A run: the columns of `estimates.h5` by name, and what the summary and the report say of it.

    `t` (N,), `bias` and `bias_sigma` (N, d), `coast` and `coast_sigma` (N, d), `x` and `sigma` (N, n), and the rest of
    `estimates.h5`. Of a run that was written to a folder, an array is read when it is asked for.
    """

    def __init__(
        self,
        config: Config,
        model: MeasurementModel,
        journal: RunLog,
        overview: Overview,
        columns: Columns,
        title: str = "",
        judged: Sequence[LimitResult] = (),
    ) -> None:
        self.config, self.model, self.journal, self.overview = config, model, journal, overview
        self.judged = list(judged)
        self.recorded: Path | None = None  # what a live run has kept
        self.name = title or (config.source.name if config.source else "")
        self.units, self._columns = units_of(model), columns
        states, axes = tuple(model.labels), tuple(model.tracked.axes)
        self.labels = {"x": states, "sigma": states, "innovations": states[: model.m], "white": states[: model.m]}
        self.labels |= dict.fromkeys(("rate", "bias", "bias_sigma", "coast", "coast_sigma", "calibration"), axes)
        self.summary = {
            "schema": 1,
            "driftlab": __version__,
            "recording": config.source.name if config.source else "",
            "plugins": participants(config),
            "serial": config.serial,
            "limits": [row.as_json(unit_of(model.tracked)) for row in self.judged],
            **summarise(overview, model, journal),
        }

    def lines(self) -> list[str]:
        """Return what one should know of the run, a sentence each."""
        return remarks(self.overview, self.model, self.journal)

    @property
    def smoothed(self) -> Mapping[str, NDArray[Any]]:
        """States `x`, `sigma` (N, n) and `bias` (N, d) given all of the recording; empty where none was asked for."""
        return Stored(self._columns.path, "smoothed") if isinstance(self._columns, Stored) else {}

    @property
    def verdict(self) -> str:
        """Whether the limits of the config are kept, in one line; empty where it has none."""
        return verdict(self.judged)

    def plot(self) -> Figure:
        """Draw the bias, its prediction and the temperature over time, and the errors below."""
        from driftlab.reports.figures import figure_of

        return figure_of(bias_chart(self.overview, self.model, self.journal, errors=True))

    def save(self, out: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write `estimates.h5`, `summary.json` and `report.html` into the folder `out`, as `driftlab run` does."""
        with output_folder(Path(out), read=self.config.files(), force=force) as folder:
            text, plugins = self.config.as_yaml(), self.summary["plugins"]
            estimating = EstimatesWriter(folder, text, self.journal, recording=_path(self.config), plugins=plugins)
            estimating.open(self.model)
            try:
                estimating.add(dict(self))
            finally:
                estimating.close()
            note_first_row(folder / "estimates.h5", self.journal.faults.first_row)
            self._write(folder)

    def _write(self, folder: Path) -> None:
        write_json(folder / "summary.json", self.summary)
        kept = None if self.recorded is None else [str(self.recorded)]
        sheet = sheet_of(self.config, kept, judged=self.judged, plugins=self.summary["plugins"])
        write_report(
            folder / "report.html",
            self.overview,
            self.summary,
            title=self.name,
            config=self.config.as_yaml(),
            model=self.model,
            journal=self.journal,
            sheet=sheet,
            fitted=map_of(self.config),
        )


def run(
    config: Config,
    out: Path | None = None,
    *,
    title: str = "",
    progress: Progress | None = None,
    resume: bool = False,
    force: bool = False,
    smooth: bool = False,
    read: Collection[Path] = (),
) -> RunResult:
    """Run a config, in memory or into a folder.

    Parameters
    ----------
    config : Config
        With the recording as its source.
    out : Path, optional
        Folder for `estimates.h5`, `summary.json` and `report.html`; it appears when all files are whole.
    title : str
        Of the report.
    progress : callable, optional
        Called with the seconds from the first row and the number of updates so far.
    resume : bool
        Whether to go on where an earlier run of the same config was broken off, if it left a checkpoint in `out`.
    force : bool
        Whether results in `out` may be replaced that cannot be computed again.
    smooth : bool
        Whether `estimates.h5` also has the group `smoothed`: what is known given all of the recording.
    read : collection of Path
        Files that the run needs, beside the config's recording and maps: none of them may be in `out`.

    Raises
    ------
    DataError, ConfigError
        If the recording cannot be used, the checkpoint is of another run, or `out` must not be replaced.
    Unwritable
        If the disk is full, or the like.
    """
    if out is not None:
        how: dict[str, Any] = {"title": title, "progress": progress, "resume": resume, "force": force, "read": read}
        return run_to_folder(config, out, **how, smooth=smooth)
    if smooth:
        raise ConfigError("--smooth: the way back goes over what a file has kept; give --out, a folder")
    journal = RunLog()
    running = Run(config, journal)
    parts, told = [], _Counter(progress, journal)
    with closing(iter(running)) as stretches:
        for stretch in stretches:
            parts.append(stretch)
            told(stretch)
    columns = kept(joined(parts))
    first, model = journal.alignments[0], running.model
    averages = averages_of(config, first)
    overview = overview_of(columns, model, first, first_row=journal.faults.first_row, averages=averages)
    rows = judged(config, overview, first, averages)
    return RunResult(config, model, journal, overview, columns, title, rows)


def run_to_folder(
    config: Config,
    out: Path,
    *,
    title: str = "",
    progress: Progress | None = None,
    resume: bool = False,
    force: bool = False,
    smooth: bool = False,
    read: Collection[Path] = (),
) -> RunResult:
    """Run a config and write the results into the folder `out`; arguments and errors are those of `run`."""
    journal = RunLog()
    with output_folder(out, read=[*read, *config.files()], resume=resume, force=force) as folder:
        estimating = EstimatesWriter(folder, config.as_yaml(), journal, recording=_path(config), smooth=smooth)
        estimating.plugins = participants(config)
        before = (estimating.look_for() or {}).get("run") if resume else None
        run = Run(config, journal, resume=before, settled=estimating.settled, keep_model=smooth)
        estimating.open(run.model)
        told, hashed = _Counter(progress, journal), beforehand(config.source)
        try:
            with closing(iter(run)) as stretches:
                for stretch in stretches:
                    estimating.append(stretch)
                    told(stretch)
        finally:
            estimating.close()
        if estimating.spool is not None:
            write_smoothed(folder / "estimates.h5", estimating.spool, run.model, progress)
        hashed()
        return finish(folder, config, run.model, journal, title, out)


class _Counter:
    """Says how far a run is, stretch after stretch."""

    def __init__(self, progress: Progress | None, journal: RunLog) -> None:
        self.progress, self.journal, self.count = progress, journal, 0

    def __call__(self, stretch: RunSegment) -> None:
        self.count += len(stretch.epochs)
        if self.progress is not None:
            self.progress(self.journal.faults.since(float(stretch.epochs.t[-1])), self.count)


def finish(
    folder: Path,
    config: Config,
    model: MeasurementModel,
    journal: RunLog,
    title: str,
    out: Path,
    recorded: Path | None = None,
) -> RunResult:
    """Write `summary.json` and `report.html` from the estimates in the folder, which will be called `out`.

    `recorded` is the file in which a live run has kept what came.
    """
    first_row, first = journal.faults.first_row, journal.alignments[0]
    note_first_row(folder / "estimates.h5", first_row)
    averages = averages_of(config, first)
    overview = survey(folder / "estimates.h5", model, first, first_row=first_row, averages=averages)
    rows = judged(config, overview, first, averages)
    result = RunResult(config, model, journal, overview, Stored(out / "estimates.h5"), title, rows)
    result.recorded = recorded
    result._write(folder)
    (folder / CHECKPOINT).unlink(missing_ok=True)  # it is not needed any more
    return result


def _path(config: Config) -> Path | None:
    return config.source.path if isinstance(config.source, FileSource) else None
