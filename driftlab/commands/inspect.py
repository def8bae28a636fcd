"""`driftlab plugins`, `schema` and `check`: what is installed, what may be written, what was understood."""

from __future__ import annotations

import sys

from driftlab.commands.common import ConfigFile, Json, Recording


def plugins(json: Json = False) -> None:
    """List every plugin with its distribution, version and state."""
    import json as codec

    from fusion_core.registry import registry

    entries = sorted(registry().entries, key=lambda e: (e.error is not None, e.family, e.kind))
    if json:
        fields = ("family", "kind", "distribution", "version", "module", "error")
        sys.stdout.write(codec.dumps([{name: getattr(e, name) for name in fields} for e in entries], indent=2) + "\n")
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("family", "kind", "distribution", "version", "state")
    for e in entries:
        table.add_row(e.family, e.kind, e.distribution, e.version, "ok" if e.error is None else f"broken: {e.error}")
    Console().print(table)


def schema() -> None:
    """Print the JSON schema of the config, with every installed plugin in it."""
    import json

    from driftlab.config import Config

    sys.stdout.write(json.dumps(Config.model_json_schema(), indent=2) + "\n")


def check(
    config: ConfigFile,
    input: Recording = None,
    json: Json = False,
) -> None:
    """Check a config, its maps and the head of its recording; print the config as it is understood."""
    from driftlab.config import load_config
    from driftlab.intake import head

    loaded = load_config(config, input)
    for settings in loaded.maps():
        if settings.path is not None:
            settings.load()
    channels = head(loaded)
    if json:
        sys.stdout.write(loaded.model_dump_json(indent=2, exclude_none=True) + "\n")
        return
    sys.stdout.write(loaded.as_yaml())
    for line in channels:
        sys.stdout.write(f"# {line}\n")
