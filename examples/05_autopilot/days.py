"""A day at rest: as it was recorded, as two autopilots log it, and what a compensation leaves of its gyro's bias."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from dataflash_writer import write_log
from numpy.typing import NDArray
from ulog_writer import sensor, write_ulog

from driftlab.evaluation.scores import moving_average

DEVICE = 1310988  # device_id of the gyro in the logs, as PX4 writes it
DEPARTURE = 60.0  # s at rest before
HORIZONS = {"10 min": 600.0, "to the end": np.inf}  # s
Array = NDArray[np.float64]
Errors = dict[str, Array]


@dataclass(frozen=True)
class Placement:
    """A day at rest: t (N,) in s, gyro (N, 3) in rad/s, accel (N, 3) in m/s^2, temperature (N,) in degC."""

    t: Array
    gyro: Array
    accel: Array
    temperature: Array

    @classmethod
    def of(cls, path: Path, span: tuple[float, float | None]) -> Placement:
        """Return a span (s) of the recording; its time begins ten seconds after power-up."""
        with h5py.File(path) as file:
            t = file["timestamp_utc"][()].astype(np.float64)
            t -= t[0]
            rows = np.flatnonzero((t >= span[0]) & (t <= (span[1] or np.inf)))
            gyro, accel, T = (file[name][()][rows] for name in ("angular_velocity", "acceleration", "temperature"))
        return cls(t[rows] - t[rows[0]] + 10.0, gyro * 1e-3, accel, T.astype(np.float64))

    def write(self, folder: Path, name: str) -> None:
        """Write it as both autopilots log it."""
        write_log(folder / f"{name}.bin", self.t, [(self.gyro, self.accel, self.temperature)])
        topics = [
            sensor(f"sensor_{what}", 0, self.t, values, self.temperature, DEVICE)
            for what, values in (("gyro", self.gyro), ("accel", self.accel))
        ]
        write_ulog(folder / f"{name}.ulg", topics)

    @property
    def reference(self) -> Array:
        """The gyro's centred mean (N, 3) over 30 s, as in all tables of errors."""
        tau = np.full(len(self.t), np.median(np.diff(self.t)))
        return moving_average(self.t, self.gyro, tau, np.ones(len(self.t), dtype=bool))


def of_firmware(taken: Array, day: Placement) -> Errors:
    """Return the rms (3,) over each horizon of what is left where `taken` (N, 3) is taken off.

    The level is that of the minute before the departure.
    """
    t = day.t - day.t[0]
    level = np.mean((day.gyro - taken)[t < DEPARTURE], axis=0)
    return _over_horizons((day.reference - taken - level)[t >= DEPARTURE], t[t >= DEPARTURE])


def of_filter(coast: Array, t: Array, day: Placement) -> Errors:
    """Return the same of a filter's prediction (M, 3) at t (M,) s, whose level is the filter's own."""
    at = np.searchsorted(day.t, t - 1e-6)
    kept = (at < len(day.t)) & np.isfinite(coast).all(axis=1)
    return _over_horizons(day.reference[at[kept]] - coast[kept], t[kept])


def _over_horizons(left: Array, t: Array) -> Errors:
    return {name: np.sqrt(np.nanmean(left[t < t[0] + s] ** 2, axis=0)) for name, s in HORIZONS.items()}
