"""Small recordings of each kind of file, and how to read them."""

import h5py
import numpy as np
import polars as pl
import scipy.io

import driftlab
from fusion_core.chunk import concatenate
from fusion_core.faults import Faults
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.hdf5 import Hdf5
from fusion_plugins.sources.mat import Mat
from fusion_plugins.sources.parquet import Parquet

AXES = ("x", "y", "z")
DEG, G = np.pi / 180, 9.80665
TIME = {"time": {"path": "time", "unit": "s"}}
KINDS = [Csv, Hdf5, Mat, Parquet]


def columns(rows=101):
    rng = np.random.default_rng(5)
    table = {"time": 1000 + 0.5 * np.arange(rows), "temperature": 20 + np.arange(rows) / 8}
    for k, axis in enumerate(AXES):
        table[f"g{axis}"] = rng.normal(size=rows)
        table[f"a{axis}"] = rng.normal(k == 2, 0.01, rows)
    return table | {"ok": (np.arange(rows) % 7 > 0).astype(float), "note": rng.normal(size=rows)}


def write(kind, path, table):
    if kind is Csv:
        pl.DataFrame(table).write_csv(path)
    elif kind is Parquet:
        pl.DataFrame(table).write_parquet(path, row_group_size=64)
    elif kind is Mat:
        with path.open("wb") as file:
            scipy.io.savemat(file, table)
    else:
        with h5py.File(path, "w") as file:
            for name, values in table.items():
                file[name] = values
    return path


def channels(**more):
    return {
        **TIME,
        "gyro": {"path": ["gx", "gy", "gz"], "unit": "deg/s"},
        "accel": {"path": ["ax", "ay", "az"], "unit": "g"},
        "temperature": {"path": "temperature", "unit": "degC"},
        **more,
    }


def read(source, size=1000, faults=None):
    return concatenate(list(source.chunks(size, Faults() if faults is None else faults)))


def simulated_as(path):
    """A minute of a simulated unit as `simulate` writes it to a path, and its arrays; return both."""
    config = {"source": {"kind": "synthetic", "rate": "20 Hz", "duration": "60 s", "seed": 4, "roll": "180 deg"}}
    driftlab.simulate(config, out=path)
    return path, driftlab.simulate(config)


def text(tmp_path, content, name="r.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def simple(path, unit="rad/s", **more):
    """A CSV with the columns t and g."""
    gyro = {"path": "g", "unit": unit}
    return Csv(path=path, channels={"time": {"path": "t", "unit": "s"}, "gyro": gyro}, **more)


def h5(path, unit=None, attribute=None, name="gyro", values=None, key="unit", **more):
    """An HDF5 file with time and one other channel."""
    values = np.arange(12.0).reshape(4, 3) if values is None else values
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(float(len(values)))
        file["v"] = values
        if attribute is not None:
            file["v"].attrs[key] = attribute
    return Hdf5(path=path, channels={**TIME, name: {"path": "v", "unit": unit}}, **more)
