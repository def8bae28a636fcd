"""A unit at rest under thermometers of all kinds, with its true bias: in plain NumPy, no code of the project.

    gyro = Omega + b + white noise,   b = curve(T) + level + walk        [rad/s]
    thermometer = mean over conversions of round((T + noise) / step) step  [degC]

A unit is drawn from `unit`, a day of it from `day`: its soak and the recording that is held against it have the same
curve and level, and another walk. The sensor's axes are north, west, up; the site's latitude is 45 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from foreign_curves import draw_curves
from foreign_soaks import DEG_H, behind

LATITUDE = np.deg2rad(45.0)
OMEGA = 7.292115e-5 * np.array([np.cos(LATITUDE), 0.0, np.sin(LATITUDE)])  # rad/s
G = 9.80620  # m/s^2 at 45 degrees, by the formula of WGS 84


@dataclass(frozen=True)
class Kind:
    """A type of unit, in SI."""

    white: float  # rad/s/sqrt(Hz)
    walk: float  # rad/s/sqrt(s)
    slope: float  # rad/s/K, of the curve's straight part
    accel_white: float  # m/s^2/sqrt(Hz)


KINDS = {
    "FOG": Kind(1.2e-6, 1e-9, 4e-6, 3.3e-4),
    "MEMS": Kind(3.18 * DEG_H, 0.05 * DEG_H, 2e-5, 8.3e-4),
    "MEMS wide walk": Kind(3.18 * DEG_H, 0.54 * DEG_H, 2e-5, 8.3e-4),
}
STEPS = (0.0, 0.01, 0.1, 0.25, 0.5, 1.0)  # K
NOISES = (0.0, 0.02, 0.2)  # K, before rounding, of one conversion
PROFILES = ("soak", "warm_up", "chamber", "day", "hold")


@dataclass(frozen=True)
class Recording:
    """N samples; `bias` and `T` are the truth."""

    t: np.ndarray  # (N,) s
    gyro: np.ndarray  # (N, 3) rad/s
    accel: np.ndarray  # (N, 3) m/s^2
    temperature: np.ndarray  # (N,) degC, as read
    bias: np.ndarray  # (N, 3) rad/s
    T: np.ndarray  # (N,) degC

    def save(self, path: str | Path) -> None:
        """Write time, gyro, accel and temperature with their units as HDF5."""
        import h5py

        with h5py.File(path, "w") as file:
            for name, values, unit in (
                ("time", self.t, "s"),
                ("gyro", self.gyro, "rad/s"),
                ("accel", self.accel, "m/s^2"),
                ("temperature", self.temperature, "degC"),
            ):
                file.create_dataset(name, data=values).attrs["unit"] = unit


def true_temperature(profile: str, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the temperature (N,) of the sensor itself [degC]; only "soak" covers -10 to 50."""
    end, step = t[-1], t[1] - t[0]
    if profile == "soak":  # up and down once
        return behind(np.interp(t, [0, 0.48 * end, 0.52 * end, end], [-10.0, 50.0, 50.0, -10.0]), 240.0, step)
    if profile == "warm_up":  # powered in a still room: two time constants
        room, fast, slow = rng.uniform(0, 15), rng.uniform(5, 10), rng.uniform(8, 20)
        tau = rng.uniform([120, 1200], [300, 3000])
        return room + fast * (1 - np.exp(-t / tau[0])) + slow * (1 - np.exp(-t / tau[1]))
    if profile == "chamber":  # ramps of 0.3 to 2 K/min and dwells
        at, T = [0.0], [rng.uniform(0, 40)]
        while at[-1] < end:
            target = rng.uniform(-5, 45)
            at += [at[-1] + 60 * abs(target - T[-1]) / np.exp(rng.uniform(np.log(0.3), np.log(2.0)))]
            at += [at[-1] + rng.uniform(60, 1800)]
            T += [target, target]
        return behind(np.interp(t, at, T), rng.uniform(120, 400), step)
    if profile == "day":  # out of doors: a slow wave and clouds
        clouds = behind(np.repeat(rng.normal(size=int(end // 300) + 2), 300)[t.astype(int)], 200.0, step)
        return 20 + 12 * np.sin(2 * np.pi * t / 43_200 + rng.uniform(-np.pi, np.pi)) + 1.5 * clouds
    if profile == "hold":  # a constant within a hundredth: the thermometer may never step
        return rng.uniform(5, 40) + 0.01 * np.sin(2 * np.pi * t / 1800)
    raise ValueError(f"profile: got {profile!r}, expected one of {PROFILES}")


def read(
    T: np.ndarray, step: float, noise: float, rng: np.random.Generator, averaged: int = 1, held: int = 1
) -> np.ndarray:
    """Return the reading of the thermometer at T (N,) [degC].

    Parameters
    ----------
    step : float
        What one conversion is rounded to [K]; 0 for none.
    noise : float
        White noise of one conversion, before it is rounded [K].
    averaged : int
        Conversions of which a row is the mean, spread over the time since the row before.
    held : int
        Rows between two readings; the last one is repeated.
    """
    rows = np.arange(0, len(T), held)
    before = T[np.maximum(rows - held, 0)]
    total = np.zeros(len(rows))
    for k in range(averaged):
        x = T[rows] + (before - T[rows]) * (k / averaged) + rng.normal(size=len(rows)) * noise
        total += np.round(x / step) * step if step > 0 else x
    return np.repeat(total / averaged, held)[: len(T)]


def draw(
    unit: int,
    day: int = 0,
    kind: str | Kind = "FOG",
    *,
    step: float = 0.5,
    noise: float = 0.02,
    averaged: int = 1,
    held: int = 1,
    profile: str = "chamber",
    rate: float = 10.0,
    hours: float = 2.0,
    bend: float = 0.4,
) -> Recording:
    """Draw a day of a unit.

    Parameters
    ----------
    unit, day : int
        Seeds: of curve and level, and of walk, noises and temperature.
    kind : str or Kind
        One of `KINDS`, or sigmas of your own.
    step, noise, averaged, held
        The thermometer, as in `read`.
    profile : str
        One of `PROFILES`; a map wants a "soak" (of 6 h at 1 Hz, say) with the thermometer of the day.
    rate : float
        Samples a second [Hz].
    hours : float
        How long.
    bend : float
        Greatest less least of the curve's bends, as a share of what the straight part does over 60 K.
    """
    law = KINDS[kind] if isinstance(kind, str) else kind
    own, rng = np.random.default_rng([unit, 31]), np.random.default_rng([unit, day, 32])
    slope = law.slope * own.uniform(0.5, 1.0, 3) * own.choice([-1, 1], 3)
    level = law.slope * 30 * own.normal(size=3)
    curves = draw_curves(unit, 60 * law.slope * bend, low=-10.0, high=50.0)
    count = round(hours * 3600 * rate)
    t = np.arange(count) / rate
    T = true_temperature(profile, t, rng)
    walk = np.cumsum(rng.normal(size=(count, 3)), axis=0) * law.walk / np.sqrt(rate)
    bias = level + (T - 20)[:, None] * slope + np.column_stack([c(T) for c in curves]) + walk
    gyro = bias + OMEGA + rng.normal(size=(count, 3)) * law.white * np.sqrt(rate)
    accel = np.array([0.0, 0.0, G]) + rng.normal(size=(count, 3)) * law.accel_white * np.sqrt(rate)
    return Recording(t, gyro, accel, read(T, step, noise, rng, averaged, held), bias, T)


def config(kind: str | Kind, interval: str = "1 s", map_settings: str = "{kind: spline}") -> str:
    """Return the model that made the unit, as YAML; `interval` is the time between two updates."""
    law = KINDS[kind] if isinstance(kind, str) else kind
    return f"""latitude: 45 deg
heading: 0 deg
source:
  kind: hdf5
  channels: {{time: {{path: time}}, gyro: {{path: gyro}}, accel: {{path: accel}}, temperature: {{path: temperature}}}}
filter:
  update_interval: {interval}
  align: 60 s
  gyro:
    noise: {law.white:.6g} rad/s/sqrt(Hz)
    bias: {{kind: thermal_derivative, walk: {law.walk:.6g} rad/s/sqrt(s), map: {map_settings}}}
  accel:
    noise: {law.accel_white:.6g} m/s^2/sqrt(Hz)
    bias: {{kind: random_walk, walk: 1e-6 m/s^2/sqrt(s)}}
"""
