"""The thermal map of a unit as a function: `fit_map`, on its own soak or with its family.

It is part of `driftlab.api`, whose conventions it has.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from driftlab.arguments import ConfigLike, DataLike, as_function, config_of, files_of, recordings_of

if TYPE_CHECKING:
    from driftlab.jobs.family_map import FamilyMapResult
    from driftlab.jobs.fit_map import FitMapResult

File = str | PathLike[str]
Units = Mapping[str, str] | None
Progress = Callable[..., None] | None


@overload
def fit_map(
    config: ConfigLike,
    data: DataLike = None,
    *,
    units: Units = None,
    channel: str | None = None,
    kind: str | None = None,
    neurons: range | None = None,
    compare: bool = False,
    family: None = None,
    lot: None = None,
    out: File | None = None,
    report: File | None = None,
    progress: Progress = None,
) -> FitMapResult: ...
@overload
def fit_map(
    config: ConfigLike,
    data: DataLike = None,
    *,
    units: Units = None,
    channel: str | None = None,
    family: File,
    lot: str | None = None,
    out: File | None = None,
    progress: Progress = None,
) -> FamilyMapResult: ...
@as_function
def fit_map(
    config: ConfigLike,
    data: DataLike = None,
    *,
    units: Units = None,
    channel: str | None = None,
    kind: str | None = None,
    neurons: range | None = None,
    compare: bool = False,
    family: File | None = None,
    lot: str | None = None,
    out: File | None = None,
    report: File | None = None,
    progress: Progress = None,
) -> FitMapResult | FamilyMapResult:
    """Fit a thermal map on one or more recordings at rest.

    Parameters
    ----------
    config, units, channel
        As those of `run`.
    data : as that of `run`, or a list of them
        The soak.
    kind : str, optional
        Of the map, in place of the config's.
    neurons : range, optional
        Sizes of a network to choose from, as `--select`.
    compare : bool
        Whether to choose among all installed kinds, as `--compare`.
    family : path, optional
        `family.json` of a fleet: then a part of its range is soak enough.
    lot : str, optional
        Of the unit, where `family` knows lots.
    out : path, optional
        The map's file. Nothing is written where it is left out, also if the config names a path.
    report : path, optional
        Folder for `report.html`, `select.json` and `select.svg`, with `out`; beside the map where it is left out.
    progress : callable, optional
        Called with time in s and the number of samples so far, then with texts.

    Returns
    -------
    FitMapResult
        `temperature` (N,), `bias`, `slope`, `sigma` (N, d) over the map's domain; `map` is the map itself.
    FamilyMapResult
        With `family`: `temperature` (N,), `bias`, `sigma`, `own_bias`, `own_sigma` (N, d) over the family's domain.

    Raises
    ------
    DataError, ConfigError, UnitError
        If a recording cannot be used, its temperature moves too little, or the config names no map.
    MapError
        If the family is of another sensor.
    """
    from driftlab.jobs.fit_map import fit_map as job
    from driftlab.jobs.fit_map import fit_map_to_file, with_family

    loaded = config_of(config).tracking(channel)
    recordings = [] if data is None else recordings_of(data, units, "data")
    place, known = (None if path is None else Path(path) for path in (out, family))
    if with_family(known, lot, more=bool(kind or neurons or compare or report)):
        from driftlab.jobs.family_map import fit_family_map

        return fit_family_map(
            loaded, recordings, known, lot=lot or "", out=place, progress=progress, read=files_of(config)
        )
    how: dict[str, Any] = {"kind": kind, "neurons": neurons, "compare": compare, "progress": progress}
    if place is None:
        return job(loaded, recordings, **how)
    return fit_map_to_file(
        loaded, recordings, place, None if report is None else Path(report), **how, read=files_of(config)
    )
