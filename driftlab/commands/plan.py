"""`driftlab plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from driftlab.commands.common import Channel, ConfigFile, Json, progress, terminal
from driftlab.commands.session import load, print_json, say
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    from driftlab.jobs.plan import PlanResult
    from driftlab.jobs.plan_after import AfterResult
    from driftlab.jobs.plan_family import PlanFamilyResult


def _option(name: str, metavar: str, text: str) -> Any:
    return typer.Option(name, metavar=metavar, help=text)


Hours = Annotated[float, _option("--hours", "H", "How long the chamber may take.")]
Range = Annotated[str | None, _option("--range", "LOW..HIGH", "E.g. '-20..50 degC'; default: the config's.")]
Rate = Annotated[str | None, _option("--rate", "RATE", "Fastest that the chamber can; default: 2 K/min.")]
Lag = Annotated[str | None, _option("--lag", "TIME", "Of the unit behind the chamber; default: 10 min.")]
Start = Annotated[str | None, _option("--start", "TEMPERATURE", "Where it begins; default: 25 degC.")]
Walk = Annotated[str | None, _option("--walk", "WALK", "Of the unit's bias; default: the config's.")]
Sigma = Annotated[str | None, _option("--sigma", "SIGMA", "Aim, e.g. '3 deg/h': says the shortest hours.")]
Kind = Annotated[str | None, typer.Option("--kind", help="Kind of map, instead of the config's.")]
Effects = Annotated[str | None, _option("--effects", "KIND,...", "Effects that the profile is to tell apart.")]
Recorded = Annotated[
    list[str] | None, _option("--after", "PATH[::START:STOP]", "What was recorded already; may be repeated.")
]
FamilyFile = Annotated[Path | None, _option("--family", "FAMILY.json", "Of a fleet: says how short a soak may be.")]
Out = Annotated[Path | None, _option("--out", "DIR", "Folder for set points and report.")]


def plan(
    config: ConfigFile,
    hours: Hours = 8.0,
    range_: Range = None,
    rate: Rate = None,
    lag: Lag = None,
    start: Start = None,
    walk: Walk = None,
    sigma: Sigma = None,
    kind: Kind = None,
    effects: Effects = None,
    channel: Channel = None,
    after: Recorded = None,
    family: FamilyFile = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Find the chamber profile that tells most, or the shortest."""
    from driftlab.jobs.plan import plan as job
    from driftlab.jobs.plan_after import plan_further
    from driftlab.jobs.plan_family import plan_with_family
    from driftlab.storage.folders import FILES

    given: dict[str, Any] = {"range": range_, "rate": rate, "lag": lag, "start": start, "walk": walk, "sigma": sigma}
    given |= {"kind": kind, "effects": [] if effects is None else [name.strip() for name in effects.split(",")]}
    with progress("planning") as report:
        loaded = load(config, channel=channel)
        given |= {"out": out, "progress": report, "read": [config]}
        result: PlanResult | AfterResult | PlanFamilyResult
        if family is not None:
            result = plan_with_family(loaded, family, hours, **_for_family(given, after))
        else:
            result = plan_further(loaded, after, hours, **given) if after else job(loaded, hours, **given)
    if json:
        print_json(result.summary)
        return
    _print(result, told=bool(given["effects"]))
    if out is not None:
        say(f"written to {out}/: {', '.join(FILES['plan'])}\n")


def _for_family(given: dict[str, Any], after: list[str] | None) -> dict[str, Any]:
    """Return what is asked of a plan with a family; raises ConfigError where it is something else."""
    if after or given["effects"]:
        raise ConfigError("--family: tells how short a soak may be; leave --after and --effects out")
    return {name: value for name, value in given.items() if name != "effects"}


def _print(result: PlanResult | AfterResult | PlanFamilyResult, *, told: bool) -> None:
    """Print what a plan says; with `told`, which effects are told apart."""
    from driftlab.jobs.plan import PlanResult
    from driftlab.jobs.plan_after import AfterResult
    from driftlab.reports import plan_effects

    console = terminal()
    console.print(result.headline, soft_wrap=True)
    console.print(result.table())
    for line in result.lines():
        console.print(line, soft_wrap=True)
    if told and isinstance(result, (PlanResult, AfterResult)):
        console.print(plan_effects.table(result.outlook))
        for line in plan_effects.lines(result.outlook):
            console.print(line, soft_wrap=True)
