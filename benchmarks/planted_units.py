"""Made-up units of six laws with planted ones among them: curves of no splines, rows with noise and walk of their own.

Bias in deg/h over -20 to 60 degC, three axes whose mean curves differ. A unit is soaked up and down, one in three of
them twice. `PLANTS` says what is done to a unit: the sizes are in units of the family's spread where they have one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from loop_cases.signatures import dragged

from driftlab.soak.blocks import SoakRows

DEG_H = np.deg2rad(1 / 3600)  # rad/s
LOW, HIGH, ROW = -20.0, 60.0, 20.0  # degC, s
LAWS = ("normal", "t3", "lognormal", "foundries", "correlated", "bends")
GRID = np.linspace(LOW, HIGH, 81)
PLAY = 4.0  # K, half width
USUAL = {"noise": (2.0, 0.1), "walk": (0.02, 0.2)}  # deg/h/sqrt(Hz), deg/h/sqrt(s): medians, deviations of logarithms


@dataclass(frozen=True, eq=False)
class Planted:
    """A unit: curve (81, 3) over GRID in deg/h, noise deg/h/sqrt(Hz), walk deg/h/sqrt(s), (3,).

    `play` (3,) is the slope in deg/h a K of a play operator of half width 4 K; `second` the curve of a second soak.
    """

    name: str
    curve: np.ndarray
    noise: np.ndarray
    walk: np.ndarray
    soaks: int
    play: np.ndarray = field(default_factory=lambda: np.zeros(3))
    second: np.ndarray | None = None
    odd: str = ""

    def rows(self, seed: int, hours: float = 3.0) -> tuple[SoakRows, ...]:
        """Return the rows of the unit's soaks, rad/s."""
        rng = np.random.default_rng([seed, int(self.name)])
        R = round(hours * 3600 / ROW)
        t = (np.arange(R) + 0.5) * ROW
        T = LOW + (HIGH - LOW) * (1 - np.cos(2 * np.pi * t / (R * ROW))) / 2
        follows, found = dragged(T, 2 * PLAY), []
        for soak in range(self.soaks):
            curve = self.second if soak and self.second is not None else self.curve
            bias = np.stack([np.interp(T, GRID, own) for own in curve.T], axis=1)
            walk = np.cumsum(self.walk * np.sqrt(ROW) * rng.normal(size=(R, 3)), axis=0)
            white = self.noise / np.sqrt(ROW) * rng.normal(size=(R, 3))
            turn_on = 2.0 * rng.normal(size=3) * (soak > 0)
            bias = bias + walk + white + turn_on + np.outer(follows - T, self.play)
            found.append(SoakRows(t, T, bias * DEG_H, np.full(R, ROW), {}))
        return tuple(found)


def mean_curves() -> np.ndarray:
    """Return the mean curves (81, 3) of the axes, deg/h."""
    u = (GRID - 20) / 40
    return np.stack([60 + 120 * u - 60 * u**2, 80 * np.sin(2 * u) - 40, 90 * u**3 - 40 * u + 20], axis=1)


def deal(law: str, count: int, seed: int) -> list[Planted]:
    """Deal ordinary units of a law."""
    rng = np.random.default_rng([seed, LAWS.index(law)])
    u, mean = (GRID - 20) / 40, mean_curves()
    shapes = np.stack([np.ones_like(u), u, np.cos(2.2 * u + 0.4), np.tanh(3 * (u - 0.3))], axis=1)
    size = np.array([33.0, 25.0, 15.0, 10.0])[:, None]
    units = []
    for k in range(count):
        a = _amounts(law, rng)
        curve = mean + shapes @ (size * a)
        if law == "bends":
            at, high = rng.normal(20, 12, 3), 20 * rng.normal(size=3)
            curve = curve + high * np.tanh((GRID[:, None] - at) / 10)
        noise, walk = (usual * np.exp(spread * rng.normal(size=3)) for usual, spread in (USUAL["noise"], USUAL["walk"]))
        units.append(Planted(f"{k:04d}", curve, noise, walk, 2 if k % 3 == 0 else 1))
    return units


