"""Soaks of a made-up family of gyros whose law is not Gaussian, with odd units, a shifted lot and a common effect.

The bias of an axis over temperature is the family's curve and four shapes, as much of each as the unit was dealt:
from laws with heavy tails, skew and two humps. Nothing here is fitted by what judges it: the shapes are no splines.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np

DEG_H = np.deg2rad(1 / 3600)  # rad/s
LATITUDE, EARTH = np.deg2rad(45.0), 7.292115e-5
LOW, HIGH = -20.0, 60.0  # degC


@dataclass
class Unit:
    """One unit: what it was dealt, which is its truth.

    `amounts` (4, 3) of the shapes, deg/h; `noise` deg/h/sqrt(Hz), `walk` deg/h/sqrt(s), (3,); `play` deg/h a K (3,).
    """

    name: str
    lot: str
    date: str
    amounts: np.ndarray
    noise: np.ndarray
    walk: np.ndarray
    play: np.ndarray = field(default_factory=lambda: np.zeros(3))
    width: float = 6.0  # K
    bump: tuple[int, float, float, float] | None = None  # axis, degC, K, deg/h: a bend that no other unit has
    odd: str = ""  # what was planted; empty: nothing

    def bias(self, T: np.ndarray) -> np.ndarray:
        """Return the bias (N, 3) at temperatures T (N,), without hysteresis, rad/s."""
        u = (T - 20) / 40
        common = np.stack([120 * u - 60 * u**2, 80 * np.sin(2 * u), 90 * u**3 - 40 * u], axis=1)
        shapes = np.stack([np.ones_like(u), u, np.cos(2.2 * u + 0.4), np.tanh(3 * (u - 0.3))], axis=1)
        found = common + shapes @ self.amounts
        if self.bump is not None:
            axis, at, width, height = self.bump
            found[:, axis] += height * np.exp(-(((T - at) / width) ** 2))
        return found * DEG_H


def deal(count: int, seed: int = 0, *, lots: int = 10, play: float = 0.0, law: str = "mixed") -> list[Unit]:
    """Deal a family: `play` is the mean slope of a common hysteresis, deg/h a K; `law` gaussian or mixed."""
    rng = np.random.default_rng(seed)
    size = np.array([60.0, 45.0, 30.0, 20.0])[:, None]  # deg/h
    units = []
    for k in range(count):
        if law == "gaussian":
            dealt = rng.normal(size=(4, 3))
        else:
            dealt = np.stack([
                rng.standard_t(5, size=3) / np.sqrt(5 / 3),
                rng.gamma(2.0, size=3) / np.sqrt(2) - np.sqrt(2),
                rng.choice([-1.0, 1.0], size=3) * 0.8 + 0.6 * rng.normal(size=3),
                rng.normal(size=3),
            ])  # fmt: skip
        lot = k * lots // count
        date = np.datetime64("2026-01-05") + np.timedelta64(k, "D")
        noise, walk = 2.0 * np.exp(0.1 * rng.normal(size=3)), 0.02 * np.exp(0.2 * rng.normal(size=3))
        slope = play * (1 + 0.3 * rng.normal(size=3))
        units.append(Unit(f"{k:04d}", f"L{lot:02d}", str(date), size * dealt, noise, walk, slope))
    return units


def plant(units: list[Unit], share: float = 0.05, seed: int = 0) -> list[Unit]:
    """Return the units with some made odd, of each kind in turn: shape, noise, walk."""
    rng = np.random.default_rng([seed, 1])
    found = list(units)
    for n, k in enumerate(rng.choice(len(units), max(3, round(share * len(units))), replace=False)):
        unit, axis = found[k], int(rng.integers(3))
        kind = ("shape", "noise", "walk")[n % 3]
        if kind == "shape":
            height = float(rng.choice([-1, 1]) * rng.uniform(60, 120))
            found[k] = replace(unit, bump=(axis, float(rng.uniform(0, 50)), 6.0, height), odd="shape")
        else:
            more = np.ones(3)
            more[axis] = 3.0 if kind == "noise" else 10.0
            found[k] = replace(unit, **{kind: getattr(unit, kind) * more}, odd=kind)
    return found


def shifted(units: list[Unit], lot: str, by: float = 100.0) -> list[Unit]:
    """Return the units with the level of one lot shifted, deg/h on x."""
    step = np.zeros((4, 3))
    step[0, 0] = by
    return [replace(u, amounts=u.amounts + step) if u.lot == lot else u for u in units]


def soak(unit: Unit, hours: float = 2.0, *, part: float = 1.0, dt: float = 1.0, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the recording of a soak up and down again: time, gyro (rad/s), accel (m/s^2), temperature (degC).

    Of `part` of the range, from its lower end.
    """
    rng = np.random.default_rng([seed, int.from_bytes(unit.name.encode(), "big") % 2**32])
    N = round(hours * 3600 / dt)
    t = np.arange(N) * dt
    T = LOW + part * (HIGH - LOW) * (1 - np.cos(2 * np.pi * t / t[-1])) / 2
    bias = unit.bias(T)
    if np.any(unit.play):
        follows, y = np.empty(N), T[0]
        for k in range(N):
            y = min(max(y, T[k] - unit.width / 2), T[k] + unit.width / 2)
            follows[k] = y
        bias = bias + np.outer(follows - T, unit.play) * DEG_H
    white = unit.noise * rng.normal(size=(N, 3)) / np.sqrt(dt)
    walk = np.cumsum(unit.walk * rng.normal(size=(N, 3)) * np.sqrt(dt), axis=0)
    earth = EARTH * np.array([np.cos(LATITUDE), 0.0, np.sin(LATITUDE)])
    return {
        "time": t,
        "gyro": bias + (white + walk) * DEG_H + earth,
        "accel": np.array([0.0, 0.0, 9.806]) + 1e-3 * rng.normal(size=(N, 3)),
        "temperature": T + 0.02 * rng.normal(size=N),
    }


def write(path: Path, recording: dict[str, np.ndarray]) -> None:
    """Write a recording as HDF5."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, values in recording.items():
            file[name] = values
