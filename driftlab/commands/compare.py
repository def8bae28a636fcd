"""`driftlab compare`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from driftlab.commands.common import Channel, Json, Recording, progress, terminal
from driftlab.commands.session import load, print_json, say

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.evaluation.comparison import Comparison

UNLIMITED = 10_000  # characters


def compare(
    configs: Annotated[list[Path], typer.Argument(metavar="CONFIG...", help="Two or more configs.")],
    input: Recording = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for the report.")] = None,
    channel: Channel = None,
    paper: Annotated[bool, typer.Option("--paper", help="Print the paper's tables 5 to 12 too, in SI.")] = False,
    json: Json = False,
) -> None:
    """Compare configs on one recording: which coasts best."""
    from driftlab.jobs.compare import compare as job
    from driftlab.storage.json import plain

    loaded = {name: load(path, input, channel) for name, path in _named(configs).items()}
    with progress("comparing") as report:
        result = job(loaded, out, progress=report, read=configs)
    if json:
        print_json(plain(result.summary))
        return
    _print(result.found, result.name, paper)
    if out is not None:
        say(f"written to {out}/: summary.json, report.html\n")


def _named(configs: list[Path]) -> dict[str, Path]:
    """Return the configs by their stems, or by their paths where two have the same."""
    from fusion_core.errors import ConfigError

    stems = [path.stem for path in configs]
    names = stems if len(set(stems)) == len(stems) else [str(path) for path in configs]
    if len(set(names)) < len(names):
        raise ConfigError("a config is named twice; name different ones")
    return dict(zip(names, configs, strict=True))


def _print(found: dict[str, Comparison], recording: str, paper: bool) -> None:
    from driftlab.evaluation import comparison as judging
    from driftlab.evaluation import comparison as sentences
    from driftlab.reports.tables import error_table, yardstick_table

    first = next(iter(found.values()))
    sensor, unit = first.sensor, first.initial.unit

    def coasts(part: dict[str, Comparison]) -> list[Table]:
        return [yardstick_table({name: c.yardsticks for name, c in part.items()}, recording, sensor)]

    def of_the_paper(part: dict[str, Comparison]) -> list[Table]:
        tables = judging.paper(part)
        return [error_table(title, list(part), rows, sensor.axes, unit, si=True) for title, rows in tables]

    terminal().print(sentences.verdict(found))
    for name, line in sentences.limit_lines(found).items():
        terminal().print(f"{name}: {line}", soft_wrap=True)
    terminal().print()
    _side_by_side(found, coasts)
    if paper:
        _side_by_side(found, of_the_paper)
        _print_convergence(found)
    for line in sentences.notes(found):
        terminal().print(f"note: {line}", soft_wrap=True)


def _side_by_side(found: dict[str, Comparison], tables: Callable[[dict[str, Comparison]], list[Table]]) -> None:
    """Print tables of the configs, with as few of them below one another as the terminal's width allows."""
    width, names = terminal().width, list(found)
    for pieces in range(1, len(names) + 1):
        size = -(-len(names) // pieces)
        parts = [names[k : k + size] for k in range(0, len(names), size)]
        made = [tables({name: found[name] for name in part}) for part in parts]
        needed = max(terminal(width=UNLIMITED).measure(table).maximum for part in made for table in part)
        if needed <= width:
            break
    console = terminal(width=max(width, needed))  # not even where a single config is too wide is a number cut off
    for same in zip(*made, strict=True):
        console.print(*same, sep="\n")


def _print_convergence(found: dict[str, Comparison]) -> None:
    from rich.table import Table
    from rich.text import Text

    first = next(iter(found.values()))
    size, near = first.initial.texts
    table = Table("config", title=f"Time to within {near}, {size} at the start (table 12)", title_justify="left")
    for axis in first.sensor.axes:
        table.add_column(Text(f"{axis} [s]"), justify="right", no_wrap=True)
    for name, comparison in found.items():
        table.add_row(name, *("-" if v != v else f"{v:.1f}" for v in comparison.offset.convergence))
    terminal().print(table)
