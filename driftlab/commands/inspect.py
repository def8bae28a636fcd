"""`driftlab plugins`, `schema` and `check`: what is installed, what may be written, what was understood."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from driftlab.commands.common import ConfigFile, Json, Recording, terminal
from driftlab.commands.session import load, say

if TYPE_CHECKING:
    from fusion_core.units import Quantity


def plugins(json: Json = False) -> None:
    """List every plugin with its distribution, version and state."""
    import json as codec

    from fusion_core.host.registry import registry

    entries = sorted(registry().entries, key=lambda e: (e.error is not None, e.family, e.kind))
    if json:
        fields = ("family", "kind", "distribution", "version", "module", "error")
        sys.stdout.write(codec.dumps([{name: getattr(e, name) for name in fields} for e in entries], indent=2) + "\n")
        return
    from rich.table import Table

    table = Table("family", "kind", "distribution", "version", "state")
    for e in entries:
        table.add_row(e.family, e.kind, e.distribution, e.version, "ok" if e.error is None else f"broken: {e.error}")
    terminal().print(table)


def schema() -> None:
    """Print the JSON schema of the config, with every installed plugin in it."""
    import json

    from driftlab.config import Config
    from fusion_core.host.schema import config_schema

    sys.stdout.write(json.dumps(config_schema(Config.model_json_schema()), indent=2) + "\n")


def check(
    config: ConfigFile,
    input: Recording = None,
    json: Json = False,
) -> None:
    """Check a config, its maps and the head of its recording; print the config as it is understood."""
    from driftlab.jobs.check import check as job

    found = job(load(config, input))
    if json:
        import json as codec

        values = {at: {"text": q.text, "value": float(q), "unit": _plain_unit(q)} for at, q in found.quantities.items()}
        content = {**found.config.model_dump(mode="json", exclude_none=True), "quantities": values}
        sys.stdout.write(codec.dumps(content, indent=2) + "\n")
        return
    say(found.config.as_yaml())
    for at, quantity in found.quantities.items():
        say(f"# {at}: {quantity.text} = {float(quantity):.6g} {_plain_unit(quantity)}\n")
    for line in found.remarks:
        say(f"# {line}\n")


def _plain_unit(quantity: Quantity) -> str:
    return (quantity.unit or "").replace("delta_degC", "K")
