"""`driftlab allan`."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import ConfigFile, Json, Recording, progress, terminal


def allan(
    config: ConfigFile,
    input: Recording = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for curves and report.")] = None,
    json: Json = False,
) -> None:
    """Fit noise, walk and their kin to the Allan deviation of a recording at rest; print the lines for a config."""
    import json as codec

    from driftlab.allan.deviation import analyse
    from driftlab.config import load_config
    from driftlab.files.estimates import plain, write_json
    from driftlab.files.folders import output_folder
    from driftlab.reports.allan import config_lines, document, table, used, write_results
    from fusion_core.faults import Faults

    loaded, faults = load_config(config, input), Faults()
    with ExitStack() as stack:
        read = [config, *loaded.files()]
        folder = None if out is None else stack.enter_context(output_folder(out, "allan", read))
        with progress("reading") as report:
            found = analyse(loaded, faults, report)
        found.notes[:0] = faults.lines()
        if folder is not None:
            write_results(folder, found, write_json)
    if json:
        sys.stdout.write(codec.dumps(plain(document(found)), indent=2) + "\n")
        return
    console = terminal()
    console.print(f"{found.name}: {used(found)}", soft_wrap=True)
    for channel in found.curves:
        console.print(table(found, channel))
    for line in found.notes:
        console.print(f"note: {line}", soft_wrap=True)
    sys.stdout.write(f"\n{config_lines(found)}")
    if out is not None:
        sys.stdout.write(f"\nwritten to {out}/: allan.json, allan.svg, report.html, summary.json\n")
