"""Hold every installed plugin to the laws of its family."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fusion_core.host.registry import Entry, registry
from fusion_core.testing import laws


@dataclass(frozen=True)
class LawCheck:
    """One law and one example of a plugin: `error` says why it does not hold, None where it does."""

    entry: Entry
    law: str
    error: str | None


def plugin_laws() -> Iterator[LawCheck]:
    """Yield every law of every plugin that gives examples, as it is checked; nothing of one that gives none."""
    for entry in sorted(registry().entries, key=lambda e: (e.family, e.kind)):
        if entry.plugin is None:  # broken, or no class: a product is a file
            yield from () if entry.error is None else [LawCheck(entry, "loads", entry.error)]
            continue
        try:
            found = laws(entry.plugin)
        except Exception as error:
            yield LawCheck(entry, "gives examples", f"{type(error).__name__}: {error}")
            continue
        for law in found:
            yield LawCheck(entry, str(law).partition(": ")[2] if law.of == entry.kind else str(law), law.broken())
