"""What every plugin is: its own configuration.

A plugin class is a frozen pydantic model whose fields are what the user writes and whose methods speak arrays for a
whole chunk of samples, never one sample. `kind` names it.

What a plugin must remember from one chunk to the next is an explicit `memory` that goes in and comes out (None at the
start). Plugins have no hidden state. The law that follows: any split of a recording into chunks gives the same result.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Iterable
from typing import Any, Self

from fusion_core.settings import Settings

Memory = Any


class Plugin(Settings, ABC):
    """Base of every plugin: a frozen configuration that refuses unknown keys."""

    kind: str

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return configured plugins that `fusion_core.testing` holds to the laws of their family.

        By default the one with nothing but defaults, and none where a field has no default.
        """
        needed = any(info.is_required() for name, info in cls.model_fields.items() if name != "kind")
        return () if needed else (cls.model_validate({}),)
