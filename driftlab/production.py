"""The production line as a function: `driftlab.fleet`."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from driftlab.arguments import ConfigLike, as_function, config_of

if TYPE_CHECKING:
    from driftlab.fleets.progress import Progress
    from driftlab.fleets.result import FleetResult


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
    progress: Progress | None = None,
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
    from driftlab.fleets.job import Wanted
    from driftlab.fleets.job import fleet as job

    wanted = Wanted(workers, scheduler, explain, tuple(pages), None if family is None else Path(family), force)
    return job(config_of(config).tracking(channel), str(units), Path(out), wanted, progress)
