"""What a program may give to the API: a config, and recordings, in the forms that they have there."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from driftlab.config import Config, load_config, products, understood, with_recording
from driftlab.jobs.simulate import SimulateResult
from driftlab.storage.in_memory import InMemoryName, in_memory_name
from fusion_core.contracts import Source
from fusion_core.errors import ConfigError, FusionError, shown
from fusion_core.host.config import document_of

ConfigLike = Config | Mapping[str, Any] | str | PathLike[str]
DataLike = Any  # a path, a mapping of names to arrays, a data frame, a Chunk, a Source, or what `simulate` gives

TRUTH = "bias_truth"  # what is simulated and no unit measures
OPTIONS = {"input": "data", "select": "neurons", "set": "settings", "unit": "units"}  # where an argument's name differs
OPTION = re.compile(r"(?<![\w-])--([a-z][a-z-]*)( (?=')|\b)")

ALIASES = {"File": "str | PathLike | None", "Units": "Mapping | None", "Progress": "Callable | None"}


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
        return f"{name}{'=' if option[2] else ''}" if name in known else option[0]

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
    bare = ALIASES.get(annotation.removesuffix(" | None"), annotation)
    while "[" in bare:
        bare = re.sub(r"\[[^\[\]]*\]", "", bare)
    words = bare.split(" | ")
    if not set(words) <= set(FORMS) or any(FORMS[word][1](value) for word in words):
        return
    expected = " or ".join(dict.fromkeys(FORMS[word][0] for word in words))
    try:
        written = repr(value)
    except Exception:  # whatever a stranger's object, or an integer of 5,000 digits, makes of it
        written = "what cannot be written down"
    raise ConfigError(f"{name}: is {shown(written)}, of type {type(value).__name__}; give {expected}")


def config_of(given: ConfigLike) -> Config:
    """Return a config; a text of several lines, or with a colon and a space in it, is YAML, any other is a path.

    Raises
    ------
    ConfigError
        With one line for each thing that is wrong.
    """
    if isinstance(given, Config):
        return given
    if isinstance(given, Mapping) or (isinstance(given, str) and _is_yaml(given)):
        return understood(document_of(given, products()))
    if isinstance(given, str | PathLike):
        return load_config(Path(given))
    raise ConfigError(
        f"config: is a {type(given).__name__}, a path, YAML text, a dict or a Config was expected; write e.g. "
        "'extends: mems_crs05'"
    )


def _is_yaml(text: str) -> bool:
    return "\n" in text or ": " in text


def files_of(given: ConfigLike) -> list[Path]:
    """Return the file that a config is read from, if it is."""
    plain = isinstance(given, PathLike) or (isinstance(given, str) and not _is_yaml(given))
    return [Path(given)] if plain else []  # type: ignore[arg-type]


def stem_of(given: ConfigLike) -> str:
    """Return what a config is called: its file's name without the ending, or nothing."""
    return next((path.stem for path in files_of(given)), "")


def recording_of(data: DataLike, units: Mapping[str, str] | None = None, title: str = "data") -> str:
    """Return the name of a recording: of a file (`PATH` or `PATH::START:STOP`), or of what is held in memory.

    Raises
    ------
    ConfigError, UnitError, DataError
        As `driftlab.storage.in_memory.held`.
    """
    if isinstance(data, str | PathLike | Source):
        if units:
            raise ConfigError(f"units: are given with {shown(data, 200)}, which says them itself; leave units out")
        return InMemoryName(data) if isinstance(data, Source) else str(data)
    if isinstance(data, SimulateResult):
        known = {name: unit for name, unit in data.units.items() if isinstance(unit, str)}
        measured = {name: (values, known[name]) for name, values in data.items() if name != TRUTH}
        return InMemoryName(in_memory_name(measured, units, data.name))
    return InMemoryName(in_memory_name(data, units, title))


def recordings_of(data: DataLike, units: Mapping[str, str] | None, title: str) -> list[str]:
    """Return one recording, or each of a list of them."""
    if isinstance(data, list | tuple):
        return [recording_of(item, units, f"{title}[{k}]") for k, item in enumerate(data)]
    return [recording_of(data, units, title)]


def understood_with(config: ConfigLike, data: DataLike | None, units: Mapping[str, str] | None) -> Config:
    """Return the config with the recording that is given, if one is, as its source."""
    loaded = config_of(config)
    if data is None:
        if units:
            raise ConfigError("units: are given without data; give the data that they are of")
        return loaded
    return with_recording(loaded, recording_of(data, units))


def named(configs: Mapping[str, ConfigLike] | Sequence[ConfigLike]) -> dict[str, ConfigLike]:
    """Return configs by name: those of a list by their files' stems, or by their paths where two have the same.

    Raises
    ------
    ConfigError
        If one is given twice, or has no name.
    """
    if isinstance(configs, Mapping):
        return dict(configs)
    stems = [stem_of(config) for config in configs]
    if not all(stems):
        raise ConfigError('configs: one of them is no file and has no name; write {"name": config, ...}')
    names = stems if len(set(stems)) == len(stems) else [str(config) for config in configs]
    if len(set(names)) < len(names):
        raise ConfigError("a config is named twice; name different ones")
    return dict(zip(names, configs, strict=True))
