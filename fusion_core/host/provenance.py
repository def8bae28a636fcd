"""The plugins that take part in a result, with their distributions and versions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from fusion_core.contracts.families import FAMILIES
from fusion_core.contracts.plugin import Origin, Plugin, kind_default, origin_of
from fusion_core.units import Unit

Participant = dict[str, str]


def participants(config: Any, *others: type[Plugin]) -> list[Participant]:
    """Return kind, family, distribution and version of every plugin within a config, and of other classes.

    Distribution and version are empty for a class that is not installed.
    """
    classes = {*(type(part) for _, part, _ in parts(config) if isinstance(part, Plugin)), *others}
    distinct = {tuple(_participant(cls).items()): None for cls in classes}
    return [dict(items) for items in sorted(distinct)]


def upgraded(before: Iterable[Participant], now: Iterable[Participant]) -> list[str]:
    """Return a few words for each plugin of another distribution or version than before."""
    known = {(item["family"], item["kind"]): item for item in before}
    words = []
    for item in now:
        old = known.get((item["family"], item["kind"]), item)
        if old != item:
            words.append(f"{item['kind']} was of {_release(old)} and is of {_release(item)}")
    return words


def _release(item: Participant) -> str:
    return f"{item['distribution']} {item['version']}".strip() or "no distribution"


def _participant(cls: type[Plugin]) -> Participant:
    family = next((family.name for family in FAMILIES if issubclass(cls, family.contract)), "")
    origin = origin_of(cls) or Origin(family, "", "")
    return {"family": origin.family, "kind": kind_default(cls), **origin._asdict()}


def parts(value: Any, at: str = "", unit: str | None = None) -> Iterator[tuple[str, Any, str | None]]:
    """Yield a value of a config and each part of it, defaults too: its place, itself, and the unit of its field."""
    yield at, value, unit
    items: Iterable[tuple[Any, Any, str | None]] = ()
    if isinstance(value, BaseModel):
        marks = ((name, mark) for name, info in type(value).model_fields.items() for mark in info.metadata)
        units = {name: mark.unit for name, mark in marks if isinstance(mark, Unit)}
        items = ((name, item, units.get(name)) for name, item in value)
    elif isinstance(value, Mapping):
        items = ((key, item, unit) for key, item in value.items())
    elif isinstance(value, tuple | list | set | frozenset):
        items = ((k, item, unit) for k, item in enumerate(value))
    for key, item, unit_of_item in items:
        yield from parts(item, f"{at}.{key}" if at else str(key), unit_of_item)
