"""Production lines of about a hundred units over six laws, with odd ones planted: in plain NumPy, no project code.

    unit = mean curve of the line (T) + shape of its own (T) + level of its own        [rad/s], each axis
    soak = unit + level since power-up + white noise + walk

A law says how levels and shapes spread over the line. Its spread at a temperature is the standard deviation of the
curves there; `Line.spread` and `Line.level_spread` are of this very line's law, estimated from 4,000 units of it.
An odd unit is planted at `times` this spread: its own deviation is pushed further out along what is odd in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from foreign_soaks import DEG_H, Noise, _slow, behind, opening, play

LOW, HIGH = -20.0, 50.0  # degC
GRID = np.linspace(LOW, HIGH, 141)
LAWS = ("normal", "t3", "log-normal", "foundries", "correlated", "phase")
ODD = ("swapped", "sign", "offset", "scale", "bump", "walk", "noise", "hysteresis", "two_units")
SHAPE = 20 * DEG_H  # rms over T of the shapes' spread
LEVEL = 60 * DEG_H  # spread of the levels
WHITE, WALK = 5 * DEG_H, 0.02 * DEG_H  # rad/s/sqrt(Hz), rad/s/sqrt(s): medians of the line


@dataclass(frozen=True)
class Unit:
    """One unit: its truth. `curve` is over GRID (141, 3) with its level [rad/s]; `white`, `walk` (3,)."""

    name: str
    curve: np.ndarray
    white: np.ndarray
    walk: np.ndarray
    odd: str = ""  # one of ODD, or empty
    axis: int = -1  # the axis that is odd, -1 where several are
    times: float = 0.0  # size of what is odd, in spreads (bump: at its peak), or the factor of walk and noise
    width: float = 0.0  # K, half width of its own play
    slope: float = 0.0  # rad/s/K, of its own play
    other: np.ndarray | None = None  # curve of the second unit under this name


@dataclass(frozen=True)
class Soak:
    """N rows of a unit's soak, each a mean over `interval`."""

    unit: str
    t: np.ndarray  # (N,) s
    T: np.ndarray  # (N,) degC
    bias: np.ndarray  # (N, 3) rad/s
    interval: float  # s


@dataclass(frozen=True)
class Line:
    """A line: its units in order of production, and one or two soaks of each."""

    law: str
    units: tuple[Unit, ...]
    soaks: tuple[Soak, ...]
    spread: np.ndarray = field(repr=False)  # (141, 3) rad/s, over GRID, of shapes (levels removed)
    level_spread: np.ndarray = field(repr=False)  # (3,) rad/s

    @property
    def odd(self) -> dict[str, str]:
        """Planted faults, by the name of the unit."""
        return {u.name: u.odd for u in self.units if u.odd}


# --- the line's law


def _means(times: float) -> np.ndarray:
    """Return the line's mean curves (141, 3), levels 0: any two axes `times` apart, and a sign at least as much."""
    u = (2 * GRID - LOW - HIGH) / (HIGH - LOW)
    curves = np.column_stack([np.sin(2.2 * u + 0.4), u**2 - 0.2 * u, np.tanh(2.5 * (u - 0.3)) - 1.1 * u])
    curves = np.linalg.qr(curves - curves.mean(axis=0))[0] * np.sqrt(len(GRID))
    return SHAPE * max(times, 2.0) / np.sqrt(2) * curves


def _amounts(law: str, rng: np.random.Generator) -> np.ndarray:
    """Return standardised amounts (5, 3): level and four shapes, three axes."""
    if law == "t3":
        return rng.standard_t(3, size=(5, 3)) / np.sqrt(3)
    if law == "log-normal":
        s = 0.6
        return (np.exp(s * rng.normal(size=(5, 3))) - np.exp(s**2 / 2)) / np.exp(s**2 / 2) / np.sqrt(np.exp(s**2) - 1)
    if law == "foundries":
        apart = np.array([1.6, 1.6, -1.6, 1.2, -1.2])[:, None] * [1.0, -1.0, 0.6]
        return (rng.normal(size=(5, 3)) + apart * (rng.choice([-0.5, 0.5]))) / np.sqrt(1 + apart**2 / 4)
    if law == "correlated":
        common = rng.normal(size=(5, 1))
        out = np.sqrt(0.8) * common + np.sqrt(0.2) * rng.normal(size=(5, 3))
        out[1] = 0.8 * out[0] + 0.6 * out[1]  # the slope goes with the level
        return out
    if law in ("normal", "phase"):
        return rng.normal(size=(5, 3))
    raise ValueError(f"law: got {law!r}, expected one of {LAWS}")


