"""Sensors that stand still on steep curves, and the same that really move: in plain NumPy, no code of the project.

    still:  gyro = curve(T) + level + walk + white noise,   accel = g + white noise
    moved:  gyro += omega,   accel = C(t) g + jolts,   C the attitude that omega turns      [SI]

`still` draws what a rest detector must not call motion: curves of up to 100 deg/h a kelvin in chambers of up to
5 K a minute, at any noise. `moved` adds motion of six kinds and says at which samples. `reference` draws a voltage
reference or a resistor at rest, in ppm or V, with flicker.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from foreign_curves import draw_curves
from foreign_soaks import DEG_H, Noise, _slow, behind
from foreign_thermometers import G, Recording

KINDS = ("bump", "slow_turn", "handling", "vibration", "rotation", "tilt")
DEGREE = np.deg2rad(1.0)
# seconds of one event, and its greatest rate [rad/s]: both drawn on a logarithm
LENGTHS = {
    "bump": (0.5, 4.0),
    "slow_turn": (30.0, 180.0),
    "handling": (20.0, 90.0),
    "vibration": (5.0, 60.0),
    "rotation": (60.0, 600.0),
    "tilt": (10.0, 60.0),
}
RATES = {
    "bump": (0.1 * DEGREE, 5 * DEGREE),
    "slow_turn": (0.05 * DEGREE, 1 * DEGREE),
    "handling": (5 * DEGREE, 90 * DEGREE),
    "vibration": (0.2 * DEGREE, 5 * DEGREE),
    "rotation": (0.05 * DEGREE, 10 * DEGREE),
    "tilt": (0.05 * DEGREE, 1 * DEGREE),
}


@dataclass(frozen=True)
class Event:
    """One stretch of real motion; `peak` is the greatest rate [rad/s]."""

    kind: str
    begin: float  # s
    end: float  # s
    peak: float


@dataclass(frozen=True)
class Moved:
    """A recording, its events, and at which of its N samples it moves (N,)."""

    recording: Recording
    moving: np.ndarray
    events: tuple[Event, ...]


def chamber(t: np.ndarray, pace: float, rng: np.random.Generator, low: float = -10.0, high: float = 50.0) -> np.ndarray:
    """Return T (N,) of a body of 30 to 120 s in ramps of at most `pace` [K/min] between dwells."""
    at, T = [0.0], [rng.uniform(low, high)]
    while at[-1] < t[-1]:
        at.append(at[-1] + rng.uniform(120, 600))
        T.append(T[-1])
        target = low if T[-1] > rng.uniform(low, high) else high
        at.append(at[-1] + 60 * abs(target - T[-1]) / (pace * rng.uniform(0.8, 1.0)))
        T.append(target)
    return behind(np.interp(t, at, T), rng.uniform(30, 120), t[1] - t[0])


def still(
    seed: int,
    *,
    slope: float = 100 * DEG_H,
    pace: float = 5.0,
    white: float = 2e-7,
    walk: float = 1e-9,
    rate: float = 10.0,
    hours: float = 1.0,
    bent: float = 0.3,
    accel_white: float = 3.3e-4,
    resolution: float = 0.01,
) -> Recording:
    """Draw a recording at rest.

    Parameters
    ----------
    seed : int
        Same arguments, same recording.
    slope : float
        Steepest slope of the curve of the steepest axis [rad/s/K]; the other two have 0.2 to 1 of it.
    pace : float
        Fastest ramp of the chamber [K/min].
    white, walk : float
        Of the gyro [rad/s/sqrt(Hz)], [rad/s/sqrt(s)].
    rate, hours : float
        Samples a second [Hz], and how long.
    bent : float
        Share of the slope that bends; the rest is a straight line.
    accel_white : float
        Of the accelerometer [m/s^2/sqrt(Hz)].
    resolution : float
        Steps of the thermometer [K].
    """
    rng = np.random.default_rng([seed, 41])
    count = round(hours * 3600 * rate)
    t = np.arange(count) / rate
    T = chamber(t, pace, rng)
    grid = np.linspace(-10, 50, 2001)
    shape = np.array([1.0, *rng.uniform(0.2, 1.0, 2)])[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)
    bias = np.empty((count, 3))
    for k, curve in enumerate(draw_curves(seed, 1.0, low=-10.0, high=50.0)):
        unit = bent / np.abs(np.gradient(curve(grid), grid)).max()
        line = 1 - bent
        steepest = np.abs(np.gradient(line * grid + unit * curve(grid), grid)).max()
        bias[:, k] = slope * shape[k] * (line * (T - 20) + unit * curve(T)) / steepest
    bias += slope * 10 * rng.normal(size=3) + np.cumsum(rng.normal(size=(count, 3)), axis=0) * walk / np.sqrt(rate)
    gyro = bias + rng.normal(size=(count, 3)) * white * np.sqrt(rate)
    accel = np.array([0.0, 0.0, G]) + rng.normal(size=(count, 3)) * accel_white * np.sqrt(rate)
    return Recording(t, gyro, accel, np.round(T / resolution) * resolution, bias, T)


def moved(
    rest: Recording,
    seed: int,
    kinds: tuple[str, ...] = KINDS,
    *,
    each: int = 2,
    peak: float | None = None,
    quiet: float = 120.0,
) -> Moved:
    """Add real motion to a recording at rest.

    Parameters
    ----------
    rest : Recording
        What stands still, as `still` draws it; level, so that accel is along z.
    seed : int
        Of the events.
    kinds : tuple of str
        Of `KINDS`: bump (a damped swing with a jolt), slow_turn (about the vertical, there and back), handling (taken
        up and put down in another attitude), vibration (a burst of 3 to 40 Hz), rotation (at one rate about the
        vertical), tilt (slowly into another attitude, where it stays). No pitch is above 0.45 of the sample rate.
    each : int
        Events of each kind; they are placed in random order, never in the first minutes (`quiet`).
    peak : float, optional
        Greatest rate of every event [rad/s]; drawn from `RATES` where None.
    quiet : float
        Seconds at rest at the start and at least between two events.
    """
    rng = np.random.default_rng([seed, 42])
    order = [str(k) for k in rng.permutation(np.repeat(kinds, each))]
    step = rest.t[1] - rest.t[0]
    lengths = np.array([max(np.exp(rng.uniform(*np.log(LENGTHS[kind]))), 3 * step) for kind in order])
    end = rest.t[-1] - rest.t[0]
    spare = end - lengths.sum() - quiet * (len(order) + 2)
    if spare < 0:
        raise ValueError(f"{len(order)} events of {lengths.sum():.0f} s do not fit into {end:.0f} s")
    gaps = quiet + spare * rng.dirichlet(np.ones(len(order) + 1))
    begins = rest.t[0] + quiet + np.cumsum(gaps[:-1]) + np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    omega, jolts = np.zeros_like(rest.gyro), np.zeros_like(rest.accel)
    down = np.tile([0.0, 0.0, G], (len(rest.t), 1))
    moving, events = np.zeros(len(rest.t), bool), []
    for kind, begin, length in zip(order, begins, lengths, strict=True):
        rows = np.flatnonzero((rest.t >= begin) & (rest.t < begin + length))
        top = peak or float(np.exp(rng.uniform(*np.log(RATES[kind]))))
        axis, profile = _motion(kind, (rest.t[rows] - begin) / length, length, 0.45 / step, rng)
        rate = top * profile / np.abs(profile).max()
        omega[rows] = rate[:, None] * axis
        angle = np.cumsum(rate) * step
        down[rows] = _turned(down[rows[0]], axis, -angle)
        down[rows[-1] + 1 :] = down[rows[-1]]
        if kind in ("bump", "vibration", "handling"):  # at an arm of some centimetres: tangential acceleration
            arm = rng.normal(size=3) * 0.05
            jolts[rows] = np.cross(np.gradient(omega[rows], rest.t[rows], axis=0), arm)
        moving[rows] = True
        events.append(Event(kind, float(begin), float(begin + length), top))
    gravity = down - np.array([0.0, 0.0, G])
    both = replace(rest, gyro=rest.gyro + omega, accel=rest.accel + gravity + jolts)
    return Moved(both, moving, tuple(events))


def _motion(
    kind: str, u: np.ndarray, length: float, highest: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis (3,) and the rate over the event (n,), u from 0 to 1, `length` [s], `highest` [Hz]."""
    axis = rng.normal(size=3)
    hump = np.sin(np.pi * np.clip(u, 0, 1)) + 1e-3
    if kind == "bump":
        swing = np.exp(-5 * u) * np.sin(
            2 * np.pi * min(rng.uniform(1, 4), highest) * length * u + rng.uniform(0.3, 1.2)
        )
        return axis / np.linalg.norm(axis), swing
    if kind == "slow_turn":  # there and back
        return np.array([0.0, 0.0, 1.0]), np.sin(2 * np.pi * u) + 1e-3
    if kind == "handling":
        waves = sum(rng.normal() * np.sin(2 * np.pi * f * u + rng.uniform(0, 6)) for f in (1, 2, 3, 5, 8))
        return axis / np.linalg.norm(axis), hump * waves
    if kind == "vibration":
        return axis / np.linalg.norm(axis), hump * np.sin(
            2 * np.pi * min(rng.uniform(3, 40), highest) * length * u + 0.7
        )
    if kind == "rotation":
        return np.array([0.0, 0.0, rng.choice([-1.0, 1.0])]), np.minimum(1.0, 20 * np.minimum(u, 1 - u) + 1e-3)
    if kind == "tilt":
        level = np.array([*axis[:2], 0.0])
        return level / np.linalg.norm(level), hump
    raise ValueError(f"kinds: got {kind!r}, expected some of {KINDS}")


