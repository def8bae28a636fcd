"""The commands as functions, on files or on arrays in memory.

Each is the command of the same name: it reads the same config, applies the same checks, and gives what the command
would write, as arrays by name. With `out=` it writes that too, under the same rules.

::

    config = path | YAML text | dict | Config
    data   = path | "PATH::START:STOP" | {"time": (t, "s"), "gyro": (omega, "deg/s"), ...} | data frame | Chunk

What is in memory stays there: no file is made. What cannot be used raises `ConfigError`, `UnitError` or `DataError` of
`driftlab.errors`, with the command's message.

The production line as a function: `driftlab.fleet`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.ahead import plan, simulate
from driftlab.arguments import (
    ConfigLike,
    DataLike,
    as_function,
    config_of,
    files_of,
    named,
    recordings_of,
    stem_of,
    understood_with,
)
from driftlab.exchange import export, import_map, init
from driftlab.mapping import fit_map

if TYPE_CHECKING:
    from driftlab.jobs.allan import AllanResult
    from driftlab.jobs.check import CheckResult
    from driftlab.jobs.compare import CompareResult
    from driftlab.jobs.explain_in_memory import ExplainResult
    from driftlab.jobs.run import RunResult
    from driftlab.production.result import FleetResult
    from driftlab.production.summary import FleetProgress

__all__ = [
    "allan",
    "check",
    "compare",
    "explain",
    "export",
    "fit_map",
    "fleet",
    "import_map",
    "init",
    "plan",
    "run",
    "simulate",
]


File = str | PathLike[str] | None
Units = Mapping[str, str] | None
Progress = Callable[..., None] | None


@as_function
def run(
    config: ConfigLike,
    data: DataLike = None,
    *,
    units: Units = None,
    channel: str | None = None,
    out: File = None,
    resume: bool = False,
    force: bool = False,
    smooth: bool = False,
    progress: Progress = None,
) -> RunResult:
    """Run the filter of a config on a recording.

    Parameters
    ----------
    config : path, YAML text, dict or Config
        What the unit is; its `source` says how files are read, arrays need none.
    data : path, mapping, data frame or Chunk, optional
        The recording; the config's own where it is left out. Of a mapping, each value is an array, time first, or a
        pair of an array and its unit.
    units : mapping of str to str, optional
        Units of the channels that have none in `data`.
    channel : str, optional
        The sensor whose bias it is about, as `accel`; the config's where it is left out.
    out : path, optional
        Folder for `estimates.h5`, `summary.json` and `report.html`. Arrays are then read from there.
    resume, force : bool
        As `--resume` and `--force`; of use with `out` alone.
    smooth : bool
        Whether `estimates.h5` also has what is known given all of the recording, as `--smooth`: `smoothed` of the
        result, with `x`, `sigma` (N, n) and `bias` (N, d). It needs `out`.
    progress : callable, optional
        Called with the recording's time in s and the number of updates so far.

    Returns
    -------
    RunResult
        `t` (N,), `bias`, `bias_sigma`, `coast`, `coast_sigma` (N, d), `x`, `sigma` (N, n), `nis` (N,), ... in SI.

    Raises
    ------
    DataError, ConfigError, UnitError
        If the config or the recording cannot be used.
    """
    from driftlab.jobs.run import run as job

    loaded = understood_with(config, data, units).tracking(channel)
    source = loaded.source.name if loaded.source is not None else ""
    title = f"{stem_of(config)}: {source}" if stem_of(config) else source
    how = {"resume": resume, "force": force, "smooth": smooth}
    return job(loaded, _path(out), title=title, progress=progress, read=files_of(config), **how)


@as_function
def allan(
    config: ConfigLike, data: DataLike = None, *, units: Units = None, out: File = None, progress: Progress = None
) -> AllanResult:
    """Fit noise, walk and their kin to the Allan deviation of a recording at rest.

    Parameters
    ----------
    config, data, units, progress : as those of `run`; the config needs no filter
    out : path, optional
        Folder for `allan.json`, `summary.json`, `allan.svg` and `report.html`.

    Returns
    -------
    AllanResult
        `tau` (J,), `gyro`, `gyro_sigma`, `gyro_hadamard` (J, d), `accel` alike; `config_lines` is for a config, and
        `summary` holds the coefficients with their limits.

    Raises
    ------
    DataError, ConfigError, UnitError
        If the recording cannot be used.
    """
    from driftlab.jobs.allan import allan as job

    return job(understood_with(config, data, units), _path(out), progress=progress, read=files_of(config))


@as_function
def compare(
    configs: Mapping[str, ConfigLike] | Sequence[ConfigLike],
    data: DataLike = None,
    *,
    units: Units = None,
    channel: str | None = None,
    out: File = None,
    progress: Progress = None,
) -> CompareResult:
    """Compare configs on one recording: the paper's tables 5 to 12, and how each coasts.

    Parameters
    ----------
    configs : mapping of str to config, or sequence of paths
        Two or more, by the names that they have in tables.
    data, units, channel
        As those of `run`.
    out : path, optional
        Folder for `summary.json` and `report.html`.
    progress : callable, optional
        Called with texts.

    Returns
    -------
    CompareResult
        What each config came to, by name; `to_polars()` gives the tables.

    Raises
    ------
    DataError, ConfigError, UnitError
        If a config cannot be run on the recording, or the recordings differ.
    """
    from driftlab.jobs.compare import compare as job

    given = named(configs)
    loaded = {name: understood_with(config, data, units).tracking(channel) for name, config in given.items()}
    read = [path for config in given.values() for path in files_of(config)]
    return job(loaded, _path(out), progress=progress, read=read)


@as_function
def explain(
    config: ConfigLike,
    calibration: DataLike,
    train: DataLike,
    holdout: DataLike,
    *,
    units: Units = None,
    channel: str | None = None,
    estimate: bool = False,
    without: Sequence[str] = (),
    out: File = None,
    progress: Callable[[str], None] | None = None,
) -> ExplainResult:
    """Find what the declared model lacks, add it, and measure the error before and after on recordings not seen.

    Parameters
    ----------
    config : path, YAML text, dict or Config
        The declared model.
    calibration, train, holdout : as the `data` of `run`, or lists of them
        Recordings at rest: those that the map is fitted on, those that effects are found on, and those to judge by.
        What is in memory is told apart by the hash of its samples; parts that overlap are not.
    units, channel
        As those of `run`.
    estimate : bool
        Whether the effects go on being estimated by the filter of the new config.
    without : sequence of str
        Kinds of effects that are not to be tried.
    out : path, optional
        Folder for `loop.json`, `explained.yaml`, the maps, `prediction.h5` and `report.html`.
    progress : callable, optional
        Called with a text.

    Returns
    -------
    ExplainResult
        `verdict`, `config` (the new one), and `t` (N,), `reference`, `before`, `after` (N, d) of the holdout.

    Raises
    ------
    DataError, ConfigError, UnitError
        If the config or a recording cannot be used.
    """
    from driftlab.jobs.explain_in_memory import explained

    roles = {"calibration": calibration, "train": train, "holdout": holdout}
    recordings = {role: recordings_of(data, units, role) for role, data in roles.items()}
    loaded = config_of(config).tracking(channel)
    how: dict[str, Any] = {"estimate": estimate, "without": without, "read": files_of(config)}
    return explained(loaded, recordings, _path(out), progress, **how)


@as_function
def check(config: ConfigLike, data: DataLike = None, *, units: Units = None) -> CheckResult:
    """Check a config, its maps and the head of its recording.

    Parameters
    ----------
    config, data, units : as those of `run`

    Returns
    -------
    Checked
        `config` as it is understood, `quantities` by their place, and `remarks`.
    """
    from driftlab.jobs.check import check as job

    return job(understood_with(config, data, units))


def _path(out: File) -> Path | None:
    return None if out is None else Path(out)


@as_function
def fleet(
    config: ConfigLike,
    units: str | PathLike[str],
    out: str | PathLike[str],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    explain: bool = False,
    pages: Sequence[str] = (),
    family: str | PathLike[str] | None = None,
    force: bool = False,
    channel: str | None = None,
    progress: FleetProgress | None = None,
) -> FleetResult:
    """Calibrate the units of a line, find the odd ones, and learn their family.

    Parameters
    ----------
    config : path, YAML text, dict or Config
        Of every unit.
    units : str or path
        A manifest, or a pattern of file names.
    out : path
        The fleet's folder; what is done there is not done again.
    workers, scheduler, explain, force
        As the command's options of these names.
    pages : sequence of str
        Names or patterns of units whose pages are written; `all`.
    family : path, optional
        A `family.json`: none is fitted.
    channel : str, optional
        As that of `run`.
    progress : callable, optional
        Called with the `Stage` that goes on: `name`, `total`, `done`, `failed`, `text()`.

    Returns
    -------
    FleetResult
        Of the units that are done `unit`, `odd` (U,), `noise`, `walk`, `coast` (U, d), ...; `to_polars()` is the table.

    Raises
    ------
    DataError, ConfigError, UnitError
        If all units failed, or the config or the manifest cannot be used.
    """
    from driftlab.production.fleet import FleetOptions
    from driftlab.production.fleet import fleet as job

    wanted = FleetOptions(workers, scheduler, explain, tuple(pages), None if family is None else Path(family), force)
    return job(config_of(config).tracking(channel), str(units), Path(out), wanted, progress)
