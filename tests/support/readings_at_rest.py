"""Single readings of a steep unit at rest under a coarse thermometer; the true bias is known at every epoch."""

from dataclasses import replace

import numpy as np

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.recordings.epochs import epochs
from fusion_core.chunk import Chunk
from fusion_plugins.thermal_maps.polynomial import Polynomial

DEG_H = np.deg2rad(1) / 3600
NOISE, WALK, SLOPE = 1.2e-6, 1e-9, 4e-6  # of a fibre-optic gyro, and rad/s/K
DT = 0.1  # s


def curve(T):
    """A parabola: three axes, each a little less steep."""
    return SLOPE * np.outer((T - 20) * (1 + (T - 20) / 60), [1.0, -0.8, 0.6])


def errors(seed, step, noise, interval, *, sizes=False):
    """Return error over sigma of running estimate and coast (2, n), from a quarter of an hour on; `sizes`: errors."""
    rng = np.random.default_rng(seed)
    t = np.arange(1, 72_000) * DT
    knots = [0, 600, 2100, 2700, 4200, 4800, 6300, 7200]  # rests and ramps of up to 1 K/min
    T = np.interp(t, knots, np.repeat(rng.uniform(8, 32, 4), 2))
    a = np.ones(1200) / 1200
    T = np.convolve(np.concatenate([np.full(1199, T[0]), T]), a, mode="valid")  # no body follows at once
    bias = curve(T) + np.cumsum(rng.normal(size=(len(t), 3)), axis=0) * WALK * np.sqrt(DT)
    gyro = bias + rng.normal(size=bias.shape) * NOISE / np.sqrt(DT)
    read = T + noise * rng.normal(size=len(T))
    read = np.round(read / step) * step if step else read
    at = np.linspace(0, 40, 4000)
    fitted = Polynomial(order=2, outside="tangent").fit(at, curve(at), {})
    known = replace(fitted, record=fitted.record.model_copy(update={"resolution": step, "dither": noise}))
    run = Run(config(interval, Polynomial(order=2, outside="tangent").with_fitted(known)), RunLog())
    rows = Chunk(t, {"gyro": gyro, "temperature": read}, sensors=frozenset({"gyro"}))
    found = joined(run.over(epochs([rows], interval)))
    late = found["t"] > 900
    truth = bias[np.searchsorted(t, found["t"] - 1e-6)][late]
    each = [found[name][late] - truth for name in ("bias", "coast")]
    if not sizes:
        each = [e / found[f"{name}_sigma"][late] for e, name in zip(each, ("bias", "coast"), strict=True)]
    return np.stack([e[:: max(1, round(30 / interval))].ravel() for e in each])


def config(interval, held):
    """Return a gyro alone, whose bias follows a map that is in memory."""
    bias = {"kind": "thermal_derivative", "walk": WALK, "map": {"kind": "polynomial", "order": 2}}
    settings = Config.model_validate(
        {"filter": {"update_interval": f"{interval} s", "accel": None, "gyro": {"noise": NOISE, "bias": bias}}}
    )
    model = settings.filter
    following = model.gyro.bias.having(map=held)
    return settings.model_copy(update={"filter": model.with_tracked(bias=following)})
