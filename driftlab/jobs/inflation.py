"""How the innovations of a run compare with the noise and walk that it was told, from the folder that it wrote."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.config import understood
from driftlab.noise.innovations import SensorReadings, inflation
from driftlab.storage.hdf5 import columns_of, reading
from fusion_core.budget import read_whole
from fusion_core.chunk import Array
from fusion_core.contracts import Export, Inflation
from fusion_core.data_sets import attribute
from fusion_core.errors import ConfigError, UnreadableFile, shown
from fusion_core.host.config import document_of
from fusion_core.model import Flags
from fusion_core.thermal.record_texts import parse_json
from fusion_core.units import along_axes

if TYPE_CHECKING:
    from fusion_core.contracts import MeasurementModel, Sensor

NEEDED = ("t", "tau", "rate", "coast", "still", "used", "innovations", "x")


def inflations(folder: Path) -> dict[str, dict[str, Inflation]]:
    """Return by channel what the innovations of the run in a folder say of each sensor whose walk it declares.

    `compensated` is about readings less what map and effects say of their bias, `raw` about readings as they are; one
    is missing where the run does not show it.

    Raises
    ------
    ConfigError
        If the folder is none of a run.
    UnreadableFile, SingularFit
        If its files are damaged, or too little of it was at rest.
    """
    path = folder / "estimates.h5"
    if not path.is_file():
        raise ConfigError(f"run {folder}: has no estimates.h5; name the folder that `driftlab run --out` wrote")
    with reading(path) as file:
        if missing := [name for name in NEEDED if name not in file]:
            raise UnreadableFile(f"{path}: has no {', '.join(missing)}; write it anew with `driftlab run`")
        columns = {name: rows[: len(rows.node)] for name, rows in columns_of(path, file, NEEDED).items()}
        text = str(attribute(path, file, "config"))
    document = document_of(text)
    document.data.pop("source", None)  # which may have been in memory
    model = understood(document).filter
    assert model is not None, "a run has a filter"
    fresh = _fresh(folder, columns["t"])
    found: dict[str, dict[str, Inflation]] = {}
    for sensor in model.sensors:
        walk = getattr(sensor.bias, "walk", None)
        if walk is None:
            continue
        series = _series(model, sensor, columns)
        noise, density = sensor.noise, along_axes(walk, len(sensor.axes))
        found[sensor.channel] = {
            name: _judged(columns, values, fresh, noise, density) for name, values in series.items()
        }
    return found


def _fresh(folder: Path, t: Array) -> Flags:
    """Return the epochs (N,) at which a prediction starts anew: after each further alignment."""
    fresh = np.zeros(len(t), dtype=bool)
    path = folder / "summary.json"
    if path.is_file():
        try:
            summary: dict[str, Any] = parse_json(read_whole(path))
            moments = np.asarray(summary.get("aligned_again_s", []), dtype=np.float64)
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise UnreadableFile(
                f"{path}: is damaged ({shown(error, 120)}); write it anew with `driftlab run`"
            ) from None
        again = np.searchsorted(t, moments.ravel(), side="right")
        fresh[again[again < len(t)]] = True
    return fresh


def _judged(columns: dict[str, Array], d: Array, fresh: Flags, noise: Array, walk: Array) -> Inflation:
    still = columns["still"].astype(bool)
    readings = SensorReadings(columns["t"], columns["tau"], np.where(still[:, None], d, np.nan), fresh)
    return inflation(readings, noise, walk)


def _series(model: MeasurementModel, sensor: Sensor, columns: dict[str, Array]) -> dict[str, Array]:
    """Return the readings (N, d) of a sensor: raw, and less what map and effects say of its bias."""
    if sensor.channel == model.tracked.channel:
        return {"raw": columns["rate"], "compensated": columns["rate"] - columns["coast"]}
    if sensor.bias.as_random_walk() is None:
        return {}
    rows = [k for k, (channel, _, unit) in enumerate(model.components) if channel == sensor.channel]
    bias = columns["x"][:-1, model.places[sensor.channel]]
    # what an update measures is the integral of the reading less the bias before it, and it is to be zero
    after = bias - columns["innovations"][1:, rows] / columns["tau"][1:, None]
    d = np.concatenate([np.full((1, len(rows)), np.nan), after])
    return {"compensated": d} if sensor.calibration is not None else {"raw": d, "compensated": d}


def with_inflation(what: Export, folder: Path) -> Export:
    """Return the same with what the run in a folder says of each sensor; raises as `inflations`."""
    found = inflations(folder)
    if unknown := [channel for channel in found if what.sensor(channel) is None]:
        raise ConfigError(f"run {folder}: is of {', '.join(unknown)}, which the config has not; name a run of its own")
    sensors = []
    for sensor in what.sensors:
        own = found.get(sensor.channel, {})
        sensors.append(replace(sensor, compensated=own.get("compensated"), raw=own.get("raw")))
    return replace(what, sensors=tuple(sensors))
