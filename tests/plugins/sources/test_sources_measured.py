"""Recordings of real units, in the files that they came in."""

import os
import shutil

import h5py
import numpy as np
import polars as pl
import pytest
from recordings_on_disk import AXES, DEG, G, read

from fusion_core.chunk import concatenate
from fusion_core.errors import (
    UnreadableFile,
)
from fusion_core.faults import Faults, usable
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.hdf5 import Hdf5


@pytest.mark.recordings
def test_bursts_of_a_cold_test(recordings):
    path = recordings / "data/pan_tvc_lsm6dsm/pan_tvc_50hz_bursts.csv"
    own = [f"g{a}_file_rad_s" for a in AXES]
    fields = {
        "time": {"path": "t_s", "unit": "s"},
        "gyro": {"path": own, "unit": "0.5 rad/s"},
        "temperature": {"path": "temp_C", "unit": "degC"},
        "valid": {"path": ["ok_x", "ok_y", "ok_z"]},
    }
    source, faults = Csv(path=path, channels=fields), Faults()
    table = pl.read_csv(path)
    np.testing.assert_array_equal(read(source)["gyro"], table.select(own).to_numpy() * 0.5)
    kept = concatenate(list(usable(source.chunks(100, faults), faults, source.name)))
    assert len(kept) == table.filter((pl.col("ok_x") == 1) & (pl.col("ok_y") == 1) & (pl.col("ok_z") == 1)).height
    np.testing.assert_allclose(kept["gyro"][:1], [[-0.03265, 0.02855, 0.0148]])


@pytest.mark.recordings
def test_a_sweep_without_time(recordings):
    path = recordings / "data/rtimulib2_teensy/measurements2.csv"
    fields = {
        "accel": {"path": ["ax_g", "ay_g", "az_g"], "unit": "g"},
        "gyro": {"path": [f"g{a}_rad_s" for a in AXES], "unit": "rad/s"},
        "temperature": {"path": "temp_C", "unit": "degC"},
        "valid": {"path": "ok"},
    }
    got = read(Csv(path=path, channels=fields, interval="1 s"), 1000)
    assert len(got) == 2859
    assert got.t[-1] == 2858
    np.testing.assert_allclose(np.linalg.norm(got["accel"], axis=1).mean(), G, rtol=0.03)


@pytest.mark.recordings
def test_a_soak_in_hdf5_and_cut_short(recordings, tmp_path):
    path = recordings / "blind/a/soak.h5"
    names = ("time", "gyro", "accel", "temperature")
    source = Hdf5(path=path, channels={name: {"path": name} for name in names})
    got = read(source, 4096)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(got.t, file["time"][:])
        np.testing.assert_allclose(got["gyro"], file["gyro"][:] * DEG, rtol=1e-14)
        np.testing.assert_allclose(got["accel"], file["accel"][:].astype(float) * G, rtol=1e-14)
    size = path.stat().st_size
    for n in np.linspace(1, size - 1, 40).astype(int):
        cut = shutil.copy(path, tmp_path / "cut.h5")
        os.chmod(cut, 0o600)
        os.truncate(cut, n)
        with pytest.raises(UnreadableFile, match="is cut short or damaged"):
            read(source.model_copy(update={"path": cut}))
