"""A first config of a file that is new: `driftlab init`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from driftlab.starter import config_text
from driftlab.starter.columns import FIELDS, SENSORS, channels_in, channels_of, noise_of_column
from driftlab.starter.config_text import Starter
from driftlab.starter.reading import FileColumns, columns_of, file_sources, framing_of, nothing_reads, samples_of
from driftlab.storage.recorder import written_units
from fusion_core.budget import check_all, of_all
from fusion_core.contracts import Channel, head
from fusion_core.errors import ConfigError, DataError, FusionError, MissingChannel, Unwritable
from fusion_core.thermal.map_file import write_whole


@dataclass(frozen=True)
class FirstConfig:
    """What a config says, what it leaves to be filled in, and where it was written, if it was."""

    text: str
    asked: tuple[str, ...]
    path: Path | None = None


def init(file: Path, out: Path | None = None, units: Mapping[str, str] | None = None) -> FirstConfig:
    """Write a starter config of a file.

    Parameters
    ----------
    file : Path
    out : Path, optional
        The config; by default in the working directory, called as the file.
    units : mapping of str to str, optional
        Of channels, where they are known.

    Raises
    ------
    ConfigError
        If the config is there already, or a unit is wrong.
    DataError
        If nothing reads the file, or it has no channel that is known.
    """
    out = Path(f"{file.name.split('.')[0] or 'unit'}.yaml") if out is None else out
    if os.path.lexists(out):
        raise ConfigError(f"--out {out}: is there already; name another file, or remove it")
    found = first_config(file, units, out.parent)
    try:
        write_whole(out, found.text.encode())
    except OSError as error:
        raise Unwritable(f"--out {out}: cannot be written ({error.strerror}); name another place") from None
    return replace(found, path=out)


def first_config(file: Path, units: Mapping[str, str] | None = None, folder: Path = Path()) -> FirstConfig:
    """Return the starter config of a file for a folder; raises as `init`."""
    units = units or {}
    for field, unit in units.items():
        if field not in FIELDS:
            raise ConfigError(f"--unit {field}={unit}: no channel is called so; known: {', '.join(FIELDS)}")
        Channel(path="?", unit=unit).check(field)
    found = _starter(file, os.path.relpath(file, folder), units)
    return FirstConfig(found.text, found.asked)


def _starter(file: Path, path: str, units: Mapping[str, str]) -> Starter:
    with of_all(file, "finding out what it holds"):
        return _guessed(file, path, units)


def _guessed(file: Path, path: str, units: Mapping[str, str]) -> Starter:
    first, errors = b"" if file.is_dir() else head(file), list[FusionError]()
    for cls in file_sources(file, first):
        if cls.product is not None:
            return config_text.of_product(path, file.name, cls.product, _map_name(file))
        try:
            columns = columns_of(file, cls)
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
    if held is not None and (noise := noise_of_column(columns, held, channels.found.get("time"))) is not None:
        channels = replace(channels, noise={held: noise})
    return config_text.of_columns(path, file.name, columns, channels, _map_name(file))


def _listed(names: list[str]) -> str:
    return ", ".join(names[:30]) + (f" and {len(names) - 30} more" if len(names) > 30 else "") if names else "none"


def _map_name(file: Path) -> str:
    """Return what `fit-map` calls the map of a config that is called as the file."""
    return f"{file.name.split('.')[0] or 'unit'}.map.json"
