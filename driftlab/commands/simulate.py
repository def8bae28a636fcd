"""`driftlab simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import ConfigFile, Json, progress
from driftlab.commands.session import load, print_json, say


def simulate(
    config: ConfigFile,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The recording: FILE.h5 or FILE.csv.")],
    seed: Annotated[
        int | None, typer.Option("--seed", metavar="N", help="Of the random numbers, instead of the config's.")
    ] = None,
    duration: Annotated[
        str | None, typer.Option("--duration", metavar="TIME", help="E.g. '20 min', instead of the config's.")
    ] = None,
    json: Json = False,
) -> None:
    """Write a simulated recording, with its true bias, to a file."""
    from driftlab.jobs.simulate import simulate as job

    with progress("simulating") as report:
        written = job(load(config), out, seed=seed, duration=duration, progress=report)
    if json:
        print_json(written.summary)
        return
    first, last = written.span
    say(f"{written.name}: {written.rows:,} rows, t = {first:g} to {last:.10g} s\n")
    for line in written.lines():
        say(f"note: {line}\n")
    say(f"written to {written.path}: {', '.join(written.channels)}\n")
