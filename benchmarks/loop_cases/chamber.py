"""Simulated units in a chamber: those of the tests, and kinds whose hidden parameters are drawn."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from loop_cases import names
from loop_cases.case import Array, Case, Prepared
from loop_cases.oracle import Told, error_of_told
from loop_cases.signatures import late, log_uniform, wandering
from loop_cases.sources import ROOT

sys.path.insert(0, str(ROOT / "tests" / "support"))
import units_with_effects as maker

TRUTHS = {
    "hysteresis": lambda unit: names.play(9.0),
    "thermal_lag": lambda unit: names.late_map(150.0),
    "turn_on": lambda unit: names.turn_on(700.0),
    "drift": lambda unit: names.drift(),
    "thermal_rate": lambda unit: names.rate(),
    "channel": lambda unit: names.linear("voltage"),
    "interaction": lambda unit: names.product("voltage", "temperature"),
    "square": lambda unit: names.square("flow"),
    "periodic": lambda unit: names.line(97.0),
    "late": lambda unit: names.late_channel("flow", 900.0),
    "gradient": lambda unit: names.difference("temperature_case"),
    "telegraph": lambda unit: names.nameless("telegraph"),
    "shupe": lambda unit: names.shupe("temperature_case"),
    "relaxation": lambda unit: names.memory(unit.hidden["relaxation"]),
    "warm_up": lambda unit: names.turn_on(unit.hidden["warm_up"]),
}
AUXILIARY = {"gradient": ("temperature_case", "voltage"), "shupe": ("temperature_case", "pressure")}
SEVERAL = (("thermal_lag", "turn_on"), ("hysteresis", "channel"), ("relaxation", "channel", "warm_up"),
           ("shupe", "periodic"), ("interaction", "drift"), ("gradient", "hysteresis"))  # fmt: skip


class Unit(maker.Unit):
    """A unit of the tests that keeps what an oracle is told, and knows a few more effects."""

    def __init__(self, seed: int, effects: Sequence[str], channels: Sequence[str]) -> None:
        super().__init__(seed, effects, channels)
        self.scales: dict[str, float] = {}
        drawn = np.random.default_rng([seed, 1])
        self.hidden = {"relaxation": log_uniform(drawn, 60, 2500), "warm_up": log_uniform(drawn, 200, 1800),
                       "shupe": log_uniform(drawn, 20, 80)}  # fmt: skip

    def auxiliary(self, t: Array, T: Array) -> dict[str, tuple[Array, str]]:
        """Return the channels of the tests, without the transient that their noise begins with."""
        r, n = self.rng, len(t)
        telegraph = np.sign(np.sin(2 * np.pi * t / r.uniform(2000, 5000) + r.uniform(0, 6)))
        made = {
            "voltage": (5 + 0.4 * telegraph + 0.1 * wandering(n, r, 600.0), "V"),
            "pressure": (1013 + 15 * wandering(n, r, 2000.0), "hPa"),
            "flow": (2 + 0.5 * wandering(n, r, 400.0), "1"),
            "temperature_case": (T + 180 * np.gradient(T, t) + 0.2 * wandering(n, r, 300.0), "degC"),
        }
        return {name: made[name] for name in self.channels}

    def part(self, effect: str, t: Array, T: Array, extra: Any) -> Array:
        tau = self.hidden.get(effect, 0.0)
        if effect == "relaxation":
            shape = T - late(T, tau)
            found = 1e-4 * shape / self.scale(effect, shape)
        elif effect == "warm_up":
            found = 2e-4 * np.exp(-t / tau)
        elif effect == "shupe":
            rate = np.gradient(late(extra["temperature_case"][0] - T, tau), t)
            found = 5e-5 * rate / self.scale(effect, rate)
        else:
            found = super().part(effect, t, T, extra)
        self.parts.append(found)
        return found

    def scale(self, effect: str, shape: Array) -> float:
        """Return the deviation of an effect's shape in the first recording: one unit has one coefficient."""
        return self.scales.setdefault(effect, float(np.std(shape)))

    def record(self, path: Path, t: Array, T: Array) -> Array:
        """Write one recording; keep what the oracle is told of it; return its true bias."""
        self.parts: list[Array] = []
        bias = super().record(path, t, T)
        seen = late(T, 150.0) if "thermal_lag" in self.effects else T
        with h5py.File(path) as file:
            z = np.deg2rad(file["gyro"][()])
        S = np.stack(self.parts, axis=1) if self.parts else np.empty((len(t), 0))
        self.told = Told(z, seen, S[:, np.any(S != 0, axis=0)])
        return bias


def _made(effects: Sequence[str], seed: int, folder: Path) -> Prepared:
    kinds = [AUXILIARY.get(effect, ("voltage", "pressure", "flow")) for effect in effects]
    channels = tuple(dict.fromkeys(name for kind in kinds for name in kind)) or ("voltage", "pressure", "flow")
    if not effects and seed % 2:
        channels = (*channels, "temperature_case")
    unit = Unit(seed, tuple(effects), channels)
    profiles = {"soak": maker.soak(2.4), "train": maker.day(1.8, unit.rng), "holdout": maker.day(1.6, unit.rng)}
    told, bias = {}, np.empty(0)
    for name, profile in profiles.items():
        bias = unit.record(folder / f"{name}.h5", *profile)
        told[name] = unit.told
    units = {"voltage": "V", "pressure": "hPa", "flow": '"1"', "temperature_case": "degC"}
    named = "\n".join(f"    {name}: {{path: {name}, unit: {units[name]}}}" for name in channels)
    truths = tuple(TRUTHS[effect](unit) for effect in effects)
    oracle = error_of_told([told["soak"], told["train"]], told["holdout"], bias)
    if "telegraph" in effects:
        oracle = None  # nobody can be told it
    parts = [[str(folder / f"{name}.h5")] for name in profiles]
    config = yaml.safe_load(maker.CONFIG.format(channels=named))
    return Prepared(config, *parts, truths=truths, bias=(profiles["holdout"][0], bias), oracle=oracle)


def cases(seeds: Sequence[int]) -> Iterator[Case]:
    """Yield a unit of each kind, one with several, and one without, once a seed."""
    for seed in seeds:
        split = "develop" if seed < 1000 else "check"
        for effects in (*((effect,) for effect in TRUTHS), SEVERAL[seed % len(SEVERAL)], ()):
            what, group = " and ".join(effects) or "nothing", "simulated" if effects else "control"
            yield Case(f"chamber, {what} {seed}", group, split, partial(_made, effects, seed))
