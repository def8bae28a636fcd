"""A first config of a file that is new: `driftlab init`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from driftlab.commands.console import say, say_lines
from driftlab.commands.inputs import Place
from driftlab.starter import config_text
from driftlab.starter.columns import FIELDS, SENSORS, channels_in, channels_of, noise_of_column
from driftlab.starter.config_text import Starter
from driftlab.starter.reading import HEAD, FileColumns, beginning, columns_of, file_sources, framing_of, nothing_reads, samples_of
from driftlab.storage.recorder import written_units
from fusion_core.budget import check_all, of_all
from fusion_core.contracts import Channel
from fusion_core.errors import ConfigError, DataError, FusionError, MissingChannel, Unwritable
from fusion_core.thermal.map_file import write_whole


@dataclass(frozen=True)
class FirstConfig:
    """The text of a config, what it leaves to be filled in, and where it was written, if it was."""

    text: str
    asked: tuple[str, ...]
    path: Path | None = None


def init(file: Place, *, out: Place | None = None, units: Mapping[str, str] | None = None) -> FirstConfig:
    """Write a first config of a file, with every guess marked.

    It has the source, channels, units and noise. FILE is a log of PX4 (.ulg) or ArduPilot (.bin), a ROS bag,
    CSV (.csv.gz too), HDF5, NetCDF, MATLAB's .mat, Parquet, or the bytes of a device that an installed framing knows.
    Values without a guess are left to be filled in.

    Parameters
    ----------
    file : path
        A recording, or the bytes that a device sent.
    out : path, optional
        The config to write; by default FILE's name .yaml.
        A program writes nothing where it is left out.
    units : mapping of str to str, optional
        A unit that you know, e.g. gyro=deg/s; repeatable.
        As `{"gyro": "deg/s"}`.

    Returns
    -------
    FirstConfig
        `text`, YAML with every guess marked, and `asked`, what is left to be filled in.

    Raises
    ------
    ConfigError, UnitError
        If the config is there already, or a unit is wrong.
    DataError
        If nothing reads the file, or it has no channel that is known.
    """
    path, place, known = Path(file), None if out is None else Path(out), units or {}
    if place is not None and os.path.lexists(place):
        raise ConfigError(f"--out {place}: is there already; name another file, or remove it")
    for field, unit in known.items():
        if field not in FIELDS:
            raise ConfigError(f"--unit {field}={unit}: no channel is called so; known: {', '.join(FIELDS)}")
        Channel(path="?", unit=unit).check(field)
    with of_all(path, "finding out what it holds"):
        starter = _guess(path, os.path.relpath(path, Path() if place is None else place.parent), known)
    if place is not None:
        try:
            write_whole(place, starter.text.encode())
        except OSError as error:
            raise Unwritable(f"--out {place}: cannot be written ({error.strerror}); name another place") from None
    return FirstConfig(starter.text, starter.asked, place)


def _guess(file: Path, path: str, units: Mapping[str, str]) -> Starter:
    first, errors = b"" if file.is_dir() else beginning(file, HEAD), list[FusionError]()
    for cls in file_sources(file, first):
        if cls.product is not None:
            return config_text.of_product(path, file.name, cls.product, _map_name(file))
        try:
            columns = columns_of(file, cls, {})
        except DataError as error:
            check_all()
            errors.append(error)
            continue
        return _of_columns(file, path, columns, units)
    frames = None if file.is_dir() else framing_of(file)
    if frames is None:
        raise nothing_reads(file, errors)
    samples = samples_of(file, frames)
    return config_text.of_frames(
        path, file.name, frames, None if samples is None else channels_in(samples), _map_name(file)
    )


def _of_columns(file: Path, path: str, columns: FileColumns, units: Mapping[str, str]) -> Starter:
    written = written_units(file) if columns.kind == "csv" else {}
    channels = channels_of(columns, units, written)
    held = config_text.held_of(columns, channels)
    if held is None and not any(sensor in channels.found for sensor in SENSORS):
        raise MissingChannel(
            f"{file}: no {columns.noun} is called like a gyro or an accelerometer; it has {_listed(columns.names)}; "
            "write a config with the channels' paths, or rename them, as in gyro_x"
        )
    if held is not None and (noise := noise_of_column(columns, held.path, channels.found.get("time"))) is not None:
        channels = replace(channels, noise={held.path: noise})
    return config_text.of_columns(path, file.name, columns, channels, _map_name(file))


def _listed(names: list[str]) -> str:
    return ", ".join(names[:30]) + (f" and {len(names) - 30} more" if len(names) > 30 else "") if names else "none"


def _map_name(file: Path) -> str:
    """Return the name that `fit-map` gives the map of a config that is called as the file."""
    return f"{_stem(file)}.map.json"


def _stem(file: Path) -> str:
    return file.name.split(".")[0] or "unit"


def arguments_of(arguments: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Name the config as the file, in the working directory, where no other place is given."""
    return {"out": Path(f"{_stem(arguments['file'])}.yaml"), **arguments}


def content_of(result: FirstConfig, given: Mapping[str, Any]) -> Any:
    """Return the config's place and text."""
    return {"config": str(result.path), "text": result.text, "to_fill_in": list(result.asked)}


def show(result: FirstConfig, given: Mapping[str, Any]) -> None:
    """Print the config, and what is to be filled in."""
    say(result.text)
    say_lines(result.asked, "fill in: ")
    say(f"written to {result.path}; look at what is guessed, then: driftlab check {result.path}\n")
