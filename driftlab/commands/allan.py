"""`driftlab allan`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import ConfigFile, Json, Recording, progress, terminal
from driftlab.commands.session import load, say


def allan(
    config: ConfigFile,
    input: Recording = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for curves and report.")] = None,
    json: Json = False,
) -> None:
    """Fit noise and walk to a recording at rest.

    They are fitted to its Allan deviation; prints the lines for a config.
    """
    import json as codec

    from driftlab.jobs.allan import allan as job
    from driftlab.jobs.estimates import plain
    from driftlab.reports.allan import document, table, used

    loaded = load(config, input)
    with progress("reading") as report:
        result = job(loaded, out, progress=report, read=[config])
    found = result.found
    if json:
        content = document(found) | {name: result.summary[name] for name in ("serial", "limits")}
        sys.stdout.write(codec.dumps(plain(content), indent=2) + "\n")
        return
    console = terminal()
    console.print(f"{found.name}: {used(found)}", soft_wrap=True)
    if result.verdict:
        console.print(f"limits: {result.verdict}", soft_wrap=True)
    for channel in found.curves:
        console.print(table(found, channel))
    for line in result.lines():
        console.print(f"note: {line}", soft_wrap=True)
    say(f"\n{result.config_lines}")
    if out is not None:
        say(f"\nwritten to {out}/: allan.json, allan.svg, report.html, summary.json\n")
