"""A unit at rest as files of several formats, with paths as users have them."""

from datetime import UTC, datetime, timedelta

import bags
import numpy as np
import polars as pl
import scipy.io

G = 9.80665


def write_formats(folder, unit):
    """Write `run.bag`, `run.parquet` and `run.mat`."""
    gyro, accel = np.rad2deg(unit.gyro), unit.accel / G
    began = datetime(2026, 1, 1, tzinfo=UTC)
    since = (unit.t - unit.t[0]).tolist()
    imu = [
        {"gyro": w, "accel": dict(zip("xyz", f, strict=True))}
        for w, f in zip(gyro.tolist(), accel.tolist(), strict=True)
    ]
    stamp = [began + timedelta(seconds=t) for t in since]
    pl.DataFrame({"stamp": stamp, "imu": imu, "temp": unit.temperature}).write_parquet(folder / "run.parquet")
    counts = np.rint(unit.temperature * 100).astype(np.int16)
    scipy.io.savemat(folder / "run.mat", {"t": since, "imu": {"gyro": gyro.T, "accel": accel, "temp": counts}})

    def messages(types):
        for k, t in enumerate(since):
            stamp = bags.BEGAN + round(t * bags.SECOND)
            yield "/imu/data", stamp, types.imu(stamp, unit.gyro[k], unit.accel[k])
            if k % 10 == 0:
                yield "/imu/temperature", stamp, types.temperature(stamp, unit.temperature[k])

    bags.write(folder / "run", "ros1", messages)
