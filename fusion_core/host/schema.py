"""The JSON schema of a config, for editors: a config that extends another need not be whole.

::

    all configs          ->  what is written, key by key: what is required may stand in the config below, a `kind` too
    without extends      ->  "#/$defs/whole" as well

What is merged key by key may be written in part: mappings, down to any depth. A list replaces the whole list, so its
items are as in a config that stands alone.
"""

from __future__ import annotations

from typing import Any

DIALECT = "https://json-schema.org/draft/2020-12/schema"
PART = "part_of_"  # begins the name of what may be written in part
EXTENDS = {
    "type": "string",
    "description": "A packaged product, or a config file beside this one: it is merged below, the keys here win.",
}


def config_schema(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a config that may extend another.

    Parameters
    ----------
    schema : dict
        Of a config that stands alone, as pydantic writes it.
    """
    root = dict(schema)
    known = root.pop("$defs", {})
    parts = {PART + name: _partial(content) for name, content in known.items()}
    properties = {"extends": EXTENDS, **root["properties"]}
    part = _partial(root)
    return {
        "$schema": DIALECT,
        **part,
        "properties": {"extends": EXTENDS, **part["properties"]},
        "if": {"not": {"required": ["extends"]}},
        "then": {"$ref": "#/$defs/whole"},
        "$defs": {"whole": {**root, "properties": properties}, **known, **parts},
    }


def _partial(schema: Any) -> Any:
    """Return the schema of what is merged into a value of this schema."""
    if isinstance(schema, list):
        return [_partial(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        return {**schema, "$ref": schema["$ref"].replace("#/$defs/", f"#/$defs/{PART}")}
    part = {name: value for name, value in schema.items() if name not in ("required", "discriminator", "minProperties")}
    if "oneOf" in part:  # with nothing required, a part may be one of several kinds
        part["anyOf"] = part.pop("oneOf")
    for name in ("anyOf", "allOf", "additionalProperties"):
        if name in part:
            part[name] = _partial(part[name])
    if "properties" in part:
        part["properties"] = {name: _partial(value) for name, value in part["properties"].items()}
    return part