def _raw(law: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return one unit's own shape (141, 3) and level (3,), of no size yet."""
    u = ((2 * GRID - LOW - HIGH) / (HIGH - LOW))[:, None]
    amounts = _amounts(law, rng)
    if law == "phase":  # bends whose place moves: no fixed set of shapes holds them
        at = rng.normal(size=(2, 3)) * 0.12 + [[-0.4], [0.35]]
        bends = 1.6 * np.tanh((u - at[0]) / 0.25) - 1.3 * np.tanh((u - at[1]) / 0.2) + 0.3 * amounts[1] * u
    else:
        shapes = (u, u**2, np.sin(3 * u + 1), np.exp(-(((u - 0.2) / 0.4) ** 2)))
        sizes = (1.0, 0.7, 0.4, 0.5)
        bends = sum(s * a * f for s, a, f in zip(sizes, amounts[1:], shapes, strict=True))
    return bends - bends.mean(axis=0), amounts[0]


@cache
def _law(law: str) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return of 4,000 units: mean of raw shapes (141, 3), their scale, spread of shapes (141, 3) and of levels (3,)."""
    rng = np.random.default_rng(4711)
    shapes, levels = (np.array(x) for x in zip(*(_raw(law, rng) for _ in range(4000)), strict=True))
    scale = SHAPE / np.sqrt(shapes.var(axis=0).mean())
    return shapes.mean(axis=0), float(scale), scale * shapes.std(axis=0), LEVEL * levels.std(axis=0)


def _deviation(law: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviation of one unit's shape (141, 3) and level (3,) from the line's [rad/s]."""
    mean, scale, _, _ = _law(law)
    shape, level = _raw(law, rng)
    return scale * (shape - mean), LEVEL * level


# --- odd units


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))


def _plant(odd: str, unit: Unit, line: dict[str, np.ndarray], times: float, rng: np.random.Generator) -> Unit:
    """Return the unit with what is odd in it."""
    k = int(rng.integers(3))
    curve = unit.curve.copy()
    own = curve - line["mean"]
    spread, level = line["spread"], line["level"]
    size = _rms(spread)[k]
    out = replace(unit, odd=odd, axis=k, times=times)
    if odd in ("swapped", "sign"):
        changed = curve[:, [1, 0, 2]] if odd == "swapped" else curve * np.where(np.arange(3) == k, -1.0, 1.0)
        shape = changed - curve
        apart = _rms(shape - shape.mean(axis=0)) / _rms(spread)
        return replace(out, curve=changed, axis=-1 if odd == "swapped" else k, times=float(apart.max()))
    if odd == "offset":
        curve[:, k] += np.copysign(times * level[k], own[:, k].mean())
    elif odd == "scale":  # of the whole curve over temperature, as a wrong scale factor would make it
        shape = curve[:, k] - curve[:, k].mean()
        curve[:, k] += np.copysign(times * size / _rms(shape), np.vdot(shape, own[:, k])) * shape
    elif odd == "bump":
        at = rng.uniform(LOW + 10, HIGH - 10)
        there = int(np.argmin(np.abs(GRID - at)))
        bump = np.exp(-0.5 * ((GRID - at) / rng.uniform(3, 6)) ** 2)
        curve[:, k] += np.copysign(times * spread[there, k], (own[:, k] - own[:, k].mean())[there]) * bump
    elif odd in ("walk", "noise"):
        factor = np.where(np.arange(3) == k, 3.0, 1.0)
        name = "walk" if odd == "walk" else "white"
        return replace(out, times=3.0, **{name: getattr(unit, name) * factor})
    elif odd == "hysteresis":
        width = float(rng.uniform(1.5, 4.0))
        return replace(out, width=width, slope=float(rng.choice([-1.0, 1.0]) * times * size / (2 * width)))
    elif odd == "two_units":
        shape, other = _deviation(line["law"], rng)
        away = line["mean"] + shape + other
        apart = _rms((away - curve) - (away - curve).mean(axis=0)) / _rms(spread)
        return replace(out, other=away, axis=-1, times=float(apart.max()))
    else:
        raise ValueError(f"odd: got {odd!r}, expected some of {ODD}")
    return replace(out, curve=curve)


# --- soaks


