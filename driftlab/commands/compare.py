"""Several configs on one recording: `driftlab compare`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.commands.console import load, say, say_lines, terminal
from driftlab.commands.inputs import ConfigLike, DataLike, Place, Progress, Units, config_with, named
from driftlab.commands.result import Result, in_folder
from driftlab.config import Config
from driftlab.evaluation import comparison
from driftlab.evaluation.comparison import Comparison
from driftlab.reports.charts import Chart
from driftlab.reports.compare import bias_chart, write_comparison
from driftlab.reports.provenance import sheet_of
from driftlab.reports.tables import TextTable, error_table, yardstick_table
from driftlab.storage.json import write_json
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    import polars as pl
    from rich.table import Table

UNLIMITED = 10_000  # characters


class CompareResult(Result):
    """A comparison: the `Comparison` of each config, by name; `name` is the recording's."""

    command = "compare"

    def __init__(self, configs: Mapping[str, Config], comparisons: dict[str, Comparison], recording: str) -> None:
        self.configs, self.found, self.name, self._columns = dict(configs), comparisons, recording, comparisons
        self.summary = comparison.as_json(comparisons, recording)

    def __getitem__(self, name: str) -> Comparison:  # type: ignore[override]
        return self.found[name]

    def lines(self) -> list[str]:
        """Return the ranking by prediction, and the notes on the runs, a sentence each."""
        return [self.summary["verdict"], *comparison.limit_lines(self.found), *comparison.notes(self.found)]

    def to_polars(self) -> pl.DataFrame:
        """Return the tables as one: table, row, config, axis and error in SI."""
        import polars as pl

        sensor = next(iter(self.found.values())).sensor
        rows = [
            (table, label, name, axis, float(value))
            for table, part in comparison.tables(self.found)
            for label, columns in part
            for name, values in zip(self.found, columns, strict=True)
            for axis, value in zip(sensor.axes, values, strict=True)
        ]
        return pl.DataFrame(rows, schema=["table", "row", "config", "axis", f"error [{sensor.unit}]"], orient="row")

    def _chart(self) -> Chart:
        """Return bias, prediction and temperature over time, of every config."""
        return bias_chart(self.found)

    def _write(self, folder: Path) -> None:
        write_json(folder / "summary.json", self.summary)
        sheets = {name: sheet_of(self.configs[name], judged=c.judged) for name, c in self.found.items()}
        write_comparison(folder / "report.html", self.found, self.name, sheets)


def compare(
    configs: Mapping[str, ConfigLike] | Sequence[ConfigLike],
    data: DataLike = None,
    *,
    units: Units | None = None,
    out: Place | None = None,
    channel: str | None = None,
    progress: Progress | None = None,
) -> CompareResult:
    """Compare configs on one recording: which predicts best.

    Parameters
    ----------
    configs : mapping of str to config, or sequence of paths
        Two or more configs.
        A mapping names them as tables are to; files have their own names.
    data, units, channel : as those of `run`
    out : path, optional
        Folder for the report.
    progress : callable, optional
        Called with texts.

    Returns
    -------
    CompareResult
        The comparison of each config, by name; `to_polars()` gives the paper's tables 5 to 12, and how each predicts.

    Raises
    ------
    DataError, ConfigError, UnitError
        If a config cannot be run on the recording, the recordings or the sensors differ, or `out` must not be replaced.
    """
    loaded = {name: config_with(config, data, units).tracking(channel) for name, config in named(configs).items()}
    recordings = {config.source.name for config in loaded.values() if config.source is not None}
    if len(recordings) != 1:
        raise ConfigError(
            f"the configs read different recordings ({', '.join(sorted(recordings))}); give one with --input"
        )

    def compared() -> CompareResult:
        return CompareResult(loaded, comparison.compare(dict(loaded), progress), recordings.pop())

    return in_folder(out, "compare", [path for config in loaded.values() for path in config.files()], compared)


def arguments_of(arguments: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Load the configs, with what the command line sets."""
    recordings, paths = arguments.pop("data", None), named(arguments["configs"])
    loaded = {name: load(Path(path), recordings, arguments.get("channel")) for name, path in paths.items()}  # type: ignore[arg-type]
    return {**arguments, "configs": loaded}


def show(result: CompareResult, given: Mapping[str, Any]) -> None:
    """Print who predicts best, the tables, and with `paper` the paper's too."""
    comparisons = result.found
    first = next(iter(comparisons.values()))
    sensor, unit = first.sensor, first.initial.unit

    def coasts(part: dict[str, Comparison]) -> list[Table]:
        return [yardstick_table({name: c.yardsticks for name, c in part.items()}, result.name, sensor)]

    def of_the_paper(part: dict[str, Comparison]) -> list[Table]:
        tables = comparison.paper(part)
        return [error_table(title, list(part), unit, (sensor.axes, rows), si=True) for title, rows in tables]

    terminal().print(comparison.verdict(comparisons))
    say_lines([*comparison.limit_lines(comparisons), ""])
    _side_by_side(comparisons, coasts)
    if given["paper"]:
        _side_by_side(comparisons, of_the_paper)
        size, near = first.initial.texts
        rows = [[n, *("-" if v != v else f"{v:.1f}" for v in c.offset.convergence)] for n, c in comparisons.items()]
        title = f"Time to within {near}, {size} at the start (table 12)"
        terminal().print(TextTable(["config", *(f"{axis} [s]" for axis in sensor.axes)], rows, title))
    say_lines(comparison.notes(comparisons), "note: ")
    if given["out"] is not None:
        say(f"written to {given['out']}/: summary.json, report.html\n")


def _side_by_side(comparisons: dict[str, Comparison], tables: Callable[[dict[str, Comparison]], list[Table]]) -> None:
    """Print tables of the configs, with as few of them below one another as the terminal's width allows."""
    width, names = terminal().width, list(comparisons)
    for pieces in range(1, len(names) + 1):
        size = -(-len(names) // pieces)
        parts = [names[k : k + size] for k in range(0, len(names), size)]
        made = [tables({name: comparisons[name] for name in part}) for part in parts]
        needed = max(terminal(width=UNLIMITED).measure(table).maximum for part in made for table in part)
        if needed <= width:
            break
    console = terminal(width=max(width, needed))  # not even where a single config is too wide is a number cut off
    for same in zip(*made, strict=True):
        console.print(*same, sep="\n")
