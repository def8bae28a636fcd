"""Reading a configuration: YAML, `extends`, and errors that say where and what to do.

`extends: NAME` takes a packaged product, `extends: PATH` a file (relative to the file that says so). The two are
merged key by key, and the file's own keys win. A mapping that names another `kind` replaces the whole mapping. A
channel that is `null` takes that of the base away.

Keys of a config that are set beside its file: `filter.align=30 s`.

The key is dotted and counts from the top of the merged config; the value is YAML and takes the place of what was there.
As in a file, another `kind` replaces the mapping that it stands in, since the other keys were of the old kind.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from fusion_core.errors import ConfigError, quote
from fusion_core.host.document import Lines, Location, parse, parse_value
from fusion_core.host.provenance import parts
from fusion_core.settings import can_be_path, did_you_mean
from fusion_core.units import Quantity

Model = TypeVar("Model", bound=BaseModel)
CHANNELS = ("source", "channels")  # a channel of null is one that the base has and this config goes without
LONGEST = 32  # chain of configs that extend one another


@dataclass
class Document:
    """A merged configuration and where each key of it was written."""

    path: Path
    data: dict[str, Any]
    lines: Lines = field(default_factory=dict)
    extends: dict[Path, tuple[str, str]] = field(default_factory=dict)  # of a product's file: its name, and who says so

    def where(self, location: Location) -> str:
        """Return `file:line` of the nearest written key at or above `location`; in the user's file, not in a product's.

        A key of a product is written as the line by which the user extends it, and the product's name.
        """
        for stop in range(len(location), 0, -1):
            if location[:stop] in self.lines:
                path, line = self.lines[location[:stop]]
                if path in self.extends:
                    name, place = self.extends[path]
                    return f"{place}: extends {name} (its line {line})"
                return f"{path}:{line}" if line else str(path)
        return str(self.path)


def read_document(path: Path, products: Mapping[str, Path] | None = None, chain: tuple[Path, ...] = ()) -> Document:
    """Read a YAML file and everything that it extends; `chain` are the files that led here.

    Raises
    ------
    ConfigError
        If a file is missing, is not YAML, or extends itself.
    """
    real = Path(os.path.realpath(path))  # which a circle of links does not end
    if real in chain:
        circle = " -> ".join(str(p) for p in (*chain[-4:], path))
        raise ConfigError(f"{path}: extends itself ({circle}); break the circle")
    if len(chain) > LONGEST:
        raise ConfigError(f"{path}: is the end of more than {LONGEST} configs that extend one another; write fewer")
    return _extended(Document(path, *parse(path)), products or {}, (*chain, real))


def document_of(content: str | Mapping[str, Any], products: Mapping[str, Path] | None = None) -> Document:
    """Take YAML text, or a mapping of keys to values, as a file in the working directory would be read.

    Raises
    ------
    ConfigError
        As `read_document`.
    """
    if isinstance(content, str):
        path = Path("YAML text")
        return _extended(Document(path, *parse(path, content.encode("utf-8", "surrogatepass"))), products or {}, ())
    return _extended(Document(Path("config"), dict(content)), products or {}, ())


def _extended(document: Document, products: Mapping[str, Path], chain: tuple[Path, ...]) -> Document:
    """Return the document with what it extends below it; `seen` are the files that led here."""
    base = document.data.pop("extends", None)
    if base is None:
        return document
    path = _base_path(str(base), document, products)
    parent = read_document(path, products, chain)
    replaced: set[Location] = set()
    merged = _merge(parent.data, document.data, (), replaced)
    inherited = {
        at: line for at, line in parent.lines.items() if not any(at[:k] in replaced for k in range(len(at) + 1))
    }
    extends = parent.extends
    if str(base) in products:  # and what it extends itself
        extends = dict.fromkeys((path, *extends), (str(base), document.where(("extends",))))
    return Document(document.path, merged, {**inherited, **document.lines}, extends)


def _base_path(base: str, document: Document, products: Mapping[str, Path]) -> Path:
    if base in products:
        return products[base]
    path = document.path.parent / base
    if can_be_path(base) and path.is_file():
        return path
    known = did_you_mean(base, products, f"products are {', '.join(sorted(products))}")
    raise ConfigError(
        f"{document.where(('extends',))}: extends: '{quote(base)}' is neither a packaged product nor a file; {known}"
    )


def _merge(base: dict[str, Any], over: dict[str, Any], at: Location, replaced: set[Location]) -> dict[str, Any]:
    """Return both mappings merged, and add to `replaced` where nothing is left of the base."""
    if "kind" in over and over["kind"] != base.get("kind", over["kind"]):
        replaced.add(at)
        return over
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        if not both:
            replaced.add((*at, key))
        merged[key] = _merge(base[key], value, (*at, key), replaced) if both else value
        if value is None and at == CHANNELS:
            del merged[key]
    return merged


def validate(model: type[Model], document: Document, broken: Callable[[], Mapping[str, str]] = dict) -> Model:
    """Check a document against a pydantic model.

    `broken` returns the errors of plugins that are installed and could not be loaded, by name.

    Raises
    ------
    ConfigError
        With one line for each thing that is wrong: file, line, key, what is wrong, what to write.
    """
    try:
        return model.model_validate(document.data, context={"folder": document.path.parent})
    except ValidationError as error:
        lines = [_explain(item, document, broken()) for item in error.errors(include_url=False)]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from None


def _explain(item: Any, document: Document, broken: Mapping[str, str]) -> str:
    location = _written_location(item["loc"], document.data, missing=item["type"] == "missing")
    if item["type"] == "unknown_key":
        location = (*location, item["ctx"]["key"])
    key = quote(".".join(map(str, location)), 200) or "config"
    return f"{document.where(location)}: {key}: {_advice(item, broken)}"


def _advice(item: Any, broken: Mapping[str, str]) -> str:
    match item["type"]:
        case "missing":
            return "is required and missing; add it"
        case "union_tag_invalid":
            return _unknown_kind(item["ctx"], broken)
        case "union_tag_not_found":
            more = ", and `driftlab init FILE` writes it" if "source" in item["loc"] else ""
            return f"needs a `kind:`; `driftlab plugins` lists those known{more}"
        case "model_type" | "model_attributes_type":
            return "is not a mapping of keys to values; write its keys below it"
        case "literal_error":
            return f"is '{quote(item['input'])}'; write {item['ctx']['expected']}"
        case _:
            return str(item["msg"])


def _unknown_kind(context: Mapping[str, Any], broken: Mapping[str, str]) -> str:
    kind = context["tag"]
    if kind in broken:
        return f"kind '{kind}' is installed but broken ({broken[kind]}); mend or reinstall its plugin"
    known = [tag.strip().strip("'") for tag in context["expected_tags"].split(",")]
    advice = did_you_mean(kind, known, f"known: {', '.join(known)}")
    return f"kind '{quote(kind)}' is not installed; {advice}"


def quantities(model: BaseModel) -> Iterator[tuple[str, Quantity]]:
    """Yield every quantity of a config, defaults too: its place (`filter.gyro.noise`), text, unit and value in SI."""
    for at, value, unit in parts(model):
        if isinstance(value, float) and (unit or isinstance(value, Quantity)):
            quantity = value if isinstance(value, Quantity) else Quantity(value, f"{value!r} {unit}", unit)
            yield at, Quantity(value, quantity.text, quantity.unit or unit)


def _written_location(location: Location, data: Any, *, missing: bool) -> Location:
    """Drop what pydantic adds to a location and no user wrote: the tag of a union, the branch of an option.

    Where a key is missing, its name is the last step.
    """
    written: list[str | int] = []
    for k, step in enumerate(location):
        inside = (isinstance(data, dict) and step in data) or (isinstance(data, list) and isinstance(step, int))
        if inside:
            data = data[step]
        elif k < len(location) - 1 or not isinstance(data, dict) or not missing:
            continue
        written.append(step)
    return tuple(written)


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
        raise ConfigError(f"--set {quote(setting)}: is not KEY=VALUE; write e.g. --set 'filter.align=30 s'")
    origin = Path(f"--set {quote(setting)}")
    data = _set(document.data, at, parse_value(text, origin), (), origin)
    replaced = at[:-1] if at[-1] == "kind" and len(at) > 1 else at
    lines = {place: line for place, line in document.lines.items() if place[: len(replaced)] != replaced}
    above: Lines = {at[:depth]: (origin, 0) for depth in range(1, len(at) + 1)}
    return replace(document, data=data, lines={**above, **lines, at: (origin, 0)})


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
