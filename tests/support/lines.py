"""Records of units of a line that nobody measured: figures with known laws, and steps where one plants them."""

import numpy as np

from driftlab.family.record import FIGURES, Figure, UnitRecord

DEG_H = np.deg2rad(1) / 3600
TYPICAL = {"residual": 0.4, "noise": 2.0, "walk": 0.02, "swing": 300.0, "coast": 4.0}
SPREAD = {"residual": 0.1, "noise": 0.1, "walk": 0.2, "swing": 0.2, "coast": 0.6}  # of the logarithm
AXES = ("x", "y", "z")


def line(count, seed=0, *, lots=10, law="normal", sigma=0.0, planted=()):
    """Return the records of a line; planted: (quantity, axis, from unit, to unit, spreads) each."""
    rng = np.random.default_rng([seed, count])
    draw = {
        "normal": lambda shape: rng.normal(size=shape),
        "heavy": lambda shape: rng.standard_t(3, size=shape) / np.sqrt(3),
        "skew": lambda shape: rng.exponential(size=shape) - 1,
    }[law]
    z = {name: draw((count, 3)) for name in FIGURES}
    for name, axis, start, stop, spreads in planted:
        z[name][start:stop, AXES.index(axis)] += spreads
    values = {name: TYPICAL[name] * np.exp(SPREAD[name] * z[name]) * DEG_H for name in FIGURES}
    return [
        record(k, {name: values[name][k] for name in FIGURES}, f"L{k * lots // count:02d}", sigma) for k in range(count)
    ]


def record(k, figures, lot="", sigma=0.0, **more):
    """Return the record of a unit that is done; `sigma` is a share of each figure."""
    held = {
        name: Figure(value=tuple(map(float, v)), sigma=tuple(float(sigma * one) or None for one in v))
        for name, v in figures.items()
    }
    date = str(np.datetime64("2026-01-05") + np.timedelta64(k, "D"))
    known = {
        "key": "k", "unit": f"{k:04d}", "lot": lot, "date": date, "state": "done", "channel": "gyro",
        "bias_unit": "rad/s", "axes": AXES, "domain": (-20.0, 60.0), "hours": 2.0, "samples": 7200, "figures": held,
        "seconds": 0.2, "driftlab": "0.1.0",
    }  # fmt: skip
    return UnitRecord(**{**known, **more})
