"""From a config to the files of a run: `driftlab run`, and the end of `driftlab live`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from driftlab import __version__
from driftlab.config import Config
from driftlab.files.folders import output_folder
from driftlab.files.hdf5_stream import GrowingFile
from driftlab.filtering.checkpoint import read_checkpoint, write_checkpoint
from driftlab.filtering.run import Run
from driftlab.filtering.smoothing import Spool
from driftlab.filtering.stretch import Journal, Stretch, joined
from driftlab.jobs.estimates import Stored, estimates_file, kept, note_first_row, units_of, write_json, write_smoothed
from driftlab.judging.overview import Overview, overview_of, survey
from driftlab.judging.summary import remarks, summarise
from driftlab.reports.run import write_report
from driftlab.results import Result
from fusion_core.contracts import FileSource, MeasurementModel
from fusion_core.errors import ConfigError, PluginError
from fusion_core.host.participants import Participant, participants, upgraded

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Columns = Mapping[str, NDArray[Any]]
Progress = Callable[..., None]  # with time in s and count, or with a text: what is done now

PERIOD = 1.0  # s of the host between checkpoints, and between flushes of what is measured
CHECKPOINT = "checkpoint.npz"
SPOOL = "smoothing.part"


class RunResult(Result):
    """A run: the columns of `estimates.h5` by name, and what the summary and the report say of it.

    `t` (N,), `bias` and `bias_sigma` (N, d), `coast` and `coast_sigma` (N, d), `x` and `sigma` (N, n), and the rest of
    `estimates.h5`. Of a run that was written to a folder, an array is read when it is asked for.
    """

    def __init__(
        self,
        config: Config,
        model: MeasurementModel,
        journal: Journal,
        overview: Overview,
        columns: Columns,
        title: str = "",
    ) -> None:
        self.config, self.model, self.journal, self.overview = config, model, journal, overview
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
            **summarise(overview, model, journal),
        }

    def lines(self) -> list[str]:
        """Return what one should know of the run, a sentence each."""
        return remarks(self.summary, self.model)

    def plot(self) -> Figure:
        """Draw the bias, its prediction and the temperature over time."""
        from driftlab.reports.plots import bias_figure

        return bias_figure({"": self.overview.curves}, self.model.tracked, self.overview.first_row)

    def save(self, out: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write `estimates.h5`, `summary.json` and `report.html` into the folder `out`, as `driftlab run` does."""
        with output_folder(Path(out), read=self.config.files(), force=force) as folder:
            text, plugins = self.config.as_yaml(), self.summary["plugins"]
            estimating = Estimating(folder, text, self.journal, recording=_path(self.config), plugins=plugins)
            estimating.open(self.model)
            try:
                estimating.add(dict(self))
            finally:
                estimating.close()
            note_first_row(folder / "estimates.h5", self.journal.faults.first_row)
            self._write(folder)

    def _write(self, folder: Path) -> None:
        write_json(folder / "summary.json", self.summary)
        path, text = folder / "report.html", self.config.as_yaml()
        write_report(path, self.overview, self.summary, title=self.name, config=text, model=self.model)


