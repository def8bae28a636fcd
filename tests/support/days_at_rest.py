"""Two hours at rest in a chamber, and configs that do not fit the unit; the true bias is known at every epoch."""

import numpy as np
from epochs_at_rest import DEG_H, epochs_at_rest

from driftlab.config import Config
from driftlab.evaluation.overview import scored
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from fusion_core.chunk import Chunk
from fusion_core.contracts import ThermalMap
from fusion_core.host.registry import registry

OMEGA_IE = np.array([5.51177e-5, 0.0, 4.77445e-5])  # level, x north, 40.9 deg: rate (cos, 0, sin)
WALK = 0.05 * DEG_H  # rad/s/sqrt(s)


def curve(T):
    """A bend by 160, 80 and 40 deg/h within about 4 K, as of no cubic."""
    return DEG_H * np.tanh((T - 27) / 2)[:, None] * [80, -40, 20]


def temperature(t):
    """Held, warmed by 1 K/min from 15 to 40 degC, held, cooled again."""
    return np.interp(t, [0, 900, 2400, 4200, 5700], [15.0, 15.0, 40.0, 40.0, 15.0])


def day(seed, walk=WALK, noisier=1.0, seconds=7200):
    """Return epochs of 1 s, and the true bias (N, 3)."""
    rng = np.random.default_rng(1000 + seed)
    t = np.arange(1.0, seconds + 1)
    T = temperature(t)
    bias = curve(T) + np.cumsum(rng.normal(size=(len(t), 3)), axis=0) * walk
    chunk = epochs_at_rest(t, 1.0, seed=seed, noisier=noisier, bias=bias + OMEGA_IE)
    channels = {name: chunk[name] for name in ("gyro", "accel", "tau")} | {"temperature": T}
    previous = Chunk(t[:1] - 1, {name: values[:1] for name, values in channels.items()})
    return Chunk(t, channels, previous), bias + np.array([2e-3, -1e-3, 5e-4])


def fitted(folder, kind="polynomial", **settings):
    """Fit a map on the curve itself, without noise; return what a config says of it."""
    T = np.linspace(10, 45, 3000)
    maps = registry().classes(ThermalMap)[kind].model_validate({"kind": kind, **settings})
    path = folder / f"{kind}.json"
    maps.fit(T, curve(T), {}).save(path)
    return {"kind": kind, "path": str(path), **settings}


def config(noise="3.18 deg/h/sqrt(Hz)", walk="0.05 deg/h/sqrt(s)", of_map=None, **sections):
    bias = {"kind": "random_walk", "walk": walk}
    if of_map is not None:
        bias = {"kind": "thermal_derivative", "walk": walk, "map": of_map}
    accel = {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}}
    sections = {"update_interval": "1 s", "gyro": {"noise": noise, "bias": bias}, "accel": accel, **sections}
    return Config.model_validate({"latitude": "40.9 deg", "heading": "0 deg", "filter": sections})


def run_over(settings, chunk):
    """Return the scored run, and its joined columns."""
    run = Run(settings, RunLog())
    columns = joined(run.over([chunk]))
    return scored(run, columns), columns


def true_rms(columns, name, truth):
    """Return the rms (3,) of an estimate against the true bias, over all epochs after the alignment."""
    after = np.isfinite(columns["coast"][:, 0])
    return np.sqrt(np.mean((columns[name] - truth)[after] ** 2, axis=0))
