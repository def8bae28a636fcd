"""Several configs on one recording: `driftlab compare`."""

from __future__ import annotations

import html
from collections.abc import Callable, Collection, Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from driftlab.config import Config
from driftlab.evaluation.comparison import Comparison, as_json, limit_lines, notes, tables
from driftlab.evaluation.comparison import compare as compare_all
from driftlab.results import picture
from driftlab.storage.folders import output_folder
from driftlab.storage.json import write_json
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure


class CompareResult(Mapping[str, Comparison]):
    """A comparison: what each config came to, by name.

    Attributes
    ----------
    name : str
        The recording.
    summary : dict
        The content of `summary.json`, in SI.
    """

    def __init__(self, configs: Mapping[str, Config], found: dict[str, Comparison], recording: str) -> None:
        self.configs, self.found, self.name = dict(configs), found, recording
        self.summary = as_json(found, recording)

    def __getitem__(self, name: str) -> Comparison:
        return self.found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.found)

    def __len__(self) -> int:
        return len(self.found)

    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def lines(self) -> list[str]:
        """Return who coasts best, and what one should know of the runs, a sentence each."""
        limits = [f"{name}: {line}" for name, line in limit_lines(self.found).items()]
        return [self.summary["verdict"], *limits, *notes(self.found)]

    def to_polars(self) -> pl.DataFrame:
        """Return the tables as one: table, row, config, axis and error in SI."""
        import polars as pl

        sensor = next(iter(self.found.values())).sensor
        rows = [
            (table, label, name, axis, float(value))
            for table, part in tables(self.found)
            for label, columns in part
            for name, values in zip(self.found, columns, strict=True)
            for axis, value in zip(sensor.axes, values, strict=True)
        ]
        return pl.DataFrame(rows, schema=["table", "row", "config", "axis", f"error [{sensor.unit}]"], orient="row")

    def plot(self) -> Figure:
        """Draw what every config makes of the recording: bias, prediction and temperature over time."""
        from driftlab.reports.compare import bias_chart
        from driftlab.reports.figures import figure_of

        return figure_of(bias_chart(self.found))

    def save(self, out: str | PathLike[str]) -> None:
        """Write `summary.json` and `report.html` into the folder `out`, as `driftlab compare` does."""
        with output_folder(Path(out), "compare", _files(self.configs)) as folder:
            self._write(folder)

    def _write(self, folder: Path) -> None:
        from driftlab.reports.compare import write_comparison
        from driftlab.reports.provenance import sheet_of

        write_json(folder / "summary.json", self.summary)
        sheets = {name: sheet_of(self.configs[name], judged=c.judged) for name, c in self.found.items()}
        write_comparison(folder / "report.html", self.found, self.name, sheets)

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{html.escape(line)}</li>" for line in self.lines())
        return f"<h4>{html.escape(self.name)}</h4><ul>{notes}</ul>{picture(self.plot())}"


def compare(
    configs: Mapping[str, Config],
    out: Path | None = None,
    *,
    progress: Callable[[str], None] | None = None,
    read: Collection[Path] = (),
) -> CompareResult:
    """Run every config on the recording that they share; with `out`, write the comparison into that folder too.

    Parameters
    ----------
    configs : mapping of str to Config
        By the names that they have in tables; with the same recording as their source.
    out : Path, optional
        Folder for `summary.json` and `report.html`; it appears when both are whole.
    progress : callable, optional
        Called with what is being done.
    read : collection of Path
        Files that are needed beside the configs': none of them may be in `out`.

    Raises
    ------
    DataError, ConfigError
        If a config cannot be run on the recording, the recordings or the sensors differ, or `out` must not be replaced.
    """
    recording = _shared_recording(configs)
    if out is None:
        return CompareResult(configs, compare_all(dict(configs), progress), recording)
    with output_folder(out, "compare", [*read, *_files(configs)]) as folder:
        result = CompareResult(configs, compare_all(dict(configs), progress), recording)
        result._write(folder)
    return result


def _files(configs: Mapping[str, Config]) -> list[Path]:
    return [path for config in configs.values() for path in config.files()]


def _shared_recording(configs: Mapping[str, Config]) -> str:
    sources = {config.source.name for config in configs.values() if config.source is not None}
    if len(sources) != 1:
        raise ConfigError(
            f"the configs read different recordings ({', '.join(sorted(sources))}); give one with --input"
        )
    return sources.pop()