def _amounts(law: str, rng: np.random.Generator) -> np.ndarray:
    """Return amounts (4, 3) of the shapes, of variance 1."""
    if law == "t3":
        return rng.standard_t(3, (4, 3)) / np.sqrt(3)
    if law == "lognormal":
        return (np.exp(0.6 * rng.normal(size=(4, 3))) - np.exp(0.18)) / 0.787
    if law == "foundries":
        return rng.choice([-0.8, 1.2], p=[0.6, 0.4]) * np.array([[1], [-1], [1], [0.5]]) + 0.4 * rng.normal(size=(4, 3))
    if law == "correlated":
        return np.sqrt(0.9) * rng.normal(size=(4, 1)) + np.sqrt(0.1) * rng.normal(size=(4, 3))
    return rng.normal(size=(4, 3))


Plant = Callable[[Planted, np.ndarray, int, np.random.Generator, list[Planted]], Planted]


def _curve(unit: Planted, axis: int, own: np.ndarray) -> Planted:
    curve = unit.curve.copy()
    curve[:, axis] = own
    return replace(unit, curve=curve)


def _swap(unit: Planted, spread: np.ndarray, axis: int, rng: np.random.Generator, others: list[Planted]) -> Planted:
    order = [0, 1, 2]
    order[axis], order[axis - 1] = order[axis - 1], order[axis]
    return replace(unit, curve=unit.curve[:, order])


def _offset(times: float) -> Plant:
    def plant(unit, spread, axis, rng, others):  # type: ignore[no-untyped-def]
        by = times * np.sqrt(np.mean(spread[:, axis] ** 2)) * rng.choice([-1, 1])
        return _curve(unit, axis, unit.curve[:, axis] + by)

    return plant


def _bump(unit: Planted, spread: np.ndarray, axis: int, rng: np.random.Generator, others: list[Planted]) -> Planted:
    at, width = rng.uniform(-5, 45), rng.uniform(5, 9)
    height = rng.choice([-1, 1]) * rng.uniform(2, 3) * np.interp(at, GRID, spread[:, axis])
    return _curve(unit, axis, unit.curve[:, axis] + height * np.exp(-(((GRID - at) / width) ** 2)))


def _times(name: str, times: float) -> Plant:
    def plant(unit, spread, axis, rng, others):  # type: ignore[no-untyped-def]
        more = np.ones(3)
        more[axis] = times
        return replace(unit, **{name: getattr(unit, name) * more})

    return plant


def _loop(unit: Planted, spread: np.ndarray, axis: int, rng: np.random.Generator, others: list[Planted]) -> Planted:
    play = np.zeros(3)
    play[axis] = 3.0 * rng.choice([-1, 1])  # 24 deg/h between up and down
    return replace(unit, play=play)


def _two(unit: Planted, spread: np.ndarray, axis: int, rng: np.random.Generator, others: list[Planted]) -> Planted:
    return replace(unit, soaks=2, second=others[int(rng.integers(len(others)))].curve)


PLANTS: dict[str, Plant] = {
    "swap": _swap,
    "sign": lambda unit, s, axis, rng, o: _curve(unit, axis, -unit.curve[:, axis]),
    "offset": _offset(6.0),
    "scale": lambda unit, s, axis, rng, o: _curve(unit, axis, float(rng.choice([2.0, 2.5])) * unit.curve[:, axis]),
    "bump": _bump,
    "walk": _times("walk", 3.0),
    "noise": _times("noise", 2.0),
    "hysteresis": _loop,
    "two units": _two,
}


def plant(units: list[Planted], kinds: list[str], seed: int) -> list[Planted]:
    """Return the units with one odd unit of each of the kinds."""
    rng = np.random.default_rng([seed, 99])
    spread = np.std([unit.curve for unit in units], axis=0)
    found = list(units)
    places = rng.choice(len(units), len(kinds), replace=False)
    ordinary = [unit for k, unit in enumerate(units) if k not in places]
    for k, kind in zip(places, kinds, strict=True):
        axis = int(rng.integers(3))
        found[k] = replace(PLANTS[kind](units[k], spread, axis, rng, ordinary), odd=f"{kind} {'xyz'[axis]}")
    return found