def _turned(v: np.ndarray, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return v (3,) turned about the unit axis by each angle (n,), by Rodrigues' formula: (n, 3)."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return v * c + np.cross(axis, v) * s + axis * (axis @ v) * (1 - c)


@dataclass(frozen=True)
class Held:
    """A quantity of one axis that is held still: a reference, a resistor."""

    t: np.ndarray  # (N,) s
    x: np.ndarray  # (N,) ppm or V
    temperature: np.ndarray  # (N,) degC
    curve: np.ndarray  # (N,) truth, in the unit of x


def reference(
    seed: int,
    unit: str = "ppm",
    *,
    slope: float = 0.3,
    pace: float = 0.5,
    noise: float = 0.1,
    flicker: float = 0.03,
    interval: float = 2.0,
    hours: float = 6.0,
) -> Held:
    """Draw a voltage reference of 7 V (unit "V") or any other in "ppm", at rest in a chamber of 15 to 45 degC.

    Parameters
    ----------
    slope : float
        Of the curve [ppm/K], with a bend of a third of it.
    pace : float
        Fastest ramp [K/min].
    noise, flicker : float
        White noise of one reading, and B of the flicker (see `foreign_soaks.Noise`) [ppm].
    interval : float
        Seconds between readings.
    """
    rng = np.random.default_rng([seed, 43])
    t = np.arange(round(hours * 3600 / interval)) * interval
    T = chamber(t, pace, rng, 15.0, 45.0)
    bend = draw_curves(seed, 10 * slope, low=15.0, high=45.0, axes=1)[0]
    curve = slope * rng.choice([-1.0, 1.0]) * (T - 25) + bend(T)
    slow = _slow(Noise("flicker", flicker=flicker), len(t), interval, rng)[:, 0]
    x = curve + slow + rng.normal(size=len(t)) * noise
    T = np.round((T + rng.normal(size=len(t)) * 0.005) / 0.01) * 0.01
    if unit == "ppm":
        return Held(t, x, T, curve)
    if unit == "V":
        return Held(t, 7.0 * (1 + 1e-6 * x), T, 7.0 * (1 + 1e-6 * curve))
    raise ValueError(f"unit: got {unit!r}, expected 'ppm' or 'V'")
