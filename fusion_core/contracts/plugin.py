"""The base of every plugin, which is its own configuration.

A plugin class is a frozen pydantic model whose fields are what the user writes and whose methods speak arrays for a
whole chunk of samples, never one sample. `kind` names it.

What a plugin must remember from one chunk to the next is an explicit `memory` that goes in and comes out (None at the
start). Plugins have no hidden state. The law that follows: any split of a recording into chunks gives the same result.

What a plugin is given cannot be written to: it is shared with the rest of the program.

A family of plugins has a hook, a contract, and a check of each answer. The layer that owns a contract declares its
family. A distribution adds one of its own by the hook `families()`; plugins of it are then found wherever they are
installed, and `Annotated[ItsContract, Installed()]` accepts them in a config.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

from pydantic import ValidationError

from fusion_core.errors import PluginError
from fusion_core.settings import Settings

Memory = Any

HOME = "driftlab"  # the distribution of the built-in plugins


class Origin(NamedTuple):
    """Family and distribution of an installed class."""

    family: str
    distribution: str
    version: str


class Plugin(Settings, ABC):
    """Base of every plugin: a frozen configuration that refuses unknown keys."""

    contract: ClassVar[int] = 1  # version of the family's contract that the class was written for

    kind: str
    """Name of the plugin in its family."""

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return configured plugins that `fusion_core.testing` holds to the laws of their family.

        By default the one with nothing but defaults, and none where that is not enough.
        """
        try:
            return (cls.model_validate({}),)
        except ValidationError:
            return ()


_ORIGINS: dict[type, Origin] = {}
_KINDS: dict[type, str] = {}  # of the plugin that makes objects of a class which is none itself: a detector


def claim(cls: type, origin: Origin, kind: str | None = None) -> None:
    """Note the origin of a class; the host does so when it registers one. What a distribution brought stays its own.

    `kind` is that of the plugin which makes objects of the class, where the class is no plugin itself.
    """
    if origin.distribution or cls not in _ORIGINS:
        _ORIGINS[cls] = origin
        if kind is not None:
            _KINDS[cls] = kind


def origin_of(cls: type) -> Origin | None:
    """Return the origin of a class; None where it is not installed as a plugin."""
    return _ORIGINS.get(cls)


def built_in(plugin: Any) -> bool:
    """Return True if a plugin's class came with driftlab."""
    origin = origin_of(plugin if isinstance(plugin, type) else type(plugin))
    return origin is not None and origin.distribution == HOME


LOADERS: list[Callable[[], None]] = []
"""Functions of the host that load what was not asked for yet: a built-in plugin is loaded where its kind is named."""


def installed() -> tuple[type[Plugin], ...]:
    """Return every class that is installed as a plugin."""
    for load in LOADERS:
        load()
    return tuple(cls for cls in _ORIGINS if issubclass(cls, Plugin))


def kind_default(cls: type[Plugin]) -> str:
    """Return the kind of a class."""
    return str(cls.model_fields["kind"].default)


def plugin_error(plugin: Any, what: str, advice: str = "this is a defect of the plugin") -> PluginError:
    """Return the error of a plugin, its class, or what it made, by name: `acme_gp (driftlab-acme 0.1.0): ...`."""
    cls = plugin if isinstance(plugin, type) else type(plugin)
    record = getattr(plugin, "record", None)
    named = getattr(record or plugin, "kind", None) or _KINDS.get(cls, cls.__name__)
    kind = str(kind_default(cls) if plugin is cls else named)
    origin = origin_of(cls)
    title = f"{kind} ({origin.distribution} {origin.version})" if origin and origin.distribution else kind
    return PluginError(f"{title}: {what}; {advice}", plugin=kind, family=origin.family if origin else None)


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
