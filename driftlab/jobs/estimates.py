"""The files of a run: JSON, and the file of estimates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from driftlab.filtering.segment import TEMPERATURES
from driftlab.storage.hdf5 import PIECE, GrowingFile, columns_of, continued, named, reading

if TYPE_CHECKING:
    from driftlab.filtering.smoothing import Spool
    from fusion_core.contracts import MeasurementModel


def note_first_row(path: Path, first_row: float | None) -> None:
    """Add to `t` of a finished `estimates.h5` when the recording's first row was, in its own seconds (`first_row`)."""
    import h5py

    if first_row is None:
        return
    with named(path), h5py.File(path, "r+") as file:
        file["t"].attrs["first_row"] = first_row


UNITS = {
    "t": "s", "tau": "s", "white": "1", "nis": "1", "used": "1", "still": "1", "temperature": "degC",
    "temperature_rate": "K/s", "temperature_raw": "degC",
}  # fmt: skip
TRACKED = ("rate", "bias", "bias_sigma", "coast", "coast_sigma", "calibration")  # in the unit of the tracked sensor


# seven digits are enough for what is noise, or was measured in single precision
SINGLE = ("innovations", "white", "nis", "rate", "bias_sigma", "coast_sigma", *TEMPERATURES)
SETTLING = ("sigma", "bias_sigma", "tau", "used", "still", "calibration")  # the same from update to update, before long


def units_of(model: MeasurementModel) -> dict[str, str | tuple[str, ...]]:
    """Return the unit of each column of a run, or one a state."""
    states = tuple(model.units)
    own = {"x": states, "sigma": states, "innovations": tuple(unit for _, _, unit in model.components)}
    return UNITS | dict.fromkeys(TRACKED, model.tracked.unit) | own


def kept(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the columns of a run as precise as `estimates.h5` keeps them."""
    return {n: values.astype(np.float32) if n in SINGLE else values for n, values in columns.items()}


def write_smoothed(
    path: Path, spool: Spool, model: MeasurementModel, progress: Callable[..., None] | None = None
) -> None:
    """Add the group `smoothed` to a finished `estimates.h5`, from what was spooled; the spool is then removed.

    It holds x, sigma and bias given all of the recording. `progress` is told that this goes on.
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
        for part in spool.smoothed(model.restarting, block):
            rows = slice(part.start, part.start + len(part.x))
            group["x"][rows], group["sigma"][rows], group["bias"][rows] = part.x, part.sigma, part.bias
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
    """Return `estimates.h5`, to be written stretch by stretch (`Stretch.columns`); `keep` rows that are there stay.

    Every data set has its `unit`, time is its first axis.
    """
    units = {name: unit if isinstance(unit, str) else ", ".join(unit) for name, unit in units_of(model).items()}
    columns: dict[str, dict[str, Any]] = {name: {"unit": unit} for name, unit in units.items()}
    for name in ("x", "sigma"):
        columns[name]["labels"] = model.space.labels
    how = (attributes, columns, SINGLE, SETTLING)
    return continued(path, keep, *how) if keep else GrowingFile(path, *how)