def _soak(unit: Unit, curve: np.ndarray, interval: float, hours: float, rng: np.random.Generator) -> Soak:
    """Return one soak: up and down once, through a body of some minutes."""
    t = (np.arange(round(hours * 3600 / interval)) + 0.5) * interval
    top = rng.normal(0, 0.3, 2)
    corners = np.array([0.0, 0.47, 0.53, 1.0]) * t[-1]
    T = behind(np.interp(t, corners, [LOW + top[0], HIGH + top[1], HIGH + top[1], LOW + top[0]]), 240.0, interval)
    T = np.clip(T, LOW, HIGH)
    bias = np.column_stack([np.interp(T, GRID, curve[:, k]) for k in range(3)])
    if unit.slope:
        one = (play(T, unit.width) - T)[:, None]
        bias[:, unit.axis] += unit.slope * 2 * unit.width * one[:, 0] / opening(T, one)[0]
    walk = _slow(Noise("walk", walk=1.0), len(t), interval, rng) * unit.walk
    white = rng.normal(size=(len(t), 3)) * unit.white / np.sqrt(interval)
    since = rng.normal(size=3) * 0.02 * LEVEL  # what a power-up changes
    seen = np.round((T + rng.normal(size=len(t)) * 0.01) / 0.01) * 0.01
    return Soak(unit.name, t, seen, bias + since + walk + white, interval)


def draw(
    seed: int,
    law: str = "normal",
    count: int = 100,
    odd: tuple[str, ...] = (),
    times: float = 6.0,
    *,
    interval: float = 10.0,
    hours: float = 2.0,
    twice: float = 0.1,
) -> Line:
    """Draw a line.

    Parameters
    ----------
    seed : int
        Same arguments, same line; the good units do not depend on `odd`.
    law : str
        One of `LAWS`: normal, t3 (heavy tails), log-normal (skew), foundries (two lots of chips mixed), correlated
        (axes 0.8, and slope with level), phase (bends whose temperature differs by some kelvin from unit to unit).
    count : int
        Units.
    odd : tuple of str
        Of `ODD`, one unit each, at places drawn from the seed: swapped (x and y), sign (of an axis), offset (level),
        scale (of an axis' curve), bump (at one temperature), walk (3 times), noise (3 times), hysteresis (a play of its
        own), two_units (two soaks of two different units of the line, which differ as any two do).
    times : float
        Size of what is odd, in standard deviations of the line's law at the same place: levels for an offset, shapes
        (rms over T) for scale and hysteresis (its opening), the shape at the peak for a bump. The line's mean curves
        are so far apart that swapping them, or a sign, is about as much; the unit's `times` says how much it is.
        Two spreads, where a spread is what holds 99.7 % of a normal line, are 6.
    interval : float
        Seconds of a row.
    hours : float
        Of each soak.
    twice : float
        Share of good units with two soaks.
    """
    _, _, shapes, levels = _law(law)
    mean = _means(times)
    line = {"mean": mean, "spread": shapes, "level": levels, "law": law}
    planted = dict(zip(np.random.default_rng([seed, 51]).permutation(count).tolist(), odd, strict=False))
    units, soaks = [], []
    for k in range(count):
        rng = np.random.default_rng([seed, 52, k])
        shape, level = _deviation(law, rng)
        spreads = np.exp(rng.normal(size=(2, 3)) * [[0.1], [0.2]])
        unit = Unit(f"{k:04d}", mean + shape + level, WHITE * spreads[0], WALK * spreads[1])
        again = rng.random() < twice
        if k in planted:
            unit = _plant(planted[k], unit, line, times, np.random.default_rng([seed, 53, k]))
        units.append(unit)
        soaks.append(_soak(unit, unit.curve, interval, hours, rng))
        if again or unit.other is not None:
            soaks.append(_soak(unit, unit.curve if unit.other is None else unit.other, interval, hours, rng))
    return Line(law, tuple(units), tuple(soaks), shapes, levels)


def campaign(
    lines: int = 6, count: int = 100, odd: tuple[str, ...] = ODD, times: float = 6.0, seed: int = 0
) -> list[Callable[[], Line]]:
    """Return functions that draw `lines` lines of every law, each with all kinds of odd units."""

    def one(law: str, k: int) -> Callable[[], Line]:
        return lambda: draw(seed * 10_000 + k, law, count, odd, times)

    return [one(law, k) for k in range(lines) for law in LAWS]
