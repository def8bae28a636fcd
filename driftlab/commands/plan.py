"""`driftlab plan`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from driftlab.commands.common import ConfigFile, Json, progress, terminal
from driftlab.commands.session import load, say


def plan(
    config: ConfigFile,
    hours: Annotated[float, typer.Option("--hours", metavar="H", help="How long the chamber may take.")] = 8.0,
    range_: Annotated[
        str | None, typer.Option("--range", metavar="LOW..HIGH", help="E.g. '-20..50 degC'; default: the config's.")
    ] = None,
    rate: Annotated[
        str | None, typer.Option("--rate", metavar="RATE", help="Fastest that the chamber can; default: 2 K/min.")
    ] = None,
    lag: Annotated[
        str | None, typer.Option("--lag", metavar="TIME", help="Of the unit behind the chamber; default: 10 min.")
    ] = None,
    start: Annotated[
        str | None, typer.Option("--start", metavar="TEMPERATURE", help="Where it begins; default: 25 degC.")
    ] = None,
    walk: Annotated[
        str | None, typer.Option("--walk", metavar="WALK", help="Of the unit's bias; default: the config's.")
    ] = None,
    sigma: Annotated[
        str | None, typer.Option("--sigma", metavar="SIGMA", help="Aim, e.g. '3 deg/h': says the shortest hours.")
    ] = None,
    kind: Annotated[str | None, typer.Option("--kind", help="Kind of map, instead of the config's.")] = None,
    effects: Annotated[
        str | None, typer.Option("--effects", metavar="KIND,...", help="Effects that the profile is to tell apart.")
    ] = None,
    after: Annotated[
        list[str] | None,
        typer.Option("--after", metavar="PATH[::START:STOP]", help="What was recorded already; may be repeated."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for set points and report.")] = None,
    json: Json = False,
) -> None:
    """Find the chamber profile that tells most of the map, before anything is recorded or after it."""
    import json as codec

    from driftlab.files.replaceable import FILES
    from driftlab.jobs.plan import plan as job
    from driftlab.jobs.plan_after import plan_further
    from driftlab.reports import plan_effects

    given: dict[str, Any] = {
        "range": range_,
        "rate": rate,
        "lag": lag,
        "start": start,
        "walk": walk,
        "sigma": sigma,
        "kind": kind,
    }
    kinds = [kind.strip() for kind in effects.split(",")] if effects else []
    with progress("planning") as report:
        loaded = load(config)
        given |= {"out": out, "progress": report, "read": [config], "effects": kinds}
        result = plan_further(loaded, after, hours, **given) if after else job(loaded, hours, **given)
    if json:
        sys.stdout.write(codec.dumps(result.summary, indent=2) + "\n")
        return
    console = terminal()
    console.print(result.headline, soft_wrap=True)
    console.print(result.table())
    for line in result.lines():
        console.print(line, soft_wrap=True)
    if kinds:
        console.print(plan_effects.table(result.outlook))
        for line in plan_effects.lines(result.outlook):
            console.print(line, soft_wrap=True)
    if out is not None:
        say(f"written to {out}/: {', '.join(FILES['plan'])}\n")
