"""`driftlab fleet`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from driftlab.commands.common import Channel, ConfigFile, EnforceLimits, Json, check_limits, terminal
from driftlab.commands.session import load, print_json, say

Units = Annotated[
    str,
    typer.Option(
        "--units", metavar="'GLOB'|MANIFEST.csv", help="Recordings, a unit each; or a table of unit, role and path."
    ),
]
Out = Annotated[Path, typer.Option("--out", metavar="FLEET", help="Folder; what is done there is not done again.")]
Workers = Annotated[
    int | None, typer.Option("--workers", metavar="N", min=1, help="Processes; default: one a processor.")
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Of Dask, e.g. tcp://host:8786: its workers do it.")
]
Explain = Annotated[
    bool, typer.Option("--explain", help="Close the loop for each unit with recordings to train and to judge by.")
]
Pages = Annotated[
    list[str] | None,
    typer.Option("--pages", metavar="NAME|GLOB|all", help="Units whose pages to write; may be repeated."),
]
Family = Annotated[
    Path | None,
    typer.Option("--family", metavar="FAMILY.json", help="A family that is known: none is fitted."),
]
Again = Annotated[bool, typer.Option("--force", help="Do every unit again.")]


def fleet(
    config: ConfigFile,
    units: Units,
    out: Out,
    workers: Workers = None,
    scheduler: Scheduler = None,
    explain: Explain = False,
    pages: Pages = None,
    family: Family = None,
    force: Again = False,
    channel: Channel = None,
    enforce_limits: EnforceLimits = False,
    json: Json = False,
) -> None:
    """Calibrate the units of a line, and learn their family.

    Finds the odd ones. The same command again goes on where it ended.
    """
    from driftlab.commands.fleet_progress import fleet_progress
    from driftlab.production.fleet import FleetOptions
    from driftlab.production.fleet import fleet as job

    loaded = load(config, channel=channel)
    check_limits(loaded, enforce_limits)
    wanted = FleetOptions(workers, scheduler, explain, tuple(pages or ()), family, force)
    try:
        with fleet_progress() as show:
            result = job(loaded, units, out, wanted, show)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what is done is in {out}, and the same command goes on from there") from None
    if json:
        print_json(result.summary, indent=1)
    else:
        for line in result.lines():
            terminal().print(line, soft_wrap=True)
        say(f"written to {out}/: {', '.join(result.written)}\n")
    if enforce_limits:
        _leave(result.summary)


def _leave(summary: dict[str, Any]) -> None:
    """End with 1 where a unit fails a limit, with 3 where one is not known to pass all."""
    limits = summary["limits"]
    if limits.get("fail"):
        raise typer.Exit(1)
    if limits.get("pass", 0) < summary["counts"]["units"]:
        raise typer.Exit(3)
