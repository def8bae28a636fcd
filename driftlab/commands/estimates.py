"""The file of estimates of a run, on its way into the folder, and the checkpoints from which the run can go on."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab import __version__
from driftlab.config import Config
from driftlab.evaluation.overview import OverviewAccumulator, counted
from driftlab.filtering.checkpoint import read_checkpoint, write_checkpoint
from driftlab.filtering.segment import TEMPERATURES, RunLog, RunSegment
from driftlab.filtering.smoothing import Spool
from driftlab.storage.hdf5 import PIECE, Columns, GrowingFile, columns_of, continued, named, reading
from fusion_core.consistency import Whiteness
from fusion_core.contracts import FileSource, MeasurementModel
from fusion_core.errors import ConfigError, PluginError
from fusion_core.host.provenance import participants, upgraded

PERIOD = 1.0  # s of the host between checkpoints, and between flushes of what is measured
CHECKPOINT = "checkpoint.npz"
SPOOL = "smoothing.part"
UNITS = {
    "t": "s", "tau": "s", "white": "1", "nis": "1", "used": "1", "still": "1", "temperature": "degC",
    "temperature_rate": "K/s", "temperature_raw": "degC",
}  # fmt: skip
TRACKED = ("rate", "bias", "bias_sigma", "coast", "coast_sigma", "calibration")  # in the unit of the tracked sensor
# seven digits are enough for what is noise, or was measured in single precision
SINGLE = ("innovations", "white", "nis", "rate", "bias_sigma", "coast_sigma", *TEMPERATURES)
DETAIL = ("white", "temperature_rate")  # looked at seldom: of whole innovations, and of `temperature`
SETTLING = ("sigma", "bias_sigma", "tau", "used", "still", "calibration")  # the same from update to update, before long


def units_of(model: MeasurementModel) -> dict[str, str | tuple[str, ...]]:
    """Return the unit of each column of a run, or one a state."""
    states = tuple(model.units)
    sized = {"x": states, "sigma": states, "innovations": tuple(unit for _, _, unit in model.components)}
    return UNITS | dict.fromkeys(TRACKED, model.tracked.unit) | sized


def at_file_precision(columns: Columns, *, detail: bool = True) -> dict[str, NDArray[Any]]:
    """Return the columns of a run as precise as `estimates.h5` keeps them; those of DETAIL only where it is wanted."""
    kept = {name: values for name, values in columns.items() if detail or name not in DETAIL}
    return {n: values.astype(np.float32, copy=False) if n in SINGLE else values for n, values in kept.items()}


def write_smoothed(
    path: Path, spool: Spool, model: MeasurementModel, progress: Callable[..., None] | None = None
) -> None:
    """Add the group `smoothed` to a finished `estimates.h5`, from what was spooled; the spool is then removed.

    It holds x, sigma and bias given all of the recording. `progress` is called with its name.
    """
    import h5py

    if progress is not None:
        progress("smoothing")

    d, block = len(model.tracked.axes), model.places[model.tracked.channel]
    n, units = len(model.labels), units_of(model)
    with named(path), h5py.File(path, "r+", rdcc_nbytes=1 << 24) as file:
        group = file.create_group("smoothed")
        for name, width, like in (("x", n, "x"), ("sigma", n, "x"), ("bias", d, "bias")):
            shape, pieces = (spool.rows, width), (min(PIECE, spool.rows), width)
            data = group.create_dataset(name, shape, np.float32 if name == "sigma" else np.float64, chunks=pieces)
            unit = units[like]
            data.attrs["unit"] = unit if isinstance(unit, str) else ", ".join(unit)
            if like == "x":
                data.attrs["labels"] = model.labels
        for start, x, sigma, bias in spool.smoothed(model.restarting, block):
            rows = slice(start, start + len(x))
            group["x"][rows], group["sigma"][rows], group["bias"][rows] = x, sigma, bias
    spool.remove()


class Stored(Mapping[str, NDArray[Any]]):
    """The columns of an `estimates.h5`, or of a group in it, each read when it is asked for."""

    def __init__(self, path: Path, group: str = "/") -> None:
        self.path, self.group = path, group

    def __getitem__(self, name: str) -> NDArray[Any]:
        with reading(self.path) as file:
            column = columns_of(self.path, file[self.group], [name])[name]
            return column[: len(column.node)]

    def __contains__(self, name: object) -> bool:
        return name in set(self)

    def __iter__(self) -> Iterator[str]:
        with reading(self.path) as file:
            return iter([name for name, item in file.get(self.group, {}).items() if hasattr(item, "shape")])

    def __len__(self) -> int:
        return len(list(iter(self)))


def estimates_file(path: Path, model: MeasurementModel, attributes: Mapping[str, Any], keep: int = 0) -> GrowingFile:
    """Return `estimates.h5`, to be written stretch by stretch (`RunSegment.columns`); `keep` rows that are there stay.

    Every data set has its `unit`, time is its first axis.
    """
    units = {name: unit if isinstance(unit, str) else ", ".join(unit) for name, unit in units_of(model).items()}
    columns: dict[str, dict[str, Any]] = {name: {"unit": unit} for name, unit in units.items()}
    for name in ("x", "sigma"):
        columns[name]["labels"] = model.space.labels
    how = (attributes, columns, SINGLE, SETTLING)
    return continued(path, keep, *how) if keep else GrowingFile(path, *how)


def note_first_row(path: Path, first_row: float | None) -> None:
    """Add to `t` of a finished `estimates.h5` when the recording's first row was, in its own seconds (`first_row`)."""
    import h5py

    if first_row is None:
        return
    with named(path), h5py.File(path, "r+") as file:
        file["t"].attrs["first_row"] = first_row


