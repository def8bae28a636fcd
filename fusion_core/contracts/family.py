"""What a family of plugins is: its hook, its contract, and how what its plugins answer is checked.

The layer that owns a contract declares its family. A distribution adds one of its own by the hook `families()`; plugins
of it are then found wherever they are installed, and `Annotated[ItsContract, Installed()]` accepts them in a config.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from fusion_core.contracts.plugin import Plugin

Check = Callable[..., Any]


@dataclass(frozen=True)
class Family:
    """One family of plugins.

    Attributes
    ----------
    name : str
        Of the family, and of the hook by which a module returns its classes.
    contract : type
        Base of the family's classes. Its `contract` is the version that the host speaks.
    purpose : str
        What the family is about, in a few words.
    answers : mapping of str to callable
        By name of a method or property: `check(plugin, answer, *arguments)` returns the answer, or raises PluginError.
        Whatever else the contract declares is guarded too: what it raises is reported by the plugin's name.
    """

    name: str
    contract: type[Plugin]
    purpose: str
    answers: Mapping[str, Check] = field(default_factory=dict)
