"""Allan deviation of a recording at rest: `driftlab allan`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftlab.config import Config
from driftlab.evaluation.limits import LimitResult, check_limits, verdict
from driftlab.evaluation.measurements import of_allan
from driftlab.noise.recording import Analysis, analyse
from driftlab.reports.allan import config_lines, document, figure, units_of, write_results
from driftlab.reports.provenance import sheet_of
from driftlab.results import Result
from driftlab.storage.folders import output_folder
from driftlab.storage.json import write_json
from driftlab.units import tracked_unit
from fusion_core.faults import Faults

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[float, int], None]


class AllanResult(Result):
    """Deviations over the averaging time `tau` (J,), s: `gyro`, `gyro_hadamard` and `gyro_sigma` (J, d), `accel` alike.

    Where the config is about another sensor they are called by its channel, in its unit.
    `found` is the analysis, with the coefficients; `config_lines` is what to paste into a config.
    """

    def __init__(self, config: Config, found: Analysis) -> None:
        self.config, self.found, self.name = config, found, found.name
        self.judged = _judged(config, found)
        limits = [row.as_json(tracked_unit(config.filter)) for row in self.judged]
        self.summary = {**document(found, curves=False), "serial": config.serial, "limits": limits}
        self.config_lines = config_lines(found)
        self.units, self.labels = {"tau": "s"}, {}
        self._columns = {"tau": next(iter(found.curves.values()))[0].tau}
        for channel, curves in found.curves.items():
            spread = np.stack([item.spread for item in found.coefficients[channel]], axis=1)
            allan = np.stack([curve.allan for curve in curves], axis=1)
            values = {"": allan, "_hadamard": np.stack([curve.hadamard for curve in curves], axis=1)}
            for end, array in {**values, "_sigma": allan * spread}.items():
                self._columns[channel + end] = array
                self.units[channel + end] = units_of(found, channel).deviation_si
                self.labels[channel + end] = tuple(found.axes[channel])

    def lines(self) -> list[str]:
        """Return what one should know of the analysis, a sentence each."""
        return self.found.notes

    def plot(self) -> Figure:
        """Draw the deviations of every axis, with the terms that were fitted."""
        return figure(self.found)

    @property
    def verdict(self) -> str:
        """Whether the limits of the config are kept, in one line; empty where it has none."""
        return verdict(self.judged)

    def _write(self, folder: Path) -> None:
        sheet = sheet_of(self.config, judged=self.judged, plugins=self.found.plugins)
        write_results(folder, self.found, sheet, self.summary["limits"], write_json)

    def save(self, out: str | PathLike[str]) -> None:
        """Write `allan.json`, `summary.json`, `allan.svg` and `report.html` into the folder `out`."""
        with output_folder(Path(out), "allan", self.config.files()) as folder:
            self._write(folder)


def allan(
    config: Config, out: Path | None = None, *, progress: Progress | None = None, read: Collection[Path] = ()
) -> AllanResult:
    """Return the curves and coefficients of the config's recording; with `out`, write them into that folder too.

    Parameters
    ----------
    config : Config
        With the recording as its source.
    out : Path, optional
        Folder for `allan.json`, `summary.json`, `allan.svg` and `report.html`; it appears when all files are whole.
    progress : callable, optional
        Called with seconds from the first row and the number of samples so far.
    read : collection of Path
        Files that are needed beside the config's: none of them may be in `out`.

    Raises
    ------
    DataError, ConfigError
        If the recording cannot be used, or `out` must not be replaced.
    """
    if out is None:
        return _analysed(config, progress)
    with output_folder(out, "allan", [*read, *config.files()]) as folder:
        result = _analysed(config, progress)
        result._write(folder)
    return result


def _judged(config: Config, found: Analysis) -> list[LimitResult]:
    """Hold noise and bias instability of the tracked sensor against the limits of the config."""
    channel = config.filter.tracked.channel if config.filter else "gyro"
    items = found.coefficients.get(channel)
    measured = of_allan(items, found.axes[channel], found.used_s) if items else {}
    return check_limits(config.limits, measured)


def _analysed(config: Config, progress: Progress | None) -> AllanResult:
    faults = Faults()
    found = analyse(config, faults, progress)
    found.notes[:0] = faults.lines()
    return AllanResult(config, found)
