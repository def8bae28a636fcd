"""The boundary between the program and its plugins: one wrapper about each method that a contract declares.

What goes in cannot be written to; what is raised is reported as one line by the plugin's name; what comes out is
checked. Errors of `fusion_core.errors` are meant for the user and pass as they are.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property, wraps
from typing import Any, NoReturn

import numpy as np

from fusion_core.chunk import read_only
from fusion_core.contracts import Plugin
from fusion_core.contracts.families import PARTS
from fusion_core.contracts.plugin import Check, Family, Origin, built_in, claim, origin_of, plugin_error
from fusion_core.errors import FusionError, describe_error

WRITERS = ("save", "export")  # a full disk is no defect of theirs


@contextmanager
def guarded(plugin: Any, what: str) -> Iterator[None]:
    """Turn whatever a plugin raises into a PluginError that names it and what it was doing."""
    try:
        yield
    except (FusionError, KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:
        _raise(plugin, what, error)


def guard(cls: type[Plugin], family: Family, origin: Origin) -> None:
    """Put the boundary about what the class defines of its family's contract."""
    claim(cls, origin)
    declared = [base for base in family.contract.__mro__ if base not in Plugin.__mro__]
    names = {name for base in declared for name in vars(base) if not name.startswith("_")} | family.answers.keys()
    _guard(cls, {name: family.answers.get(name) for name in names}, family.contract)


def _guard(cls: type, checks: Mapping[str, Check | None], contract: type) -> None:
    for name in sorted(checks):
        member = inspect.getattr_static(cls, name, None)
        if member is None or member is inspect.getattr_static(contract, name, None):
            continue  # the contract's member default: what it calls is guarded
        wrapped = _wrapped(member, name, checks[name])
        if wrapped is not None:
            setattr(cls, name, wrapped)


def _wrapped(member: Any, name: str, check: Check | None) -> Any:
    """Return a method or property with the boundary about it; None where there is none to put."""
    if inspect.isfunction(member):
        return None if hasattr(member, "__guarded__") else _call(member, name, check)
    if isinstance(member, property) and not hasattr(member.fget, "__guarded__"):
        return member.fget and property(_call(member.fget, name, check), doc=member.__doc__)
    if isinstance(member, cached_property) and not hasattr(member.func, "__guarded__"):
        cached: cached_property[Any] = cached_property(_call(member.func, name, check))
        cached.__set_name__(None, name)  # type: ignore[arg-type]
        return cached
    return None


def _call(method: Callable[..., Any], name: str, check: Check | None) -> Callable[..., Any]:
    @wraps(method)
    def call(self: Any, *given: Any, **named: Any) -> Any:
        given = tuple([read_only(a) if isinstance(a, np.ndarray) else a for a in given])
        named = named and {key: read_only(a) if isinstance(a, np.ndarray) else a for key, a in named.items()}
        try:
            answer = method(self, *given, **named)
            if isinstance(answer, (tuple, np.ndarray)):  # nearly always; the look at a class of an ABC takes long
                pass
            elif isinstance(answer, Iterator):
                answer = _one_by_one(self, name, answer)
            elif isinstance(answer, tuple(PARTS)):
                _guard_part(type(answer), self)
        except (FusionError, KeyboardInterrupt, GeneratorExit):
            raise
        except BaseException as error:
            _raise(self, name, error)
        return answer if check is None else check(self, answer, *given, **named)

    call.__guarded__ = True  # type: ignore[attr-defined]
    return call


def _one_by_one(plugin: Any, name: str, answer: Any) -> Iterator[Any]:
    with guarded(plugin, name):
        yield from answer


def _guard_part(cls: type, maker: Any) -> None:
    """Put the boundary about a fitted map or a detector, which is of the one who made or read it."""
    origin = origin_of(type(maker))
    contract = next(base for base in PARTS if issubclass(cls, base))
    if origin_of(cls) is None and origin is not None and cls.__module__ != contract.__module__:
        claim(cls, origin, maker.kind)
        _guard(cls, {**PARTS[contract], "save": None, "start": None}, contract)


def _raise(plugin: Any, what: str, error: BaseException) -> NoReturn:
    """Raise what stands for an error of a plugin."""
    ours = built_in(plugin)
    if isinstance(error, OSError) and (ours or what in WRITERS):
        raise error
    text = f"{what.lstrip('_')}: {describe_error(error)}"
    advice = "this is a defect of the built-in plugin, report it" if ours else "mend or remove the plugin"
    if isinstance(error, ValueError) and "read-only" in str(error):
        advice = "what a plugin is given is shared, copy it before you write to it"
    raise plugin_error(plugin, text, advice) from error
