"""`driftlab allan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from driftlab.commands.common import (
    ConfigFile,
    EnforceLimits,
    Json,
    Recording,
    check_limits,
    leave_by_limits,
    print_verdict,
    progress,
    terminal,
)
from driftlab.commands.session import load, print_json, say

if TYPE_CHECKING:
    from driftlab.jobs.allan import AllanResult


def allan(
    config: ConfigFile,
    input: Recording = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for curves and report.")] = None,
    enforce_limits: EnforceLimits = False,
    json: Json = False,
) -> None:
    """Fit noise and walk to a recording at rest.

    They are fitted to its Allan deviation; prints the lines for a config.
    """
    from driftlab.jobs.allan import allan as job
    from driftlab.reports.allan import document
    from driftlab.storage.json import plain

    loaded = load(config, input)
    check_limits(loaded, enforce_limits)
    with progress("reading") as report:
        result = job(loaded, out, progress=report, read=[config])
    if json:
        content = document(result.found) | {name: result.summary[name] for name in ("serial", "limits")}
        print_json(plain(content))
    else:
        _print(result, out)
    leave_by_limits(result.verdict, enforce_limits)


def _print(result: AllanResult, out: Path | None) -> None:
    from driftlab.reports.allan import table, used

    found, console = result.found, terminal()
    console.print(f"{found.name}: {used(found)}", soft_wrap=True)
    print_verdict(result.verdict, "limits: ")
    for channel in found.curves:
        console.print(table(found, channel))
    for line in result.lines():
        console.print(f"note: {line}", soft_wrap=True)
    say(f"\n{result.config_lines}")
    if out is not None:
        say(f"\nwritten to {out}/: allan.json, allan.svg, report.html, summary.json\n")