@dataclass
class EstimatesWriter:
    """The estimates of a run on their way into its folder, and the checkpoints from which it can go on.

    A run goes on with the very same config, and the very same plugins.

    Attributes
    ----------
    folder : Path
        Of the run, not whole yet.
    config : Config
    journal : RunLog
        Where it is noted if no checkpoint can be written.
    recording : Path or None
        What the estimates can be computed from again; the config's own file where it is left out.
    live : bool
        Whether they are a device's.
    smooth : bool
        Whether they are to be smoothed when all are there.
    detail : bool
        Whether all columns are kept; a run that goes on keeps those that it began with.
    more : callable
        What else belongs into a checkpoint.
    """

    folder: Path
    config: Config
    journal: RunLog
    recording: Path | None = None
    live: bool = False
    smooth: bool = False
    detail: bool = True
    more: Callable[[], dict[str, Any]] = dict
    checkpoint: dict[str, Any] | None = None  # of an earlier run
    spool: Spool | None = None
    whiteness: Whiteness | None = None  # of the innovations, where they are not kept
    observed: OverviewAccumulator | None = None  # of all rows, where they were looked at as they came
    file: GrowingFile | None = None
    written: float = field(default_factory=time.monotonic)
    possible: bool = True

    def __post_init__(self) -> None:
        plain = self.config.model_copy(update={"certificate": None})  # its texts change no result
        self.text, self.plugins = plain.as_yaml(), participants(self.config)
        if isinstance(self.config.source, FileSource):
            self.recording = self.recording or self.config.source.path

    def load_checkpoint(self) -> dict[str, Any] | None:
        """Return the checkpoint in the folder, None where there is none; raises ConfigError where it is of another."""
        path = self.folder / CHECKPOINT
        if not path.exists():
            return None
        self.checkpoint = read_checkpoint(path)
        if self.checkpoint["config"] != self.text or self.checkpoint["driftlab"] != __version__:
            raise ConfigError(
                f"--resume: {self.folder} was begun with another config, recording or version of driftlab; "
                "use the same, or begin anew without --resume"
            )
        changed = upgraded(self.checkpoint["plugins"], self.plugins)
        if changed:
            raise ConfigError(
                f"--resume: {self.folder} was begun with other plugins ({', '.join(changed)}); install the same, or "
                "begin anew without --resume"
            )
        return self.checkpoint

    def open(self, model: MeasurementModel) -> None:
        """Open `estimates.h5`, with the rows that the checkpoint knows."""
        recording = os.path.realpath(self.recording) if self.recording is not None else ""
        attributes = {"driftlab": __version__, "config": self.text, "recording": recording, "live": self.live}
        keep = self.checkpoint["rows"] if self.checkpoint else 0
        known = self.checkpoint.get("whiteness") if self.checkpoint else None if self.detail else {}  # None: all kept
        if known is not None:
            self.whiteness = Whiteness(model.m)
            vars(self.whiteness).update(known)
        if self.smooth:
            self.spool = Spool(self.folder / SPOOL, keep)
        self.file = estimates_file(self.folder / "estimates.h5", model, attributes, keep)

    def append(self, stretch: RunSegment) -> Columns:
        """Add the estimates of a stretch, and return them as they are kept."""
        columns: Columns = stretch.columns()
        if self.whiteness is not None:
            after = counted(columns, self.journal.alignments[0])
            self.whiteness.add(columns["white"][slice(None) if after.all() else after].astype(np.float32))
        columns = at_file_precision(columns, detail=self.whiteness is None)
        self.add(columns)
        if self.spool is not None:
            self.spool.add(stretch)
        return columns

    def add(self, columns: Columns) -> None:
        """Add rows of estimates."""
        assert self.file is not None, "the file is opened first"
        self.file.append(columns)

    def write_checkpoint(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """Flush and write a checkpoint, if it is time."""
        assert self.file is not None, "the file is opened first"
        if time.monotonic() - self.written < PERIOD:
            return
        self.file.flush()
        if self.possible:
            content = {"driftlab": __version__, "config": self.text, "plugins": self.plugins,
                       "rows": self.file.rows, "run": snapshot(),
                       "whiteness": None if self.whiteness is None else vars(self.whiteness)}  # fmt: skip
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
