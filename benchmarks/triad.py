"""Scale factor and misalignment of a triad over temperature, against units that are simulated by code of their own.

python benchmarks/triad.py sigma    # how many of 50 turntables and tumbles are within their sigma
python benchmarks/triad.py warm_up  # the angle that a rotating unit is off after a warm-up, by what its map holds
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import driftlab

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from turned_units import Readings, bias_of, matrix_of, sensor_frame, tumble, turntable

SEEDS, TEMPERATURES, AT = 50, [-20.0, 0.0, 20.0, 40.0, 60.0], np.array([-20.0, 20.0, 60.0])
TERMS, GRAVITY = "bias,scale,misalignment", 9.80665
GYRO = {
    "noise": "8e-5 rad/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)"},
    "calibration": {"kind": "polynomial"},
}  # fmt: skip
ACCEL = {"noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 m/s^2/sqrt(s)"}}


def turned(seed, temperatures=TEMPERATURES, terms=TERMS, **how):
    """Return the map that fit-map makes of a turntable's recording."""
    t, y, T, table = turntable(seed, temperatures, **how)
    data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        path.write_text(table)
        stimulus = {"kind": "rate_table", "segments": str(path)}
        return driftlab.fit_map({"filter": {"gyro": GYRO}, "stimulus": stimulus}, data, terms=terms)


def tumbled(seed):
    """Return the map that fit-map makes of a tumble in a chamber."""
    t, y, T = tumble(seed, TEMPERATURES)
    accel = {**ACCEL, "calibration": {"kind": "polynomial"}}
    config = {
        "filter": {"track": "accel", "gyro": GYRO, "accel": accel},
        "stimulus": {"kind": "tumble", "gravity": f"{GRAVITY} m/s^2"},
    }
    still = np.random.default_rng(seed).normal(0, 1e-3, y.shape)
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (still, "rad/s"), "temperature": (T, "degC")}
    return driftlab.fit_map(config, data, terms=TERMS)


def sigma():
    """Print the share of the terms within one and 1.96 sigma, and the largest sigma."""
    cases = {"turntable": (turned, lambda M: M, np.deg2rad(1.0)), "tumble": (tumbled, sensor_frame, 0.3)}
    for name, (fitted, frame, size) in cases.items():
        truth = np.array([np.concatenate([bias_of(T, size), frame(matrix_of(T)).ravel()]) for T in AT])
        z, largest = [], 0.0
        for seed in range(SEEDS):
            fit = fitted(seed).fit
            z.append(((fit.terms.at(AT) - truth) / fit.sigma(AT))[:, fit.free])
            largest = max(largest, float(np.max(fit.sigma(AT)[:, 3:])))
        z = np.abs(np.array(z))
        print(
            f"{name}: {SEEDS} seeds, {z.shape[2]} terms at {len(AT)} temperatures: within one sigma "
            f"{np.mean(z < 1):.1%}, within 1.96 {np.mean(z < 1.96):.1%}; largest sigma of M {largest * 1e6:.0f} ppm"
        )


def moving_scale(T):
    """M of a unit whose scale factors move by 1 % over 60 K."""
    return matrix_of(20.0) + np.eye(3) * 0.01 * (T - 20.0) / 60.0


def warm_up():
    """Print the error of the angle after half an hour at 10 deg/s about z, from 0 to 60 degC."""
    over_T, at_one = (turned(0, T, matrix=moving_scale) for T in ([0.0, 15.0, 30.0, 45.0, 60.0], [25.0] * 3))
    made, seconds, rate = Readings(1, 10.0, 8e-5, 1e-6, np.deg2rad(1.0)), 1800, np.deg2rad(10.0)
    for k in range(seconds):
        T = 60 * (1 - np.exp(-k / 400)) / (1 - np.exp(-seconds / 400))
        made.stretch(1.0, [0.0, 0.0, rate], T, moving_scale(T))
    _, y, T = made.arrays()
    bias = over_T.map.bias(T)
    constant = np.linalg.solve(np.eye(3) + at_one.fit.terms.matrix(np.array([25.0]))[0], (y - bias).T).T
    rows = {"bias over temperature alone": y - bias, "and scale and misalignment at 25 °C": constant,
            "and scale and misalignment over temperature": over_T.map.corrected(y, T)}  # fmt: skip
    print(f"{np.rad2deg(rate) * seconds:.0f} deg turned about z from 0 to 60 °C in 30 min; error of the angle, deg")
    for name, omega in rows.items():
        error = np.rad2deg((omega - [0.0, 0.0, rate]).sum(axis=0) * made.dt)
        print(f"  {name:45s} about z {error[2]:+9.3f}   across {np.hypot(*error[:2]):8.3f}")


if __name__ == "__main__":
    {"sigma": sigma, "warm_up": warm_up}[sys.argv[1]]()
