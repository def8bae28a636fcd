"""Allan deviation of a recording at rest: `driftlab allan`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.commands.console import print_verdict, say, say_lines, terminal
from driftlab.commands.inputs import ConfigLike, DataLike, Place, Progress, Units, config_with
from driftlab.commands.result import Result, in_folder
from driftlab.config import Config
from driftlab.evaluation.limits import check_limits, verdict
from driftlab.evaluation.measurements import of_allan
from driftlab.noise.recording import Analysis, analyse
from driftlab.reports.allan import config_lines, document, page_of, table, units_of, used, whole_chart
from driftlab.reports.charts import Chart
from driftlab.reports.figures import svg
from driftlab.reports.provenance import sheet_of
from driftlab.storage.json import write_json
from driftlab.units import tracked_unit
from fusion_core.faults import Faults


class AllanResult(Result):
    """Deviations over the averaging time `tau` (J,), s: `gyro`, `gyro_hadamard` and `gyro_sigma` (J, d), `accel` alike.

    Where the config is about another sensor they are called by its channel, in its unit.
    `found` is the analysis, with the coefficients; `config_lines` is what to paste into a config.
    """

    command = "allan"

    def __init__(self, config: Config, analysis: Analysis, doubts: Sequence[str] = ()) -> None:
        self.config, self.found, self.name = config, analysis, analysis.name
        channel = config.filter.tracked.channel if config.filter else "gyro"
        items = analysis.coefficients.get(channel)
        measured = of_allan(items, analysis.axes[channel], analysis.used_s) if items else {}
        self.judged = check_limits(config.limits, measured, doubts)
        self.limits_verdict = self.verdict = verdict(self.judged)
        limits = [row.as_json(tracked_unit(config.filter)) for row in self.judged]
        self.summary = {**document(analysis, curves=False), "serial": config.serial, "limits": limits}
        self.config_lines = config_lines(analysis)
        self.units, self.labels = {"tau": "s"}, {}
        self._columns = {"tau": next(iter(analysis.curves.values()))[0].tau}
        for channel, curves in analysis.curves.items():
            spread = np.stack([item.spread for item in analysis.coefficients[channel]], axis=1)
            allan = np.stack([curve.allan for curve in curves], axis=1)
            values = {"": allan, "_hadamard": np.stack([curve.hadamard for curve in curves], axis=1)}
            for end, array in {**values, "_sigma": allan * spread}.items():
                self._columns[channel + end] = array
                self.units[channel + end] = units_of(analysis, channel).deviation_si
                self.labels[channel + end] = tuple(analysis.axes[channel])

    def lines(self) -> list[str]:
        """Return the notes on the analysis, a sentence each."""
        return self.found.notes

    def _chart(self) -> Chart:
        """Return the deviations of every axis, with the terms that were fitted."""
        return whole_chart(self.found)

    def _write(self, folder: Path) -> None:
        sheet = sheet_of(self.config, judged=self.judged, plugins=self.found.plugins)
        write_json(folder / "allan.json", content_of(self, {}))
        write_json(folder / "summary.json", self.summary)
        (folder / "allan.svg").write_text(svg(self.plot()) + "\n", encoding="utf-8")
        (folder / "report.html").write_text(page_of(self.found, sheet), encoding="utf-8")


def allan(
    config: ConfigLike,
    data: DataLike = None,
    *,
    units: Units | None = None,
    out: Place | None = None,
    progress: Progress | None = None,
) -> AllanResult:
    """Fit noise and walk to a recording at rest.

    They are fitted to its Allan deviation; prints the lines for a config.

    Parameters
    ----------
    config, data, units, progress : as those of `run`; the config needs neither filter nor noise
    out : path, optional
        Folder for curves and report.

    Returns
    -------
    AllanResult
        `tau` (J,), `gyro`, `gyro_sigma`, `gyro_hadamard` (J, d), `accel` alike; `config_lines` is for a config, and
        `summary` holds the coefficients with their limits.

    Raises
    ------
    DataError, ConfigError, UnitError
        If the recording cannot be used, or `out` must not be replaced.
    """
    understood = config_with(config, data, units, measuring=True)

    def analysed() -> AllanResult:
        faults = Faults()
        analysis = analyse(understood, faults, progress)
        analysis.notes[:0] = faults.lines()
        return AllanResult(understood, analysis, faults.doubts)

    return in_folder(out, "allan", understood.files(), analysed)


def content_of(result: AllanResult, given: Mapping[str, Any]) -> Any:
    """Return the coefficients with the curves that they were fitted to."""
    return document(result.found) | {name: result.summary[name] for name in ("serial", "limits")}


def show(result: AllanResult, given: Mapping[str, Any]) -> None:
    """Print the coefficients of each sensor, and the lines for a config."""
    analysis, console = result.found, terminal()
    say(f"{analysis.name}: {used(analysis)}\n")
    print_verdict(result.verdict, "limits: ")
    for channel in analysis.curves:
        console.print(table(analysis, channel))
    say_lines(result.lines(), "note: ")
    say(f"\n{result.config_lines}")
    if given["out"] is not None:
        say(f"\nwritten to {given['out']}/: allan.json, allan.svg, report.html, summary.json\n")
