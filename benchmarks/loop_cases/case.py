"""Cases: a config, recordings, their truth, and reference errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from loop_cases.names import Pattern, Truth

Array = np.ndarray
Columns = Mapping[str, tuple[Array, str]]  # data set: values and unit


@dataclass(frozen=True)
class Prepared:
    """A case on disk: `explain` is given the first four, the rest judges its answer."""

    config: Mapping[str, Any]
    calibration: Sequence[str]
    train: Sequence[str]
    holdout: Sequence[str]
    truths: tuple[Truth, ...] = ()
    tolerated: tuple[Pattern, ...] = ()  # additions that are neither right nor false
    bias: tuple[Array, Array] | None = None  # the holdout's true bias: t (N,) s, (N, d) rad/s; None: its reference
    oracle: float | None = None  # error of a model that knows the truth, norm over the axes, rad/s


@dataclass(frozen=True)
class Case:
    """One question to `explain`; `make` writes its recordings into a folder."""

    name: str
    group: str  # measured, control, planted or simulated
    split: str  # develop or check
    make: Callable[[Path], Prepared] = field(repr=False)
    bed: str | None = None  # the case whose error `before` is that of this one with nothing planted


def write(path: Path, columns: Columns) -> Path:
    """Write a recording to HDF5."""
    with h5py.File(path, "w") as file:
        for name, (values, unit) in columns.items():
            file.create_dataset(name, data=values).attrs["unit"] = unit
    return path


def config_of(
    units: Mapping[str, str],
    gyro: Mapping[str, Any],
    *,
    paths: Mapping[str, str] | None = None,
    align: str = "60 s",
    accel: Mapping[str, Any] | None = None,
    **rest: Any,
) -> dict[str, Any]:
    """Return a config that reads HDF5 channels of these units at 1 s."""
    channels = {name: {"path": (paths or {}).get(name, name), "unit": unit} for name, unit in units.items()}
    filtering: dict[str, Any] = {"update_interval": "1 s", "align": align, "gyro": dict(gyro)}
    if accel is not None:
        filtering["accel"] = dict(accel)
    return {**rest, "source": {"kind": "hdf5", "channels": channels}, "filter": filtering}


def follows(noise: Any, walk: str, thermal: Mapping[str, Any] | None, **bias: Any) -> dict[str, Any]:
    """Return the gyro's settings: a bias that follows a map of temperature and walks, or only walks."""
    kind = {"kind": "random_walk"} if thermal is None else {"kind": "thermal_derivative", "map": dict(thermal)}
    return {"noise": noise, "bias": {**kind, "walk": walk, **bias}}


def save(config: Mapping[str, Any], path: Path) -> Path:
    """Write a config as YAML."""
    path.write_text(yaml.safe_dump(dict(config), sort_keys=False), encoding="utf-8")
    return path
