"""Which plugins take part in a result."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from fusion_core.contracts.families import FAMILIES
from fusion_core.contracts.plugin import Origin, Plugin, kind_default, origin_of

Participant = dict[str, str]


def participants(config: Any, *others: type[Plugin]) -> list[Participant]:
    """Return kind, family, distribution and version of every plugin within a config, and of other classes.

    Distribution and version are empty for a class that is not installed.
    """
    classes = {*map(type, _plugins(config)), *others}
    found = {tuple(_participant(cls).items()): None for cls in classes}
    return [dict(items) for items in sorted(found)]


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
    return {
        "family": origin.family,
        "kind": kind_default(cls),
        "distribution": origin.distribution,
        "version": origin.version,
    }


def _plugins(value: Any) -> Iterator[Plugin]:
    if isinstance(value, Plugin):
        yield value
    if isinstance(value, BaseModel):
        for _, item in value:
            yield from _plugins(item)
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _plugins(item)
    elif isinstance(value, tuple | list | set | frozenset):
        for item in value:
            yield from _plugins(item)
