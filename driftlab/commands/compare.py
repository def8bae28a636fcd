"""`driftlab compare`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from driftlab.commands.common import Json, Recording, progress, terminal
from driftlab.commands.session import load, say

if TYPE_CHECKING:
    from driftlab.judging.compare import Comparison


def compare(
    configs: Annotated[list[Path], typer.Argument(metavar="CONFIG...", help="Two or more configs.")],
    input: Recording = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for the report.")] = None,
    json: Json = False,
) -> None:
    """Compare configs on one recording: the paper's tables 5 to 12, and how each coasts."""
    import json as codec

    from driftlab.jobs.compare import compare as job
    from driftlab.jobs.estimates import plain

    loaded = {name: load(path, input) for name, path in _named(configs).items()}
    with progress("comparing") as report:
        result = job(loaded, out, progress=report, read=configs)
    if json:
        sys.stdout.write(codec.dumps(plain(result.summary), indent=2) + "\n")
        return
    _print(result.found)
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


def _print(found: dict[str, Comparison]) -> None:
    from rich.table import Table
    from rich.text import Text

    from driftlab.judging.compare import tables
    from driftlab.judging.summary import error_table

    first = next(iter(found.values()))
    sensor, (size, near) = first.sensor, first.initial.texts
    console = terminal(width=max(terminal().width, 34 + 23 * len(found)))  # no column of a config may be cut off
    for title, rows in tables(found):
        console.print(error_table(title, list(found), rows, sensor.axes, first.initial.unit))
    console.print(f"Time to within {near}, {size} at the start (table 12)", style="italic")
    table = Table("config")
    for axis in sensor.axes:
        table.add_column(Text(f"{axis} [s]"), justify="right")
    for name, comparison in found.items():
        table.add_row(name, *("-" if v != v else f"{v:.1f}" for v in comparison.offset.convergence))
    console.print(table)
    for name, comparison in found.items():
        for line in comparison.remarks:
            console.print(f"note: {name}: {line}", highlight=False, soft_wrap=True, markup=False)
