"""Simulated units in the field: flicker noise, a coarse thermometer, and a past that no recording shows.

The unit is on all day; a recording is a part of it, so that whatever remembers does not begin in equilibrium. Noise is
white plus 1/f over 10 s to 10 h, which no random walk is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from loop_cases import names
from loop_cases.case import Array, Case, Prepared, config_of, follows, write
from loop_cases.oracle import Told, error_of_told
from loop_cases.planted import KINDS, PAIRS, UNITS, Bed, Planted, plant
from loop_cases.signatures import drawn_channel, flicker, late, log_uniform, wandering

PARTS = ((10_800.0, 21_600.0), (32_400.0, 41_400.0), (54_000.0, 63_000.0))  # s: calibration, train, holdout
WHITE = 6e-5  # rad/s/sqrt(Hz); so much that no effect is taken for motion
SIZES = 4e-5, 1.2e-4  # rad/s


def _rate(bed: Bed, rng: np.random.Generator) -> Planted:
    return np.gradient(bed.T, bed.t), names.rate(), {}


def _voltage(bed: Bed, rng: np.random.Generator) -> tuple[Array, dict[str, Array]]:
    x = drawn_channel(bed.t, rng, bed.slow)
    return x, {"voltage": np.round(5 + 0.2 * x, 3)}


def _product(bed: Bed, rng: np.random.Generator) -> Planted:
    x, made = _voltage(bed, rng)
    return x * (bed.T - np.mean(bed.T)), names.product("voltage", "temperature"), made


def _square(bed: Bed, rng: np.random.Generator) -> Planted:
    x, made = _voltage(bed, rng)
    return x**2, names.square("voltage"), made


def _late_channel(bed: Bed, rng: np.random.Generator) -> Planted:
    x, made = _voltage(bed, rng)
    tau = log_uniform(rng, 150, 1500)
    return late(x, tau), names.late_channel("voltage", tau), made


def _case(bed: Bed, rng: np.random.Generator) -> Array:
    """Return the temperature of a case: it leads or lags, and the wind moves it."""
    lag = log_uniform(rng, 200, 900)
    return late(bed.T, lag) + late(0.8 * wandering(len(bed.T), rng, 400.0), 30.0)


def _gradient(bed: Bed, rng: np.random.Generator) -> Planted:
    outside = _case(bed, rng)
    made = {"temperature_case": np.round(outside * 16) / 16}
    return outside - bed.T, names.difference("temperature_case"), made


def _shupe(bed: Bed, rng: np.random.Generator) -> Planted:
    outside = _case(bed, rng)
    made = {"temperature_case": np.round(outside * 16) / 16}
    rate = np.gradient(late(outside - bed.T, log_uniform(rng, 20, 80)), bed.t)
    return rate, names.shupe("temperature_case"), made


MORE = {"rate": _rate, "product": _product, "square": _square, "late channel": _late_channel, "gradient": _gradient,
        "shupe": _shupe}  # fmt: skip


def weather(t: Array, rng: np.random.Generator) -> Array:
    """Return the temperature of the day: slow waves, ramps and holds, through the unit's own mass."""
    knots, values = [t[0]], [rng.uniform(0, 30)]
    while knots[-1] < t[-1]:
        goal = rng.uniform(-8, 42)
        knots += [knots[-1] + abs(goal - values[-1]) / rng.uniform(0.004, 0.03), 0.0]
        knots[-1] = knots[-2] + rng.uniform(100, 1500)
        values += [goal, goal]
    wave = 2 * np.sin(2 * np.pi * t / rng.uniform(2000, 7000))
    return late(np.interp(t, knots, values) + wave, log_uniform(rng, 60, 400))


def _bias(T: Array, seed: int, rng: np.random.Generator) -> Array:
    """Return map and flicker noise (N, 3): a cubic for odd seeds, with a bend for even ones."""
    x = ((T - 17) / 25)[:, None]
    found = x * rng.normal(0, 2e-4, 3) + x**2 * rng.normal(0, 1e-4, 3) + x**3 * rng.normal(0, 5e-5, 3)
    if seed % 2 == 0:
        found = found + rng.normal(0, 6e-5, 3) * np.tanh((x - rng.uniform(-0.6, 0.6, 3)) / rng.uniform(0.08, 0.2, 3))
    floor = log_uniform(rng, 3e-6, 8e-6)
    return found + floor * np.stack([flicker(len(T), rng) for _ in range(3)], axis=1)


def _made(kinds: Sequence[str], seed: int, folder: Path) -> Prepared:
    rng = np.random.default_rng([seed, *map(ord, "field" + "".join(kinds))])
    t = np.arange(0.0, PARTS[-1][1])
    T = weather(t, rng)
    bed = Bed(t, T, PARTS, (200, 2500), (40, 3000), (3, 12), (40, 1200), 3000)
    added, truths, channels, S = plant(bed, kinds, log_uniform(rng, *SIZES), 3, rng, KINDS | MORE)
    bias = _bias(T, seed, rng) + added
    gyro = bias + WHITE * rng.normal(size=bias.shape)
    step = rng.choice([0.0625, 0.1, 0.125])
    seen = np.round((T + 0.02 * rng.normal(size=len(T))) / step) * step
    columns = {"time": (t, "s"), "gyro": (gyro, "rad/s"), "temperature": (seen, "degC"),
               **{name: (values, UNITS[name]) for name, values in channels.items()}}  # fmt: skip
    parts, told = [], []
    for name, rows in zip(("calibration", "train", "holdout"), bed.inside(), strict=True):
        part = {column: (values[rows], unit) for column, (values, unit) in columns.items()}
        parts.append([str(write(folder / f"{name}.h5", part))])
        told.append(Told(gyro[rows], T[rows], S[rows]))
    rows = bed.inside()[2]
    curve = {"kind": "polynomial", "order": 3, "outside": "clamp"} if seed % 2 else {"kind": "spline"}
    units = {name: unit for name, (_, unit) in columns.items()}
    config = config_of(units, follows(f"{WHITE} rad/s/sqrt(Hz)", "1e-7 rad/s/sqrt(s)", curve))
    oracle = error_of_told(told[:2], told[2], bias[rows])
    return Prepared(config, *parts, truths=truths, bias=(t[rows], bias[rows]), oracle=oracle)


def cases(seeds: Sequence[int]) -> Iterator[Case]:
    """Yield a unit of each kind, one with two, and one without, once a seed."""
    for seed in seeds:
        split = "develop" if seed < 1000 else "check"
        for kinds in (*((kind,) for kind in KINDS | MORE), PAIRS[(seed + 2) % len(PAIRS)], ()):
            what, group = " and ".join(kinds) or "nothing", "simulated" if kinds else "control"
            yield Case(f"field, {what} {seed}", group, split, partial(_made, kinds, seed))
