"""What a class needs to be a plugin: a whole class of its family, with a kind, for a config to hold."""

from __future__ import annotations

import inspect
from contextvars import ContextVar
from typing import Any, Literal, get_args, get_origin

from pydantic import ConfigDict

from fusion_core.contracts.family import Family
from fusion_core.contracts.plugin import Plugin
from fusion_core.errors import PluginError, shown

alone: ContextVar[bool] = ContextVar("alone", default=False)  # a class is looked at without the plugins within it


def check_class(family: Family, plugin: Any) -> None:
    """Raise PluginError where something is not a whole class of the family, or was written for another contract."""
    name = family.contract.__name__
    if not (isinstance(plugin, type) and issubclass(plugin, family.contract)):
        raise PluginError(
            f"{shown(repr(plugin))} is not a {name}; the hook {family.name}() returns a list of such classes"
        )
    if inspect.isabstract(plugin):
        missing = ", ".join(sorted(plugin.__abstractmethods__))
        raise PluginError(f"{plugin.__name__} does not define {missing}, which every {name} must")
    own = plugin.__mro__[: plugin.__mro__.index(family.contract)]
    written = next((vars(base)["contract"] for base in own if "contract" in vars(base)), 1)
    if written != family.contract.contract:
        raise PluginError(
            f"{plugin.__name__} was written for version {shown(written)} of the contract {name}, version "
            f"{family.contract.contract} is spoken here; install a release of the plugin for it"
        )


def kind_of(plugin: type[Plugin]) -> str:
    """Return the name under which a config asks for the plugin: the literal type of its field `kind`."""
    annotation = plugin.model_fields["kind"].annotation
    if get_origin(annotation) is Literal and len(get_args(annotation)) == 1:
        return str(get_args(annotation)[0])
    raise PluginError(f'{plugin.__name__} has no kind; declare `kind: Literal["my_kind"] = "my_kind"`')


def check_fields(plugin: type[Plugin]) -> None:
    """Raise PluginError where a config or its JSON schema cannot be made of the class: it has a field of no known type.

    Classes are built at first use. This builds another in its place, whose fields for plugins accept anything.
    """
    token = alone.set(True)
    try:
        body = {"__module__": plugin.__module__, "model_config": ConfigDict(defer_build=False)}
        make: Any = type(plugin)
        stand_in = make(plugin.__name__, (plugin,), body)
        stand_in.model_rebuild(raise_errors=True)
        stand_in.model_json_schema()
    except Exception as error:
        first = str(error).splitlines()[0].partition(". ")[0]
        raise PluginError(
            f"{plugin.__name__}: no config can hold it ({shown(first, 200)}); correct its fields"
        ) from None
    finally:
        alone.reset(token)
