"""The commands as functions, on files or on arrays in memory.

Each is the command of the same name: it reads the same config, applies the same checks, and gives what the command
would write, as arrays by name. With `out=` it writes that too, under the same rules.

::

    config = path | YAML text | dict | Config
    data   = path | "PATH::START:STOP" | {"time": (t, "s"), "gyro": (omega, "deg/s"), ...} | data frame | Chunk

What is in memory stays there: no file is made. What cannot be used raises `ConfigError`, `UnitError` or `DataError` of
`driftlab.errors`, with the command's message.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from numbers import Integral, Real
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeVar

from driftlab.commands.inputs import ConfigLike, DataLike, Place, Progress, Units
from driftlab.config import Config
from fusion_core.errors import ConfigError, FusionError, quote

if TYPE_CHECKING:
    from driftlab.commands.allan import allan
    from driftlab.commands.check import check
    from driftlab.commands.compare import compare
    from driftlab.commands.explain import explain
    from driftlab.commands.export import export
    from driftlab.commands.fit_map import fit_map
    from driftlab.commands.import_map import import_map
    from driftlab.commands.init import init
    from driftlab.commands.plan import plan
    from driftlab.commands.run import run
    from driftlab.commands.simulate import simulate
    from driftlab.commands.vehicle import vehicle
    from driftlab.production.fleet import fleet

__all__ = [
    "ConfigLike", "DataLike", "Place", "Progress", "Units",
    "allan", "check", "compare", "explain", "export", "fit_map", "fleet", "import_map", "init", "plan", "run",
    "simulate", "vehicle",
]  # fmt: skip

OPTIONS = {"input": "data", "select": "neurons", "set": "settings", "unit": "units"}  # where an argument's name differs
OPTION = re.compile(r"(?<![\w-])--([a-z][a-z-]*)(?: '([\w.-]+)=([^']+)'|( (?=')|\b))")
ALIASES = {"Place": "str | PathLike", "Units": "Mapping", "Progress": "Callable"}


def __getattr__(name: str) -> Any:
    """Import the function of a command when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'driftlab.api' has no attribute '{name}'")
    module = "driftlab.production.fleet" if name == "fleet" else f"driftlab.commands.{name}"
    function = globals()[name] = as_function(getattr(import_module(module), name))
    return function


def _is_known(item: object) -> bool:
    return isinstance(item, str | PathLike | Mapping | Config)


FORMS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "str": ("a text", lambda given: isinstance(given, str)),
    "PathLike": ("a path", lambda given: isinstance(given, PathLike) and isinstance(given.__fspath__(), str)),
    "bool": ("True or False", lambda given: type(given).__name__ in ("bool", "bool_")),  # NumPy's too
    "int": ("a whole number", lambda given: isinstance(given, Integral) and not isinstance(given, bool)),
    "range": ("a range", lambda given: isinstance(given, range)),
    "tuple": ("two numbers", lambda given: isinstance(given, tuple) and [isinstance(v, Real) for v in given] == [1, 1]),
    "Mapping": ("a dict", lambda given: isinstance(given, Mapping) and all(isinstance(name, str) for name in given)),
    "Sequence": (
        "a list of texts or paths",
        lambda given: isinstance(given, Sequence | set | frozenset) and all(map(_is_known, given)),
    ),
    "Callable": ("a function", callable),
    "None": ("None", lambda given: given is None),
}  # fmt: skip  # by the names in the signatures of the API; what is not here is checked where it is read

Function = TypeVar("Function", bound=Callable[..., Any])


def as_function(function: Function) -> Function:
    """Return a function of the API whose errors speak of its arguments, where the command's speak of options."""
    signature = inspect.signature(function)
    known = signature.parameters

    def argument(option: re.Match[str]) -> str:
        name = option[1].replace("-", "_")
        name = name if name in known else OPTIONS.get(name, "")
        if name in known and option[2]:
            mapping = re.search("Mapping|Units", str(known[name].annotation))
            return f"{name}=" + (f"{{{option[2]!r}: {option[3]!r}}}" if mapping else f"'{option[2]}={option[3]}'")
        return f"{name}{'=' if option[4] else ''}" if name in known else option[0]

    @wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        try:
            for name, value in signature.bind(*given, **named).arguments.items():
                _check_form(name, value, str(known[name].annotation))
            return function(*given, **named)
        except FusionError as error:
            text = OPTION.sub(argument, str(error)).replace("the command line", "the call")
            error.args = (text, *error.args[1:])
            raise

    return call  # type: ignore[return-value]


def _check_form(name: str, value: Any, annotation: str) -> None:
    """Raise ConfigError, with the argument's name, where a value has none of the forms of its annotation."""
    if isinstance(value, str | PathLike) and "\0" in str(value):
        raise ConfigError(f"{name}: has a NUL character, which no text or path has; leave it out")
    while "[" in annotation:
        annotation = re.sub(r"\[[^\[\]]*\]", "", annotation)
    words = " | ".join(ALIASES.get(word, word) for word in annotation.split(" | ")).split(" | ")
    if not set(words) <= set(FORMS) or any(FORMS[word][1](value) for word in words):
        return
    expected = " or ".join(dict.fromkeys(FORMS[word][0] for word in words))
    try:
        written = repr(value)
    except Exception:  # whatever a stranger's object, or an integer of 5,000 digits, makes of it
        written = "what cannot be written down"
    raise ConfigError(f"{name}: is {quote(written)}, of type {type(value).__name__}; give {expected}")