@dataclass
class Estimating:
    """The estimates of a run on their way into its folder, and the checkpoints from which it can go on.

    Attributes
    ----------
    folder : Path
        Of the run, not whole yet.
    text : str
        The config as it is understood: a run goes on with the very same one.
    journal : Journal
        Where it is noted if no checkpoint can be written.
    more : callable
        What else belongs into a checkpoint.
    recording : Path or None
        What the estimates can be computed from again.
    live : bool
        Whether they are a device's.
    plugins : list of dict
        Those that take part: a run goes on with the very same ones.
    """

    folder: Path
    text: str
    journal: Journal
    more: Callable[[], dict[str, Any]] = dict
    recording: Path | None = None
    live: bool = False
    smooth: bool = False  # whether they are to be smoothed when all are there
    plugins: list[Participant] = field(default_factory=list)
    found: dict[str, Any] | None = None  # the checkpoint of an earlier run
    spool: Spool | None = None
    file: GrowingFile | None = None
    written: float = field(default_factory=time.monotonic)
    possible: bool = True

    def look_for(self) -> dict[str, Any] | None:
        """Return the checkpoint in the folder, None where there is none; raises ConfigError where it is of another."""
        path = self.folder / CHECKPOINT
        if not path.exists():
            return None
        self.found = read_checkpoint(path)
        if self.found["config"] != self.text or self.found["driftlab"] != __version__:
            raise ConfigError(
                f"--resume: {self.folder} was begun with another config, recording or version of driftlab; "
                "use the same, or begin anew without --resume"
            )
        changed = upgraded(self.found["plugins"], self.plugins)
        if changed:
            raise ConfigError(
                f"--resume: {self.folder} was begun with other plugins ({', '.join(changed)}); install the same, or "
                "begin anew without --resume"
            )
        return self.found

    def open(self, model: MeasurementModel) -> None:
        """Open `estimates.h5`, with the rows that the checkpoint knows."""
        recording = os.path.realpath(self.recording) if self.recording is not None else ""
        attributes = {"driftlab": __version__, "config": self.text, "recording": recording, "live": self.live}
        keep = self.found["rows"] if self.found else 0
        if self.smooth:
            self.spool = Spool(self.folder / SPOOL, keep)
        self.file = estimates_file(self.folder / "estimates.h5", model, attributes, keep)

    def append(self, stretch: Stretch) -> None:
        """Add the estimates of a stretch."""
        self.add(stretch.columns())
        if self.spool is not None:
            self.spool.add(stretch)

    def add(self, columns: Columns) -> None:
        """Add rows of estimates."""
        assert self.file is not None, "the file is opened first"
        self.file.append(columns)

    def settled(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """Flush and write a checkpoint, if it is time."""
        assert self.file is not None, "the file is opened first"
        if time.monotonic() - self.written < PERIOD:
            return
        self.file.flush()
        if self.possible:
            content = {"driftlab": __version__, "config": self.text, "plugins": self.plugins,
                       "rows": self.file.rows, "run": snapshot()}  # fmt: skip
            try:
                write_checkpoint(self.folder / CHECKPOINT, content | self.more())
            except PluginError as error:
                self.possible = False
                self.journal.faults.add(f"run without checkpoints ({error})", 1, "from the start")
        self.written = time.monotonic()

    def close(self) -> None:
        """Write the rest of the estimates."""
        if self.file is not None:
            self.file.close()


def run(
    config: Config,
    out: Path | None = None,
    *,
    title: str = "",
    progress: Progress | None = None,
    resume: bool = False,
    force: bool = False,
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
        return run_to_folder(config, out, **how)
    journal = Journal()
    running = Run(config, journal)
    columns = kept(joined(_counted(running, progress)))
    overview = overview_of(columns, running.model, journal.alignments[0], first_row=journal.faults.first_row)
    return RunResult(config, running.model, journal, overview, columns, title)


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
    """Run a config and write the results into the folder `out`; arguments and errors are those of `run`.

    With `smooth`, `estimates.h5` also has the group `smoothed`: what is known given all of the recording.
    """
    journal = Journal()
    with output_folder(out, read=[*read, *config.files()], resume=resume, force=force) as folder:
        estimating = Estimating(folder, config.as_yaml(), journal, recording=_path(config), smooth=smooth)
        estimating.plugins = participants(config)
        before = (estimating.look_for() or {}).get("run") if resume else None
        run = Run(config, journal, resume=before, settled=estimating.settled, keep_model=smooth)
        estimating.open(run.model)
        try:
            for stretch in _counted(run, progress):
                estimating.append(stretch)
        finally:
            estimating.close()
        if estimating.spool is not None:
            write_smoothed(folder / "estimates.h5", estimating.spool, run.model, progress)
        return finish(folder, config, run.model, journal, title, out)


def _counted(run: Run, progress: Progress | None) -> Iterator[Stretch]:
    """Yield the stretches of a run, and say how far it is."""
    count = 0
    with closing(iter(run)) as stretches:
        for stretch in stretches:
            yield stretch
            count += len(stretch.epochs)
            if progress is not None:
                progress(run.journal.faults.since(float(stretch.epochs.t[-1])), count)


def finish(folder: Path, config: Config, model: MeasurementModel, journal: Journal, title: str, out: Path) -> RunResult:
    """Write `summary.json` and `report.html` from the estimates in the folder, which will be called `out`."""
    first_row = journal.faults.first_row
    note_first_row(folder / "estimates.h5", first_row)
    overview = survey(folder / "estimates.h5", model, journal.alignments[0], first_row=first_row)
    result = RunResult(config, model, journal, overview, Stored(out / "estimates.h5"), title)
    result._write(folder)
    (folder / CHECKPOINT).unlink(missing_ok=True)  # it is not needed any more
    return result


def _path(config: Config) -> Path | None:
    return config.source.path if isinstance(config.source, FileSource) else None
