"""Effects planted in measured recordings: the noise is real, and what was added is known.

The beds are a logger at rest in three placements and an oven in which there is nothing to find. A signature is
computed over the whole recording, so that a memory has a history when a part of it begins.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from loop_cases import names
from loop_cases.case import Array, Case, Prepared, write
from loop_cases.measured import CATS_UNITS, OVEN_UNITS, PPM, cats_config, oven_columns, oven_config
from loop_cases.signatures import dragged, drawn_channel, late, log_uniform, switched
from loop_cases.sources import PLACEMENTS, RAMPS, cats_columns, spans

DEG_H = np.pi / 180 / 3600  # rad/s
UNITS = {"voltage": "V", "fan": "1", "humidity": "1", "temperature_case": "degC"}


@dataclass(frozen=True)
class Bed:
    """A measured recording: its parts [s], and the ranges that hidden parameters are drawn from."""

    t: Array
    T: Array
    parts: Sequence[tuple[float, float]]
    turn_on: tuple[float, float]  # s
    memory: tuple[float, float]  # s
    play: tuple[float, float]  # K
    line: tuple[float, float]  # s
    slow: float  # s: what a channel does takes up to so long

    def since_start(self) -> Array:
        """Return the time since the part began; before the first part and between parts it does not matter."""
        starts = np.array([start for start, _ in self.parts])
        return self.t - starts[np.maximum(np.searchsorted(starts, self.t, "right") - 1, 0)]

    def inside(self) -> list[Array]:
        """Return the rows of each part."""
        return [(self.t >= start) & (self.t < stop) for start, stop in self.parts]


Planted = tuple[Array, names.Truth, dict[str, Array]]  # signature, its name, the channels that came with it
Kind = Callable[[Bed, np.random.Generator], Planted]


def _channel(bed: Bed, rng: np.random.Generator) -> Planted:
    x = drawn_channel(bed.t, rng, bed.slow)
    noisy = 5 + 0.1 * x + 0.003 * rng.normal(size=len(x))
    return x, names.linear("voltage"), {"voltage": np.round(noisy, 3)}


def _fan(bed: Bed, rng: np.random.Generator) -> Planted:
    x = switched(bed.t, rng, bed.slow / 10, bed.slow)
    return x, names.linear("fan"), {"fan": x}


def _turn_on(bed: Bed, rng: np.random.Generator) -> Planted:
    tau = log_uniform(rng, *bed.turn_on)
    return np.exp(-np.maximum(bed.since_start(), 0) / tau), names.turn_on(tau), {}


def _relaxation(bed: Bed, rng: np.random.Generator) -> Planted:
    tau = log_uniform(rng, *bed.memory)
    return bed.T - late(bed.T, tau), names.memory(tau), {}


def _play(bed: Bed, rng: np.random.Generator) -> Planted:
    width = log_uniform(rng, *bed.play)
    T = late(bed.T, 10.0)
    return dragged(T, width) - T, names.play(width), {}  # the loop alone: what follows T is the map's


def _drift(bed: Bed, rng: np.random.Generator) -> Planted:
    return bed.since_start() / 3600, names.drift(), {}


def _line(bed: Bed, rng: np.random.Generator) -> Planted:
    period = log_uniform(rng, *bed.line)
    return np.sin(2 * np.pi * bed.t / period + rng.uniform(0, 6)), names.line(period), {}


KINDS: dict[str, Kind] = {
    "channel": _channel,
    "fan": _fan,
    "turn_on": _turn_on,
    "relaxation": _relaxation,
    "play": _play,
    "drift": _drift,
    "line": _line,
}
PAIRS = (("channel", "turn_on"), ("relaxation", "fan"), ("line", "play"), ("drift", "relaxation"), ("channel", "play"))


def findable(bed: Bed, signature: Array) -> float:
    """Return the rms of a signature within the parts that a level each and a cubic in T do not take for their own."""
    rows, powers = bed.inside(), np.vander((bed.T - bed.T.mean()) / bed.T.std(), 4)[:, :3]
    own = [np.column_stack([signature, powers])[part] for part in rows]
    y, *x = np.vstack([part - part.mean(axis=0) for part in own]).T
    X = np.stack(x, axis=1)
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    return max(float(np.std(left)), 0.1 * float(np.std(y)))  # what is all but a map stays small


def plant(
    bed: Bed, kinds: Sequence[str], size: float, d: int, rng: np.random.Generator, known: Mapping[str, Kind]
) -> tuple[Array, tuple[names.Truth, ...], dict[str, Array], Array]:
    """Return the addition to the gyro (N, d), its names, channels, and signatures (N, k); `size` is a findable rms."""
    added, truths, channels, signatures = np.zeros((len(bed.t), d)), [], {}, np.empty((len(bed.t), len(kinds)))
    for k, kind in enumerate(kinds):
        signatures[:, k], truth, more = known[kind](bed, rng)
        factors = rng.choice([-1.0, 1.0], d) * rng.uniform(0.7, 1.4, d)
        added += size / findable(bed, signatures[:, k]) * signatures[:, k, None] * factors
        truths.append(truth)
        channels |= more
    channels["humidity"] = np.round(40 + 5 * drawn_channel(bed.t, rng, bed.slow), 1)  # a decoy
    if "voltage" not in channels:
        channels["voltage"] = np.round(5 + 0.1 * drawn_channel(bed.t, rng, bed.slow), 3)
    return added, tuple(truths), channels, signatures


def _in_cats(holdout: int, kinds: Sequence[str], seed: int, folder: Path) -> Prepared:
    rng = np.random.default_rng([seed, *map(ord, "".join(kinds))])
    source = cats_columns()
    bed = Bed(source["time"], source["temperature"], PLACEMENTS, (1200, 14_400), (30, 7200), (1, 6), (60, 7200), 14_400)
    added, truths, channels, _ = plant(bed, kinds, log_uniform(rng, 100, 500) * DEG_H, 3, rng, KINDS)
    columns = {
        "time": (source["time"], "s"), "gyro": (source["gyro"] + added, "rad/s"), "accel": (source["accel"], "m/s^2"),
        "temperature": (source["temperature"], "degC"),
        **{name: (values, UNITS[name]) for name, values in channels.items()},
    }  # fmt: skip
    parts = []
    for k, rows in enumerate(bed.inside(), 1):
        part = {name: (values[rows], unit) for name, (values, unit) in columns.items()}
        parts.append(str(write(folder / f"placement_{k}.h5", part)))
    judged = parts.pop(holdout - 1)
    units = {**CATS_UNITS, "gyro": "rad/s"} | {name: UNITS[name] for name in channels}
    return Prepared(cats_config(units), parts, parts, [judged], truths=truths)


def _in_oven(order: Sequence[int], kinds: Sequence[str], seed: int, folder: Path) -> Prepared:
    rng = np.random.default_rng([seed, *map(ord, "oven" + "".join(kinds))])
    columns = dict(oven_columns("control"))
    t, T = columns["time"][0], columns["temperature"][0]
    bed = Bed(t, T, spans(RAMPS), (300, 2500), (60, 3600), (0.7, 4), (60, 600), 2000)
    left = columns["gyro"][0] / PPM - np.polynomial.Polynomial.fit(T, columns["gyro"][0][:, 0] / PPM, 3)(T)[:, None]
    size = log_uniform(rng, 1, 5) * float(np.std(left)) * PPM
    added, truths, channels, _ = plant(bed, kinds, size, 1, rng, KINDS)
    columns["gyro"] = columns["gyro"][0] + added, "rad/s"
    columns |= {name: (values, UNITS[name]) for name, values in channels.items()}
    path = write(folder / "oven.h5", columns)
    parts = [[f"{path}{RAMPS[k - 1]}"] for k in order]
    units = OVEN_UNITS | {name: UNITS[name] for name in channels}
    return Prepared(oven_config("control", units), *parts, truths=truths)


def cases(seeds: Sequence[int]) -> Iterator[Case]:
    """Yield every kind in both beds once a seed, and a pair; seeds from 1000 are in the other rotations."""
    for seed in seeds:
        develop = seed < 1000
        split = "develop" if develop else "check"
        for kinds in (*((kind,) for kind in KINDS), PAIRS[seed % len(PAIRS)]):
            what = " and ".join(kinds)
            for holdout in (3,) if develop else (1, 2):
                make = partial(_in_cats, holdout, kinds, seed)
                yield Case(f"cats with {what} {seed}, holdout {holdout}", "planted", split, make,
                           bed=f"cats, holdout {holdout}")  # fmt: skip
            order = (1, 2, 3) if develop else (2, 3, 1)
            shown = "".join(map(str, order))
            yield Case(f"oven with {what} {seed}, ramps {shown}", "planted", split,
                       partial(_in_oven, order, kinds, seed), bed=f"oven control, ramps {shown}")  # fmt: skip
