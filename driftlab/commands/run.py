"""`driftlab run`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from driftlab.commands.common import (
    Channel,
    ConfigFile,
    EnforceLimits,
    Force,
    Json,
    Recording,
    Resume,
    check_limits,
    leave_by_limits,
    note_compiling,
    print_verdict,
    progress,
    terminal,
    title,
)
from driftlab.commands.session import load

if TYPE_CHECKING:
    from driftlab.jobs.run import RunResult


def run(
    config: ConfigFile,
    input: Recording = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("driftlab_out"),
    channel: Channel = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Add what is known given all of the recording (group `smoothed`).")
    ] = False,
    resume: Resume = False,
    force: Force = False,
    enforce_limits: EnforceLimits = False,
    json: Json = False,
) -> None:
    """Run the filter on a recording.

    Writes estimates.h5, summary.json and report.html.
    """
    from driftlab.jobs.allocator import keep_freed_memory
    from driftlab.jobs.run import run_to_folder

    loaded = load(config, input, channel)
    check_limits(loaded, enforce_limits)
    note_compiling()
    keep_freed_memory()
    with progress("filtering") as report:
        name = f"{config.stem}: {title(loaded)}"
        how = {"resume": resume, "force": force, "smooth": smooth}
        result = run_to_folder(loaded, out, title=name, progress=report, read=[config], **how)
    if json:
        sys.stdout.write((out / "summary.json").read_text(encoding="utf-8"))
    else:
        show(result, config.stem, title(loaded), out)
    leave_by_limits(result.verdict, enforce_limits)


def show(result: RunResult, name: str, recording: str, out: Path) -> None:
    """Print what a run has found."""
    from driftlab.reports.tables import yardstick_table
    from driftlab.units import unit_of

    console = terminal()
    print_verdict(result.verdict)
    for row in result.judged:
        if row.verdict != "pass":
            console.print(f"  {row.line(unit_of(result.model.tracked))}", soft_wrap=True)
    console.print(yardstick_table({name: result.overview.yardsticks}, recording, result.model.tracked))
    for line in result.lines():
        console.print(f"note: {line}", soft_wrap=True)
    console.print(f"written to {out}/: estimates.h5, summary.json, report.html", soft_wrap=True)
