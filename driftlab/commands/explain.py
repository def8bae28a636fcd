"""`driftlab explain`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from driftlab.commands.common import Channel, ConfigFile, Json, print_verdict, progress, terminal
from driftlab.commands.session import load, print_json, say

if TYPE_CHECKING:
    from driftlab.identification.result import Identification

RECORDINGS = "PATH[::START:STOP]"


def explain(
    config: ConfigFile,
    calibration: Annotated[
        list[str], typer.Option("--calibration", metavar=RECORDINGS, help="The soak; may be repeated.")
    ],
    train: Annotated[
        list[str], typer.Option("--train", metavar=RECORDINGS, help="To find effects on; may be repeated.")
    ],
    holdout: Annotated[
        list[str], typer.Option("--holdout", metavar=RECORDINGS, help="To judge on, opened last; may be repeated.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")],
    channel: Channel = None,
    estimate: Annotated[
        bool, typer.Option("--estimate", help="Let the new config go on estimating the effects' coefficients.")
    ] = False,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="KIND", help="Effects not to try; may be repeated.")
    ] = None,
    json: Json = False,
) -> None:
    """Find what the declared model lacks, and add it.

    Shows the error before and after on recordings that are opened last.
    """
    from driftlab.jobs.explain import explain as close

    loaded = load(config, channel=channel)
    with progress("explaining") as show:
        closed = close(
            loaded, calibration, train, holdout, out, show, estimate=estimate, without=without or (), read=[config]
        )
    if json:
        from driftlab.storage.json import plain

        print_json(plain(closed.content))
        return
    _print(closed)
    configs = "explained.yaml, candidate.yaml" if closed.refuted else "explained.yaml"
    say(f"written to {out}: loop.json, {configs}, prediction.h5, report.html, and the maps\n")


def _print(closed: Identification) -> None:
    from rich.text import Text

    from driftlab.reports.explain import tables

    console = terminal()
    console.print(Text.assemble("verdict: ", (closed.verdict.word.replace("_", " "), "bold")))
    for line in closed.lines:
        console.print(f"  {line}", soft_wrap=True)
    print_verdict(closed.content["limits_verdict"], "limits: ")
    for table in tables(closed):
        console.print()
        console.print(table)
