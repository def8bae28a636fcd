"""The commands as functions that need no recording: `simulate` makes one, `plan` says which to make.

They are part of `driftlab.api`, whose conventions they have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.arguments import ConfigLike, DataLike, as_function, config_of, files_of, recordings_of
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    from driftlab.jobs.plan import PlanResult
    from driftlab.jobs.plan_after import AfterResult
    from driftlab.jobs.plan_family import PlanFamilyResult
    from driftlab.jobs.simulate import SimulateResult

File = str | PathLike[str] | None
Progress = Callable[..., None] | None


@as_function
def plan(
    config: ConfigLike,
    hours: float = 8.0,
    *,
    range: str | tuple[float, float] | None = None,
    rate: str | None = None,
    lag: str | None = None,
    start: str | None = None,
    walk: str | None = None,
    sigma: str | None = None,
    kind: str | None = None,
    effects: Sequence[str] = (),
    after: DataLike = None,
    family: File = None,
    out: File = None,
    progress: Progress = None,
) -> PlanResult | AfterResult | PlanFamilyResult:
    """Find the chamber profile that tells most of a map, before anything is recorded or after it.

    Parameters
    ----------
    config : as that of `run`
        With a map, and a filter or a simulated unit, whose noise is reckoned with.
    hours : float
        How long the chamber may take.
    range : str or (float, float), optional
        As `-20..50 degC`, or a pair in degC; that of the config's fitted map, or of the simulated chamber.
    rate, lag, start : str, optional
        Fastest change (`2 K/min`), time constant of the unit behind the chamber (`10 min`), and the temperature at the
        beginning (`25 degC`).
    walk : str, optional
        Density of the unit's random walk, in place of the config's.
    sigma : str, optional
        As `3 deg/h`: the shortest hours that reach it are looked for.
    kind : str, optional
        Of the map, in place of the config's.
    effects : sequence of str
        Kinds of effects that are to be told apart, as `("hysteresis", "thermal_lag")`, in place of all.
    after : as `data` of `run`, or a list of them, optional
        What was recorded already: the result says what is still missing, and whether it is enough.
    family : path, optional
        `family.json` of a fleet: the result says how short a soak may be.
    out : path, optional
        Folder for `plan.json`, `setpoints.csv` and `report.html`.
    progress : callable, optional
        Called with texts.

    Returns
    -------
    PlanResult
        `time`, `set_point` (M,) of the chosen profile, `temperature` (G,) and `sigma` (G, d) that its map will have.
    AfterResult
        With `after`: `sigma` (G, d) is of the map so far, and `sigma_after` (G, d) with the further profile.
    PlanFamilyResult
        With `family`: `sigma` (G, d) of the chosen short soak, and `without_family` (G, d).

    Raises
    ------
    ConfigError
        If what is asked cannot be meant, or the hours are too few.
    """
    from driftlab.jobs.plan import plan as job

    given: dict[str, Any] = {"rate": rate, "lag": lag, "start": start, "walk": walk, "sigma": sigma, "kind": kind}
    given |= {"out": _path(out), "progress": progress, "read": files_of(config)}
    if family is not None:
        from driftlab.jobs.plan_family import plan_with_family

        if after is not None or effects:
            raise ConfigError("--family: tells how short a soak may be; leave --after and --effects out")
        return plan_with_family(config_of(config), Path(family), hours, range=range, **given)
    if after is None:
        return job(config_of(config), hours, range=range, effects=effects, **given)
    from driftlab.jobs.plan_after import plan_further

    recordings = recordings_of(after, None, "after")
    return plan_further(config_of(config), recordings, hours, range=range, effects=effects, **given)


@as_function
def simulate(
    config: ConfigLike,
    *,
    seed: int | None = None,
    duration: str | None = None,
    out: File = None,
    progress: Progress = None,
) -> SimulateResult:
    """Simulate a recording whose true bias is known.

    Parameters
    ----------
    config : as that of `run`
        With a source that simulates, as `source: {kind: synthetic}`.
    seed, duration : int and str, optional
        Of the random numbers, and as `20 min`; in place of the config's.
    out : path, optional
        File that ends in .h5, .hdf5 or .csv; the samples are then there alone.
    progress : callable, optional
        Called with time in s and the number of samples so far.

    Returns
    -------
    SimulateResult
        `time` (N,), `gyro`, `accel`, `bias_truth` (N, 3), `temperature` (N,) in SI; `data` for the other functions.
    """
    from driftlab.jobs.simulate import simulate as job

    return job(config_of(config), _path(out), seed=seed, duration=duration, progress=progress)


def _path(out: File) -> Path | None:
    return None if out is None else Path(out)
