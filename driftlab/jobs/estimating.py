"""The estimates of a run on their way into its folder, and the checkpoints from which it can go on."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from driftlab import __version__
from driftlab.filtering.checkpoint import read_checkpoint, write_checkpoint
from driftlab.filtering.segment import RunLog, RunSegment
from driftlab.filtering.smoothing import Spool
from driftlab.jobs.estimates import estimates_file
from driftlab.storage.hdf5 import GrowingFile
from fusion_core.contracts import MeasurementModel
from fusion_core.errors import ConfigError, PluginError
from fusion_core.host.provenance import Participant, upgraded

Columns = Mapping[str, NDArray[Any]]
PERIOD = 1.0  # s of the host between checkpoints, and between flushes of what is measured
CHECKPOINT = "checkpoint.npz"
SPOOL = "smoothing.part"


@dataclass
class EstimatesWriter:
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
    journal: RunLog
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

    def append(self, stretch: RunSegment) -> None:
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
