"""Configs and recordings in the forms in which a program may give them to a command."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from driftlab.commands.result import Result
from driftlab.config import Config, load_config, products, understood, with_recording
from driftlab.storage.in_memory import InMemoryName, in_memory_name
from fusion_core.contracts import Source
from fusion_core.errors import ConfigError, quote
from fusion_core.host.config import document_of

Place = str | PathLike[str]  # a file or a folder
ConfigLike = Config | Mapping[str, Any] | str | PathLike[str]
DataLike = Any  # a path, a mapping of names to arrays, a data frame, a Chunk, a Source, or what `simulate` gives
Units = Mapping[str, str]  # of the channels that have none in the data
Progress = Callable[..., None]  # with the time in s and a count, or with a text: what is done now

TRUTH = "bias_truth"  # what is simulated and no unit measures


def config_of(given: ConfigLike, *, measuring: bool = False) -> Config:
    """Return a config; a text of several lines, or with a colon and a space in it, is YAML, any other is a path.

    Where noise is what is measured (`measuring`), it need not be declared.

    Raises
    ------
    ConfigError
        With one line for each thing that is wrong.
    """
    if isinstance(given, Config):
        return given
    if is_file(given):
        return load_config(Path(given), measuring=measuring)  # type: ignore[arg-type]
    if isinstance(given, Mapping | str):
        return understood(document_of(given, products()), measuring=measuring)
    raise ConfigError(
        f"config: is a {type(given).__name__}, a path, YAML text, a dict or a Config was expected; write e.g. "
        "'extends: mems_crs05'"
    )


def is_file(given: object) -> bool:
    """Tell whether a config is given as the file that it is read from, and not as text in YAML."""
    return isinstance(given, PathLike) or (isinstance(given, str) and "\n" not in given and ": " not in given)


def recording_of(data: DataLike, units: Units | None = None, title: str = "data") -> str:
    """Return the name of a recording: of a file (`PATH` or `PATH::START:STOP`), or of what is held in memory.

    Raises
    ------
    ConfigError, UnitError, DataError
        As `driftlab.storage.in_memory.held`.
    """
    if isinstance(data, str | PathLike | Source):
        if units:
            raise ConfigError(f"units: are given with {quote(data, 200)}, which says them itself; leave units out")
        return InMemoryName(data) if isinstance(data, Source) else data if isinstance(data, str) else str(data)
    if isinstance(data, Result):
        title, known = data.name, data.units
        measured = {name: values for name, values in data.items() if name != TRUTH}
        data = {name: (values, known[name]) if name in known else values for name, values in measured.items()}
    return InMemoryName(in_memory_name(data, units, title))


def recordings_of(data: DataLike, units: Units | None, title: str) -> list[str]:
    """Return one recording, or each of a list of them."""
    if isinstance(data, list | tuple):
        return [recording_of(item, units, f"{title}[{k}]") for k, item in enumerate(data)]
    return [recording_of(data, units, title)]


def config_with(config: ConfigLike, data: DataLike | None, units: Units | None, *, measuring: bool = False) -> Config:
    """Return the config with the recording that is given, if one is, as its source; raises as `config_of`."""
    loaded = config_of(config, measuring=measuring)
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
    if not all(map(is_file, configs)):
        raise ConfigError('configs: one of them is no file and has no name; write {"name": config, ...}')
    paths = [Path(config) for config in configs]  # type: ignore[arg-type]
    stems = [path.stem for path in paths]
    names = stems if len(set(stems)) == len(stems) else list(map(str, paths))
    if len(set(names)) < len(names):
        raise ConfigError("a config is named twice; name different ones")
    return dict(zip(names, configs, strict=True))
