"""Keys of a config that are set beside its file: `filter.align=30 s`.

The key is dotted and counts from the top of the merged config; the value is YAML and takes the place of what was there.
As in a file, another `kind` replaces the mapping that it stands in, since the other keys were of the old kind.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fusion_core.errors import ConfigError, shown
from fusion_core.host.config import Document
from fusion_core.host.document import Lines, Location, parse_value


def override(document: Document, setting: str) -> Document:
    """Return the document with one key set.

    Parameters
    ----------
    document : Document
        Merged; it is not changed.
    setting : str
        `KEY=VALUE`, as written after `--set`.

    Raises
    ------
    ConfigError
        If it is not `KEY=VALUE`, the value is not YAML, or the key leads through what is no mapping.
    """
    key, equals, text = setting.partition("=")
    at = tuple(part.strip() for part in key.split("."))
    if not equals or not all(at):
        raise ConfigError(f"--set {shown(setting)}: is not KEY=VALUE; write e.g. --set 'filter.align=30 s'")
    origin = Path(f"--set {shown(setting)}")
    data = _set(document.data, at, parse_value(text, origin), (), origin)
    replaced = at[:-1] if at[-1] == "kind" and len(at) > 1 else at
    lines = {place: line for place, line in document.lines.items() if place[: len(replaced)] != replaced}
    own: Lines = {at[:depth]: (origin, 0) for depth in range(1, len(at) + 1)}
    return replace(document, data=data, lines={**own, **lines, at: (origin, 0)})


def _set(data: Any, at: Location, value: Any, above: Location, origin: Path) -> dict[str, Any]:
    if data is None:
        data = {}
    if not isinstance(data, dict):
        place, whole = ".".join(map(str, above)), "list" if isinstance(data, list) else "value"
        raise ConfigError(f"{origin}: {place} is a {whole} and has no keys; set all of it: --set '{place}=...'")
    first, *rest = at
    if rest:
        return {**data, first: _set(data.get(first), tuple(rest), value, (*above, first), origin)}
    if first == "kind" and value != data.get("kind", value):
        return {"kind": value}
    return {**data, first: value}
