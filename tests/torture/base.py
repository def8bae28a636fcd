"""Valid input that is mutated: a unit at rest for three minutes, its configs and its maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from units_at_rest import thermal_bias, unit_at_rest

SECONDS, RATE = 180, 10
UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
COLUMNS = ("time", "gx", "gy", "gz", "ax", "ay", "az", "temperature")
PATHS = {"time": "time", "gyro": ["gx", "gy", "gz"], "accel": ["ax", "ay", "az"], "temperature": "temperature"}
WALK = "1.5e-4 deg/s/sqrt(s)"
RANDOM_WALK: dict[str, Any] = {"kind": "random_walk", "walk": WALK}


def recording(seconds: float = SECONDS, rate: float = RATE, seed: int = 0) -> dict[str, np.ndarray]:
    """Return time and channels of a unit that is warmed slowly, in SI."""
    unit = unit_at_rest(seconds=seconds, rate=rate, seed=seed, temperature=lambda t: 20 + t / 60)
    return {"time": unit.t, **unit.channels()}


def write_h5(path: Path, data: dict[str, np.ndarray]) -> None:
    """Write data sets with their units."""
    with h5py.File(path, "w") as file:
        for name, values in data.items():
            file[name] = values
            file[name].attrs["unit"] = UNITS[name]


def csv_text(data: dict[str, np.ndarray]) -> str:
    """Return a CSV file; every number can be read back to the last bit."""
    table = np.column_stack([data["time"], data["gyro"], data["accel"], data["temperature"]])
    return ",".join(COLUMNS) + "\n" + "".join(",".join(map(repr, row)) + "\n" for row in table.tolist())


def source(kind: str, **more: Any) -> dict[str, Any]:
    """Return the source of a config; of HDF5 the units are in the file."""
    if kind == "hdf5":
        return {"kind": kind, "channels": {name: {"path": name} for name in UNITS}, **more}
    return {
        "kind": kind,
        "channels": {name: {"path": PATHS[name], "unit": unit} for name, unit in UNITS.items()},
        **more,
    }


def config(origin: dict[str, Any], bias: dict[str, Any] | None = None, **gyro: Any) -> dict[str, Any]:
    """Return a config for a source."""
    return {
        "latitude": "40.9 deg",
        "source": origin,
        "filter": {
            "align": "20 s",
            "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": bias or RANDOM_WALK, **gyro},
            "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}},
        },
    }


def write_config(path: Path, content: dict[str, Any]) -> None:
    """Write a config."""
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def fit_map(path: Path, **settings: Any) -> None:
    """Fit a map of the recording's curve and save it."""
    from fusion_core.contracts import ThermalMap
    from fusion_core.host.registry import registry

    T = np.linspace(0, 60, 400)
    plugin = registry().classes(ThermalMap)[settings["kind"]].model_validate(settings)
    plugin.fit(T, thermal_bias(T), {}).save(path)
