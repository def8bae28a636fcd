"""An error of scale of accelerometers in several placements is named as one, and no other effect is.

The units are simulated here, sample by sample, and share nothing with the search.
"""

import json

import h5py
import numpy as np
import pytest
import yaml
from loop_cases.signatures import dragged

import driftlab

G, STEP = 9.80665, 10.0
PLACEMENTS = {"z_up": (0, 0, 1), "x_up": (1, 0, 0), "y_down": (0, -1, 0), "z_down": (0, 0, -1), "y_up": (0, 1, 0)}
DAYS = [  # hours and degC at the corners of a profile
    ([0, 0.3, 2, 2.3, 4], [10, 10, 45, 45, 10]),
    ([0, 0.2, 1.5, 1.8, 3], [15, 15, 42, 42, 20]),
    ([0, 0.2, 1.2, 1.5, 2.6, 3], [40, 40, 14, 14, 38, 38]),
]
UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
SCALE = np.array([2e-4, -1.5e-4, 1e-4])  # 1/K
CONFIG = {
    "source": {"kind": "hdf5", "channels": {name: {"path": name, "unit": unit} for name, unit in UNITS.items()}},
    "filter": {
        "update_interval": "10 s",
        "align": "300 s",
        "gyro": {"noise": "2e-5 rad/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-8 rad/s/sqrt(s)"}},
        "accel": {
            "noise": "1e-3 m/s^2/sqrt(Hz)",
            "bias": {"kind": "thermal_derivative", "walk": "2e-6 m/s^2/sqrt(s)", "map": {"kind": "spline"}},
        },
    },
}


def days(folder, seed, scale=0.0, memory=0.0):
    """Write a recording of each placement; `scale` (3,) in 1/K, `memory` in m/s^2/K of a play of 6 K."""
    rng, paths = np.random.default_rng(seed), []
    for k, (name, up) in enumerate(PLACEMENTS.items()):
        hours, corners = DAYS[k % 3]
        t = np.arange(0.0, hours[-1] * 3600, STEP)
        T = np.interp(t / 3600, hours, corners)
        x = (T - 25) / 20
        bias = G * 1e-3 * np.stack([2 * x + 0.6 * x**2, -1.5 * x + 0.4 * x**3, x - 0.8 * x**2], axis=1)
        u = G * np.array(up, float) + G * np.cross(rng.normal(0, 2e-3, 3), up)  # not quite upright
        u *= G / np.linalg.norm(u)
        drift = rng.normal(0, 3e-3, 3) + np.cumsum(rng.normal(0, 2e-6 * np.sqrt(STEP), (len(t), 3)), axis=0)
        noise = 1e-3 / np.sqrt(STEP) * rng.normal(size=(len(t), 3))
        accel = u + u * scale * (T - 25)[:, None] + bias + memory * (dragged(T, 6.0) - T)[:, None] + drift + noise
        gyro = 2e-5 / np.sqrt(STEP) * rng.normal(size=(len(t), 3))
        with h5py.File(folder / f"{name}.h5", "w") as file:
            for channel, values in (("time", t), ("gyro", gyro), ("accel", accel), ("temperature", T)):
                file[channel] = values
        paths.append(str(folder / f"{name}.h5"))
    return paths


def explained(folder, **planted):
    paths = days(folder, 1, **planted)
    driftlab.explain(yaml.safe_dump(CONFIG), paths[:1], paths[1:4], paths[4:], out=folder / "out", channel="accel")
    return json.loads((folder / "out" / "loop.json").read_text())


def test_a_scale_factor_that_moves_with_temperature_is_named_and_measured(tmp_path):
    found = explained(tmp_path, scale=SCALE)
    assert found["verdict"] == "explained"
    (effect,) = found["effects"]
    assert effect["kind"] == "scale_factor"
    c, sigma = (np.array([effect[key][f"{axis}_scale_per_K"] for axis in "xyz"]) for key in ("coefficients", "sigma"))
    assert np.all(sigma < 2e-6)
    assert np.all(np.abs(c - SCALE) < 4 * sigma)
    before, after = (np.array(found[side]["coast_rmse"]) for side in ("before", "after"))
    assert np.all(after[1:] < 0.1 * before[1:])  # x is level in the last placement, and y the other way up than before


@pytest.mark.parametrize("memory", [0.0, 2e-3], ids=["nothing", "a hysteresis"])
def test_it_is_not_named_where_another_effect_or_none_is_planted(memory, tmp_path):
    found = explained(tmp_path, memory=memory)
    assert [effect["kind"] for effect in found["effects"]] == (["hysteresis"] if memory else [])
