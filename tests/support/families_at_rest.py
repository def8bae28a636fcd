"""Families of units as rows of their soaks: the example's, and of other types; effects planted in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import family
import numpy as np
from scipy.signal import lfilter

from driftlab.family.basis import STEP
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import densities_of
from driftlab.identification.candidates import installed
from driftlab.soak.blocks import SoakRows
from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect

AXES = ("x", "y", "z")
DEG_H = family.DEG_H
SPAN = 10  # s, of a row
COLOURS = ("white", "changing", "coloured")


def effect_of(kind: str, **settings: Any) -> Effect:
    """Return an effect for three axes, hyper-parameters in SI."""
    cls = next(cls for cls in installed() if cls.model_fields["kind"].default == kind)
    return cls(axes=AXES).model_copy(update=settings)  # type: ignore[call-arg]


def soaked_of(name: str, rows: SoakRows) -> UnitInformation:
    """Return what rows say, with the noise that is found in them."""
    found = densities_of([rows], STEP)
    return UnitInformation.of(name, AXES, [rows], found.white, found.likely, STEP)


def rows_of(unit: family.Unit, seed: int) -> SoakRows:
    """Return the rows of a soak of a unit of the example."""
    recording = family.soak(unit, seed=seed)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(values.reshape(-1, SPAN, *values.shape[1:]).mean(axis=1))

    earth = family.EARTH * np.array([np.cos(family.LATITUDE), 0.0, np.sin(family.LATITUDE)])
    t = mean(recording["time"])
    return SoakRows(
        t, mean(recording["temperature"]), mean(recording["gyro"]) - earth, np.full(len(t), float(SPAN)), {}
    )


def planted(
    units: Sequence[family.Unit], effect: Effect, sizes: np.ndarray, seed: int, *, late: float = 0.0
) -> list[tuple[UnitInformation, str]]:
    """Return soaks of units of the example with coefficients (n, 3), deg/h a unit of the effect; a lag has none."""
    found = []
    for unit, size in zip(units, sizes, strict=True):
        rows = rows_of(unit, seed)
        T = family.LOW + (family.HIGH - family.LOW) * (1 - np.cos(2 * np.pi * rows.t / 7199.0)) / 2
        chunk = Chunk(rows.t, {"temperature": T})
        if effect.acts_on_input:
            more = unit.bias(effect.input(chunk, None)[0]) - unit.bias(T)
        else:
            more = np.einsum("rdq,q->rd", effect.signature(chunk, None)[0], size) * DEG_H
        found.append((soaked_of(unit.name, replace(rows, bias=rows.bias + more)), unit.lot))
    return found


def soaked(units: Sequence[family.Unit], seed: int) -> list[tuple[UnitInformation, str]]:
    """Return the soaks of units of the example with their lots."""
    return [(soaked_of(unit.name, rows_of(unit, seed)), unit.lot) for unit in units]


def of_other_type(count: int, seed: int, colour: str = "white") -> list[tuple[UnitInformation, str]]:
    """Return a family without any effect, of no type that another seed has.

    Its shapes, how many there are, how they are correlated between axes, its range and programme, whether it has a kink
    are drawn; noises differ by factors from unit to unit; `changing` noise grows with the temperature's rate,
    `coloured` has a third part with a correlation time.
    """
    rng = np.random.default_rng([seed, 7])
    N = int(rng.choice([480, 720, 1080]))
    t = SPAN * (np.arange(N) + 0.5)
    low = rng.uniform(-40, 20)
    high = low + rng.uniform(40, 90)
    T = low + (high - low) * _programme(str(rng.choice(["round", "ramp", "steps", "twice", "uneven"])), t)
    modes, kink, at = int(rng.integers(1, 7)), rng.choice([0.0, 60.0]), rng.uniform(-0.6, 0.6)
    bends, phases = rng.uniform(0.3, 6, modes), rng.uniform(0, 6, modes)
    mixed = 0.5 * rng.normal(size=(3 * modes, 3 * modes)) + np.eye(3 * modes)
    heavy = bool(rng.integers(2))
    rate = np.abs(np.gradient(T, t))
    swell = 0.5 + 2 * rate[:, None] / rate.max() if colour == "changing" else np.ones((N, 1))
    found = []
    for k in range(count):
        own = T + 0.3 * rng.normal() + 0.01 * rng.normal(size=N)
        u = (own - (low + high) / 2) / ((high - low) / 2)
        dealt = rng.standard_t(4, 3 * modes) if heavy else rng.normal(size=3 * modes)
        shapes = np.cos(np.outer(u, bends) + phases)
        bias = shapes @ (mixed @ dealt).reshape(modes, 3) * rng.uniform(10, 60) + 50 * u[:, None]
        bias += kink * np.abs(u - at)[:, None]
        white, walk = 2 * np.exp(0.5 * rng.normal(size=3)), 0.02 * np.exp(0.8 * rng.normal(size=3))
        bias += swell * white * rng.normal(size=(N, 3)) / np.sqrt(SPAN)
        bias += np.cumsum(swell * walk * rng.normal(size=(N, 3)) * np.sqrt(SPAN), axis=0)
        if colour == "coloured":
            keep = np.exp(-SPAN / rng.uniform(60, 1500))
            drawn = white * np.sqrt((1 - keep**2) / SPAN) * rng.uniform(0.3, 1.2) * rng.normal(size=(N, 3))
            bias += lfilter([1.0], [1.0, -keep], drawn, axis=0)
        rows = SoakRows(t, own + 0.006 * rng.normal(size=N), bias * DEG_H, np.full(N, float(SPAN)), {})
        found.append((soaked_of(f"{k:04d}", rows), f"L{k * 5 // count}"))
    return found


def _programme(kind: str, t: np.ndarray) -> np.ndarray:
    x = t / t[-1]
    if kind == "round":
        return np.asarray((1 - np.cos(2 * np.pi * x)) / 2)
    if kind == "twice":
        return np.asarray((1 - np.cos(4 * np.pi * x)) / 2)
    if kind == "uneven":
        return np.where(x < 0.7, x / 0.7, (1 - x) / 0.3)
    ramp = 1 - np.abs(2 * x - 1)
    keep = np.exp(-SPAN / 300.0)
    return np.asarray(ramp if kind == "ramp" else lfilter([1 - keep], [1, -keep], np.round(5 * ramp) / 5))
