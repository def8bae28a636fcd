"""`driftlab run`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import ConfigFile, Json, Recording, Resume, progress, title


def run(
    config: ConfigFile,
    input: Recording = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("driftlab_out"),
    resume: Resume = False,
    json: Json = False,
) -> None:
    """Run the filter on a recording: estimates.h5, summary.json and report.html."""
    from driftlab.config import load_config
    from driftlab.filtering import run_to_folder
    from driftlab.summary import remarks, yardstick_table

    loaded = load_config(config, input)
    with progress("filtering") as report:
        result = run_to_folder(loaded, out, title=f"{config.stem}: {title(loaded)}", progress=report, resume=resume)
    if json:
        sys.stdout.write((out / "summary.json").read_text(encoding="utf-8"))
        return
    from rich.console import Console

    console = Console()
    console.print(yardstick_table({config.stem: result.yardsticks}, f"{title(loaded)}"))
    for line in remarks(result.summary):
        console.print(f"note: {line}", highlight=False, soft_wrap=True, markup=False)
    console.print(f"written to {out}/: estimates.h5, summary.json, report.html", highlight=False)
