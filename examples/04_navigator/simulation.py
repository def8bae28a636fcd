"""A vehicle that drives and stops while its inertial unit warms from 0 to 40 degC: samples, and the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from navigator import GRAVITY, Nominal
from scipy.spatial.transform import Rotation

from fusion_core import Array, Chunk, ThermalMap, registry

DT = 0.02  # s
DRIVE, STOP, CYCLES = 60.0, 12.0, 17  # s; 20 minutes
DEG_H = np.radians(1 / 3600)
ACCEL_NOISE, GYRO_NOISE = 1e-3, 20 * DEG_H  # m/s^2/sqrt(Hz), rad/s/sqrt(Hz): of a MEMS unit
ACCEL_WALK, GYRO_WALK = 2e-5, 0.3 * DEG_H  # m/s^2/sqrt(s), rad/s/sqrt(s)
ACCEL_SIGMA, GYRO_SIGMA = 0.01, 10 * DEG_H  # of the biases at the start, from the calibration and the alignment
SIGMA = np.array([0.01, 0.003, np.radians(0.1), 0.003])  # position, velocity, attitude; sway at a stop
MAP = {"kind": "polynomial", "order": 5}


def curve(T: Array) -> Array:
    """Return the bias (N, 3) of the gyro at T in degC: some 300 deg/h from 0 to 40 degC."""
    s = (T - 20.0) / 20.0
    shape = np.stack([1.2 * s - 0.5 * s**3, -s + 0.4 * s**2, 1.5 * s + 0.3 * s**2 - 0.6 * s**3], axis=-1)
    return np.asarray(150 * DEG_H * shape)


def fit_map(path: Path, seed: int = 0) -> Path:
    """Fit a map on a soak of another day, and return the path of its file."""
    rng = np.random.default_rng(10_000 + seed)
    T = np.linspace(-10.0, 50.0, 3000)
    bias = curve(T) + rng.normal(size=(len(T), 3)) * 5 * DEG_H
    registry().classes(ThermalMap)["polynomial"].model_validate(MAP).fit(T, bias, {}).save(path)
    return path


@dataclass(frozen=True)
class Drive:
    """Samples, the flags of those at which the vehicle stands for a second, and the truth."""

    chunk: Chunk
    used: Array
    truth: Nominal
    start: Nominal  # as the alignment has it, with its error


def simulate(seed: int, cycles: int = CYCLES) -> Drive:
    """Return a drive; samples are means over the step that leads to them."""
    rng = np.random.default_rng(seed)
    N = round(cycles * (DRIVE + STOP) / DT)
    t = np.arange(N + 1) * DT
    speed, yaw, standing = _profile(t, rng, cycles)
    waves = np.sin(2 * np.pi * t[:, None] / (17.0, 11.0) + rng.uniform(0, 6, 2))
    tilt = np.radians(1.5) * waves * (speed / 14)[:, None]
    C = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix()
    v = speed[:, None] * C[:, :, 0] + _sway(N + 1, rng)
    p = np.vstack([np.zeros(3), np.cumsum((v[1:] + v[:-1]) / 2, axis=0) * DT])
    T = _temperature(t, rng)
    turn_on = rng.normal(size=(2, 3)) * [[ACCEL_SIGMA], [GYRO_SIGMA]]
    walks = np.cumsum(rng.normal(size=(N + 1, 2, 3)) * np.sqrt(DT) * [[ACCEL_WALK], [GYRO_WALK]], axis=0)
    b_a, b_g = turn_on[0] + walks[:, 0], turn_on[1] + walks[:, 1] + curve(T)
    turns = Rotation.from_matrix(C[:-1].transpose(0, 2, 1) @ C[1:]).as_rotvec() / DT
    force = np.einsum("kji,kj->ki", C[1:], np.diff(v, axis=0) / DT - GRAVITY)
    white = rng.normal(size=(N, 2, 3)) / np.sqrt(DT)
    channels = {
        "gyro": turns + b_g[1:] + GYRO_NOISE * white[:, 1],
        "accel": force + b_a[1:] + ACCEL_NOISE * white[:, 0],
        "temperature": T[1:] + rng.normal(size=N) * 0.01,
        "dt": np.full(N, DT),
    }
    psi = rng.normal(size=3) * SIGMA[2]
    start = Nominal(
        p[0] + rng.normal(size=3) * SIGMA[0],
        v[0] + rng.normal(size=3) * SIGMA[1],
        Rotation.from_rotvec(psi).as_matrix().T @ C[0],
        np.zeros(3),
        curve(T[:1])[0],
    )
    every = np.arange(1, N + 1) % round(1 / DT) == 0  # once a second
    return Drive(Chunk(t[1:], channels), standing[1:] & every, Nominal(p[1:], v[1:], C[1:], b_a[1:], b_g[1:]), start)


def _profile(t: Array, rng: np.random.Generator, cycles: int) -> tuple[Array, Array, Array]:
    """Return speed [m/s], yaw [rad] and where the vehicle stands: it stops first, then drives."""
    cycle = np.minimum(t // (DRIVE + STOP), cycles - 1).astype(int)
    since = t - cycle * (DRIVE + STOP) - STOP
    ramp = np.clip(np.minimum(since, DRIVE - since) / 12.0, 0.0, 1.0)
    speed = rng.uniform(8.0, 16.0, cycles)[cycle] * (1 - np.cos(np.pi * ramp)) / 2
    rate = rng.uniform(-1, 1, (3, cycles))[:, cycle] * np.radians([[4.0], [8.0], [8.0]])
    yaw = np.cumsum((rate[0] + rate[1] * np.sin(since / 7) + rate[2] * np.sin(since / 3)) * speed / 16) * DT
    return speed, yaw, (since <= -1.0) | (cycle < 0)


def _sway(N: int, rng: np.random.Generator) -> Array:
    """Return the velocity (N, 3) of the body on its springs: correlated over 0.1 s."""
    from scipy.signal import lfilter

    a = np.exp(-DT / 0.1)
    first = rng.normal(size=(1, 3)) * SIGMA[3]
    noise = rng.normal(size=(N - 1, 3)) * SIGMA[3] * np.sqrt(1 - a**2)
    return np.asarray(lfilter([1.0], [1.0, -a], np.vstack([first, noise]), axis=0))


def _temperature(t: Array, rng: np.random.Generator) -> Array:
    """Return T in degC: the two time constants of a cabin and of the unit in it, and draughts at each stop."""
    rise = 1 - 0.7 * np.exp(-t / 500.0) - 0.3 * np.exp(-t / 120.0)
    draught = 0.4 * np.sin(2 * np.pi * t / (DRIVE + STOP) + rng.uniform(0, 6)) * (1 - np.exp(-t / 60.0))
    return np.asarray(40.0 * rise / (1 - 0.7 * np.exp(-1224.0 / 500.0)) + draught)
