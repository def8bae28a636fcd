"""The hooks of a plugin module.

Each family of plugins (`fusion_core.contracts.families`, and those that `families()` adds) has a hook of its name,
without arguments, that returns a list of classes: `bias_models()`, `effects()`, ... A class of a family that bears the
mark `hookimpl` itself stands for a hook that returns it alone. The two hooks here return something else.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from fusion_core.contracts.plugin import Family

PROJECT = "fusion_core"  # also the name of the entry-point group

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def families() -> list[Family]:  # type: ignore[empty-body]
    """Return families of plugins that the module adds, each with its contract."""


@hookspec
def products() -> Mapping[str, str | Path]:  # type: ignore[empty-body]
    """Return configs by the name under which others extend them: `extends: acme_x1`; each the path of a YAML file."""
