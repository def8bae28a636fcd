"""From a config to the files of a run: `driftlab run`, and the end of `driftlab live`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from driftlab import __version__
from driftlab.config import Config
from driftlab.files.estimates import estimates_file, note_first_row, write_json
from driftlab.files.folders import output_folder
from driftlab.files.hdf5_stream import GrowingFile
from driftlab.filtering.checkpoint import read_checkpoint, write_checkpoint
from driftlab.filtering.run import Run
from driftlab.filtering.stretch import Journal, Stretch
from driftlab.judging.overview import Overview, survey
from driftlab.judging.summary import summarise
from driftlab.reports.run import write_report
from fusion_core.contracts import FileSource, MeasurementModel
from fusion_core.errors import ConfigError, PluginError
from fusion_core.host.participants import Participant, participants, upgraded

PERIOD = 1.0  # s of the host between checkpoints, and between flushes of what is measured
CHECKPOINT = "checkpoint.npz"


@dataclass(frozen=True)
class Result:
    """What a run leaves: the content of its files."""

    summary: dict[str, Any]
    overview: Overview


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
    plugins: list[Participant] = field(default_factory=list)
    found: dict[str, Any] | None = None  # the checkpoint of an earlier run
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
        self.file = estimates_file(self.folder / "estimates.h5", model, attributes, keep)

    def append(self, stretch: Stretch) -> None:
        """Add the estimates of a stretch."""
        assert self.file is not None, "the file is opened first"
        self.file.append(stretch.columns())

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


def run_to_folder(
    config: Config,
    out: Path,
    *,
    title: str,
    progress: Callable[[float, int], None] | None = None,
    resume: bool = False,
    force: bool = False,
    read: Collection[Path] = (),
) -> Result:
    """Run a config and write `estimates.h5`, `summary.json` and `report.html` into the folder `out`.

    Parameters
    ----------
    config : Config
        With the recording as its source.
    out : Path
        Folder; it appears when all files are whole.
    title : str
        Of the report.
    progress : callable, optional
        Called with the recording's time in s and the number of updates so far.
    resume : bool
        Whether to go on where an earlier run of the same config was broken off, if it left a checkpoint.
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
    journal = Journal()
    with output_folder(out, read=[*read, *config.files()], resume=resume, force=force) as folder:
        recording = config.source.path if isinstance(config.source, FileSource) else None
        plugins = participants(config)
        estimating = Estimating(folder, config.as_yaml(), journal, recording=recording, plugins=plugins)
        found = estimating.look_for() if resume else None
        run = Run(config, journal, resume=found["run"] if found else None, settled=estimating.settled)
        estimating.open(run.model)
        count = 0
        try:
            with closing(iter(run)) as stretches:
                for stretch in stretches:
                    estimating.append(stretch)
                    count += len(stretch.epochs)
                    if progress is not None:
                        progress(float(stretch.epochs.t[-1]), count)
        finally:
            estimating.close()
        return finish(folder, config, run.model, journal, title)


def finish(folder: Path, config: Config, model: MeasurementModel, journal: Journal, title: str) -> Result:
    """Write `summary.json` and `report.html` from the estimates in the folder; checkpoints are not needed any more."""
    note_first_row(folder / "estimates.h5", journal.faults.first_row)
    overview = survey(folder / "estimates.h5", model, journal.alignments[0], first_row=journal.faults.first_row)
    summary = {
        "schema": 1,
        "driftlab": __version__,
        "recording": config.source.name if config.source else "",
        "plugins": participants(config),
        **summarise(overview, model, journal),
    }
    write_json(folder / "summary.json", summary)
    write_report(folder / "report.html", overview, summary, title=title, config=config.as_yaml(), m=model.m)
    (folder / CHECKPOINT).unlink(missing_ok=True)
    return Result(summary, overview)
