"""`driftlab export`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import Json
from driftlab.commands.session import say


def export(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="The form; `driftlab plugins` lists the exporters.")],
    map: Annotated[Path, typer.Argument(metavar="MAP|CONFIG", help="A map's file, or a config that names one.")],
    out: Annotated[Path, typer.Option("--out", metavar="PATH", help="The file to write.")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting of the form; may be repeated.")
    ] = None,
    run: Annotated[
        Path | None, typer.Option("--run", metavar="DIR", help="A run's folder: noise as its innovations say.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file, and what stands beside it.")] = False,
    json: Json = False,
) -> None:
    """Write a calibration in the form of another program.

    Says what it loses.
    """
    from json import dumps, loads

    from driftlab.jobs.export import LOSS, export, exporter_of, key_of, read_export

    exporter = exporter_of(kind, pairs(settings or []))
    what = read_export(map)
    if run is not None:
        from driftlab.jobs.inflation import with_inflation

        what = with_inflation(what, run)
    loss = export(exporter, what, out, force=force, read=[map])
    beside = (out if exporter.folder else out.parent) / LOSS
    if json:
        own = loads(beside.read_text(encoding="utf-8"))["exports"][key_of(out)]
        sys.stdout.write(dumps(own, indent=2) + "\n")
        return
    for line in loss.lines():
        say(f"{line}\n")
    say(f"written to {out}, {beside}\n")


def pairs(settings: list[str]) -> dict[str, str]:
    """Return settings that are written KEY=VALUE by their names; raises ConfigError."""
    from fusion_core.errors import ConfigError

    pairs = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: is not KEY=VALUE; write e.g. --set 'step=0.5 K'")
        pairs[key.strip()] = value.strip()
    return pairs
