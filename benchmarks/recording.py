"""A recording of any length, a thermal map and a config, made in a temporary folder."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import yaml

from fusion_core.contracts import ThermalMap
from fusion_core.host.registry import registry

BLOCK = 1 << 20  # rows made at a time
NOISE, WALK = 1.54e-5, 2.6e-6  # of the gyro: rad/s/sqrt(Hz), rad/s/sqrt(s)


def curve(T: np.ndarray) -> np.ndarray:
    """Return the gyro's bias (N, 3) at T, rad/s."""
    return np.stack([1e-3 + 2e-5 * T + 1e-6 * T**2, -2e-3 - 3e-5 * T, 5e-4 * np.tanh((T - 25) / 8)], axis=1)


def temperature(t: np.ndarray) -> np.ndarray:
    """Return a chamber's profile: slow swings between -10 and 50 degC."""
    return 20 + 25 * np.sin(2 * np.pi * t / 7200) + 5 * np.sin(2 * np.pi * t / 1700)


def blocks(N: int, rate: float):
    """Yield t (n,), gyro (n, 3), accel (n, 3) and T (n,), block by block."""
    rng = np.random.default_rng(0)
    white = rng.standard_normal((BLOCK, 6), dtype=np.float32)
    bias = np.zeros(3)
    for start in range(0, N, BLOCK):
        rows = min(BLOCK, N - start)
        t = np.arange(start, start + rows) / rate
        T = temperature(t)
        shifted = np.roll(white, rng.integers(BLOCK), axis=0)[:rows]  # fresh noise costs more than the filter
        walk = bias + np.cumsum(rng.standard_normal((rows, 3)), axis=0) * WALK / np.sqrt(rate)
        bias = walk[-1]
        gyro = curve(T) + walk + shifted[:, :3] * NOISE * np.sqrt(rate)
        accel = np.array([0.0, 0.0, 9.80206]) + shifted[:, 3:] * 8.333e-4 * np.sqrt(rate)
        yield t, gyro, accel, T


def write_hdf5(path: Path, seconds: float, rate: float) -> Path:
    """Write a recording with float32 channels; time alone is float64, since float32 has no ms left after an hour."""
    N = int(seconds * rate)
    with h5py.File(path, "w") as file:
        kinds = {"time": ((), "f8"), "gyro": ((3,), "f4"), "accel": ((3,), "f4"), "temperature": ((), "f4")}
        data = {name: file.create_dataset(name, (N, *shape), dtype) for name, (shape, dtype) in kinds.items()}
        at = 0
        for columns in blocks(N, rate):
            for values, target in zip(columns, data.values(), strict=True):
                target[at : at + len(values)] = values
            at += len(columns[0])
    return path


def write_csv(path: Path, rows: int, rate: float) -> Path:
    """Write a recording as text, eight columns."""
    import polars as pl

    with path.open("wb") as file:
        for k, (t, gyro, accel, T) in enumerate(blocks(rows, rate)):
            columns = {"time": t, **{f"g{a}": gyro[:, i] for i, a in enumerate("xyz")},
                       **{f"a{a}": accel[:, i] for i, a in enumerate("xyz")}, "temperature": T}  # fmt: skip
            pl.DataFrame(columns).write_csv(file, include_header=k == 0, float_precision=9)
    return path


def write_map(path: Path) -> Path:
    """Fit and write an ONNX map of the unit's curve."""
    T = np.linspace(-15, 55, 2000)
    settings = registry().classes(ThermalMap)["onnx_network"].model_validate({"kind": "onnx_network"})
    settings.fit(T, curve(T), {}).save(path)
    return path


def write_config(path: Path, fitted: Path, interval: str, kind: str = "hdf5", calibrated: bool = False) -> Path:
    """Write a TCZUPT config (or the standard filter's, where it is `calibrated`)."""
    units = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
    names = {"gyro": ["gx", "gy", "gz"], "accel": ["ax", "ay", "az"]} if kind == "csv" else {}
    channels = {name: {"path": names.get(name, name), "unit": unit} for name, unit in units.items()}
    map_ = {"kind": "onnx_network", "path": str(fitted)}
    bias = {"kind": "thermal_derivative", "walk": "1.5e-4 deg/s/sqrt(s)", "map": map_}
    if calibrated:
        bias = {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}
    gyro = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": bias, **({"calibration": map_} if calibrated else {})}
    accel = {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2 m/s/h/sqrt(s)"}}
    config = {
        "latitude": "40.9 deg",
        "source": {"kind": kind, "channels": channels},
        "filter": {"update_interval": interval, "gyro": gyro, "accel": accel},
    }
    path.write_text(yaml.safe_dump(config), encoding="utf-8")
    return path
