"""Sections that plugins add to the report of a run."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from driftlab.reports.pages import drawing
from fusion_core.chunk import Array, read_only
from fusion_core.contracts import ReportSection, Section
from fusion_core.errors import FusionError
from fusion_core.host.guard import guarded
from fusion_core.host.registry import registry


def sections(summary: Mapping[str, Any], curves: Mapping[str, Array]) -> list[dict[str, Any]]:
    """Return title, paragraphs, HTML and drawing of each section; one that fails says so in its own place."""
    shared = MappingProxyType({name: read_only(values) for name, values in curves.items()})
    found = []
    for kind, cls in registry().classes(ReportSection).items():
        try:
            with guarded(cls, "its settings"):
                plugin: Any = cls.model_validate({"kind": kind})
            section = plugin.section(copy.deepcopy(dict(summary)), shared)
        except FusionError as error:
            section = Section(kind, f"This section could not be made: {error}")
        if section is not None:
            found.append(_values(section))
    return found


def _values(section: Section) -> dict[str, Any]:
    paragraphs = [part for part in section.text.split("\n\n") if part.strip()]
    inside = {"html": drawing(section.html), "svg": drawing(section.svg)}
    return {"title": section.title, "paragraphs": paragraphs, **inside}
