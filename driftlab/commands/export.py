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
    force: Annotated[bool, typer.Option("--force", help="Replace the file, and what stands beside it.")] = False,
    json: Json = False,
) -> None:
    """Write a fitted map in the form of another program.

    Says what it loses.
    """
    from driftlab.jobs.export import export, exporter_of, read_map

    exporter = exporter_of(kind, _pairs(settings or []))
    fitted = read_map(map)
    content = export(exporter, fitted, out, force=force, read=[map])
    if json:
        sys.stdout.write(out.with_name(f"{out.name}.loss.json").read_text(encoding="utf-8"))
        return
    lost = content["largest_error"]
    say(f"largest error: {', '.join(f'{v:.3g}' for v in lost['value'])} {lost['unit']}\n")
    for line in content["left_out"]:
        say(f"left out: {line}\n")
    say(f"written to {out}, {out}.loss.json\n")


def _pairs(settings: list[str]) -> dict[str, str]:
    from fusion_core.errors import ConfigError

    pairs = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: is not KEY=VALUE; write e.g. --set 'step=0.5 K'")
        pairs[key.strip()] = value.strip()
    return pairs
