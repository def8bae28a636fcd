"""`driftlab plugins`, `schema` and `check`: what is installed, what may be written, what was understood."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from driftlab.commands.common import ConfigFile, Json, Recording, progress, terminal
from driftlab.commands.session import load, print_json, say

if TYPE_CHECKING:
    from fusion_core.units import Quantity


def plugins(
    json: Json = False,
    check: Annotated[bool, typer.Option("--check", help="Hold each to the laws of its family.")] = False,
) -> None:
    """List every plugin with its distribution, version and state."""
    from fusion_core.host.registry import registry

    if check:
        _laws(json)
        return
    entries = sorted(registry().entries, key=lambda e: (e.error is not None, e.family, e.kind))
    if json:
        fields = ("family", "kind", "distribution", "version", "module", "error")
        print_json([{name: getattr(e, name) for name in fields} for e in entries])
        return
    from rich.table import Table

    table = Table("family", "kind", "distribution", "version", "state")
    for e in entries:
        table.add_row(e.family, e.kind, e.distribution, e.version, "ok" if e.error is None else f"broken: {e.error}")
    terminal().print(table)


def _laws(json: bool) -> None:
    """Print which laws each plugin keeps, and below the table each that one breaks; exit 1 where there is any."""
    from rich.table import Table

    from driftlab.jobs.plugin_laws import plugin_laws
    from fusion_core.host.registry import registry

    held = list(plugin_laws())
    if json:
        rows = [{"family": h.entry.family, "kind": h.entry.kind, "law": h.law, "error": h.error} for h in held]
        print_json(rows)
    else:
        table, broken = Table("family", "kind", "laws kept"), []
        for entry in sorted(registry().entries, key=lambda e: (e.family, e.kind)):
            own = [h for h in held if h.entry is entry]
            lines = [f"{entry.kind}: {h.law}: {h.error}\n" for h in own if h.error is not None]
            broken += lines
            none = "none: it gives no examples" if entry.plugin is not None else "none: it is a file"
            kept = f"{len(own) - len(lines)} of {len(own)}" if own else none
            table.add_row(entry.family, entry.kind, kept)
        terminal().print(table)
        for line in broken:
            say(line)
    if any(h.error is not None for h in held):
        raise typer.Exit(1)


def schema() -> None:
    """Print the JSON schema of the config.

    Every installed plugin is in it.
    """
    from driftlab.config import Config
    from fusion_core.host.schema import config_schema

    print_json(config_schema(Config.model_json_schema()))


def check(
    config: ConfigFile,
    input: Recording = None,
    json: Json = False,
) -> None:
    """Check a config, its maps and the head of its recording.

    Prints the config as it is understood.
    """
    from driftlab.jobs.check import check as job

    with progress("reading"):
        found = job(load(config, input))
    if json:
        values = {at: {"text": q.text, "value": float(q), "unit": _plain_unit(q)} for at, q in found.quantities.items()}
        content = {**found.config.model_dump(mode="json", exclude_none=True), "quantities": values}
        print_json(content)
        return
    say(found.config.as_yaml())
    for at, quantity in found.quantities.items():
        say(f"# {at}: {quantity.text} = {float(quantity):.6g} {_plain_unit(quantity)}\n")
    for line in found.remarks:
        say(f"# {line}\n")


def _plain_unit(quantity: Quantity) -> str:
    return (quantity.unit or "").replace("delta_degC", "K")
