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

    content = Config.model_json_schema()
    extends = {"type": "string", "description": "a packaged product, or a config file"}
    content["properties"] = {"extends": extends, **content["properties"]}
    sys.stdout.write(json.dumps(content, indent=2) + "\n")


def check(
    config: ConfigFile,
    input: Recording = None,
    json: Json = False,
) -> None:
    """Check a config, its maps and the head of its recording; print the config as it is understood."""
    from driftlab.config import load_config
    from driftlab.fit import map_lines
    from driftlab.intake import head
    from driftlab.run import check_channels, check_maps

    loaded = load_config(config, input)
    remarks = []
    for settings in loaded.maps():
        if settings.path is None:
            remarks.append(f"map {settings.kind}: has no path; `run` needs one, `fit-map` and `explain` do not")
        elif not settings.path.exists():
            remarks.append(f"map {settings.path}: is not there yet; fit it with `driftlab fit-map`")
        else:
            remarks += map_lines(settings.load())
    if loaded.filter is not None and all(settings.path and settings.path.exists() for settings in loaded.maps()):
        check_maps(loaded.filter)
    first = head(loaded)
    if first is not None:
        remarks += first.lines
        if loaded.filter is not None:
            check_channels(loaded.filter, first.chunk)
    if json:
        sys.stdout.write(loaded.model_dump_json(indent=2, exclude_none=True) + "\n")
        return
    sys.stdout.write(loaded.as_yaml())
    for line in remarks:
        sys.stdout.write(f"# {line}\n")
