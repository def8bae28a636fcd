"""The commands as functions that read and write the files of others: `init`, `export`, `import_map`.

They are part of `driftlab.api`, whose conventions they have.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.arguments import ConfigLike, as_function, config_of, files_of

if TYPE_CHECKING:
    from driftlab.jobs.fit_map import FitMapResult
    from driftlab.jobs.import_calibration import Imported
    from driftlab.jobs.init import FirstConfig
    from fusion_core.contracts import Loss

File = str | PathLike[str]


@as_function
def init(file: File, *, units: Mapping[str, str] | None = None, out: File | None = None) -> FirstConfig:
    """Guess a first config of a recording.

    Parameters
    ----------
    file : path
        Of a kind that an installed source reads, or the bytes of a device.
    units : mapping of str to str, optional
        Of channels, where they are known: `{"gyro": "deg/s"}`.
    out : path, optional
        The config. Nothing is written where it is left out.

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
    from driftlab.jobs import init as job

    return job.first_config(Path(file), units) if out is None else job.init(Path(file), Path(out), units)


@as_function
def export(
    kind: str,
    what: ConfigLike | FitMapResult,
    out: File,
    *,
    settings: Mapping[str, Any] | None = None,
    run: File | None = None,
    force: bool = False,
) -> Loss:
    """Write a calibration in the form of another program or a vehicle.

    Parameters
    ----------
    kind : str
        Of the exporter: `px4`, `ardupilot`, `c`, `kalibr`, `openvins`, `mat`, `csv_table`, or one of a plugin.
    what : path of a map's file, config, or FitMapResult
        A config's maps are exported with its effects and noise.
    out : path
        The file, or the folder of `c`; `loss.json` is written beside the file, or in the folder.
    settings : mapping, optional
        Of the exporter, as `--set`: `{"flies_from": "20 degC"}`.
    run : path, optional
        The folder of a run: noise and walk as its innovations say.
    force : bool
        Whether to replace the file.

    Returns
    -------
    Loss
        `lines()` says what is lost, `sensors` has it in numbers, measured in the target's own arithmetic.

    Raises
    ------
    ConfigError, MapError
        If the target could not use it, a setting is wrong, or a file is in the way.
    """
    from driftlab.jobs import export as job
    from driftlab.jobs.fit_map import FitMapResult
    from driftlab.jobs.inflation import with_inflation

    exporter = job.exporter_of(kind, {name: str(value) for name, value in (settings or {}).items()})
    read = [] if isinstance(what, FitMapResult) else files_of(what)
    if isinstance(what, FitMapResult):
        found = job.of_map(what.map)
    else:
        found = job.read_export(read[0]) if read else job.of_config(config_of(what))
    if run is not None:
        found = with_inflation(found, Path(run))
    return job.export(exporter, found, Path(out), force=force, read=read)


@as_function
def import_map(
    kind: str,
    file: File,
    out: File,
    *,
    map_kind: str = "polynomial",
    channel: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Imported:
    """Write the thermal calibration that a vehicle has today as a map: `driftlab import`.

    Parameters
    ----------
    kind : str
        `px4`, `ardupilot`, or one of a plugin that reads its form back.
    file : path
        The vehicle's parameters, as a ground station saves them.
    out : path
        The map's file.
    map_kind : str
        Kind of map.
    channel : str, optional
        Of which sensor; the first that is corrected where it is left out.
    settings : mapping, optional
        Of the form, as `--set`: `{"instance": 1}`.

    Returns
    -------
    Imported
        `map` (`bias(T)`, `domain`), and `apart` (d,), how far it is from the file at most, SI.

    Raises
    ------
    ConfigError, DataError
        If the file holds no calibration that is in use, or cannot be read.
    """
    from driftlab.jobs import export as job
    from driftlab.jobs.import_calibration import import_to_file

    exporter = job.exporter_of(kind, {name: str(value) for name, value in (settings or {}).items()})
    return import_to_file(exporter, Path(file), Path(out), kind=map_kind, channel=channel)
