"""Families of made-up units whose law is not Gaussian, and the programs of a chamber: for `family.py`.

A generator deals units; a unit is its curve in deg/h over temperature and its noise. None of them is built of what
judges them: no splines. DEVELOPED were looked at while the family was written, CHECKED only at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from driftlab.soak.blocks import SoakRows

DEG_H = np.deg2rad(1 / 3600)  # rad/s
SPAN = 10.0  # s of a row

Curve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Made:
    """One unit: bias in deg/h (N, 3) of T (N,), noise deg/h/sqrt(Hz) and walk deg/h/sqrt(s), (3,)."""

    name: str
    curve: Curve
    noise: np.ndarray
    walk: np.ndarray


@dataclass(frozen=True)
class Kind:
    """A family: its range in degC, hours of a whole soak, and how a unit is dealt."""

    low: float
    high: float
    hours: float
    deal: Callable[[np.random.Generator], tuple[Curve, float, float]]  # curve, noise, walk

    def units(self, count: int, seed: int) -> list[Made]:
        """Deal units; the first ones do not depend on the count."""
        found = []
        for k in range(count):
            rng = np.random.default_rng([seed, k])
            curve, noise, walk = self.deal(rng)
            spread = np.exp(rng.normal(size=(2, 3)) * [[0.1], [0.2]])
            found.append(Made(f"{k:04d}", curve, noise * spread[0], walk * spread[1]))
        return found

    def u(self, T: np.ndarray) -> np.ndarray:
        """Return the temperatures as -1 to 1."""
        return (2 * T - self.low - self.high) / (self.high - self.low)


def _mixed(rng: np.random.Generator) -> tuple[Curve, float, float]:
    """Level, slope, a wave and a bend: heavy tails, skew, two humps (that of examples/06_family)."""
    size = np.array([60.0, 45.0, 30.0, 20.0])[:, None]
    amounts = size * np.stack([
        rng.standard_t(5, size=3) / np.sqrt(5 / 3), rng.gamma(2.0, size=3) / np.sqrt(2) - np.sqrt(2),
        rng.choice([-1.0, 1.0], size=3) * 0.8 + 0.6 * rng.normal(size=3), rng.normal(size=3),
    ])  # fmt: skip

    def curve(T: np.ndarray) -> np.ndarray:
        u = (T - 20) / 40
        common = np.stack([120 * u - 60 * u**2, 80 * np.sin(2 * u), 90 * u**3 - 40 * u], axis=1)
        shapes = np.stack([np.ones_like(u), u, np.cos(2.2 * u + 0.4), np.tanh(3 * (u - 0.3))], axis=1)
        return common + shapes @ amounts

    return curve, 2.0, 0.02


def _polynomials(rng: np.random.Generator) -> tuple[Curve, float, float]:
    """Polynomials of order 3 to 6, coefficients by t and gamma laws, axes correlated."""
    order = int(rng.integers(3, 7))
    mix = np.linalg.cholesky(np.array([[1, 0.6, 0.2], [0.6, 1, -0.4], [0.2, -0.4, 1]]))
    dealt = np.where(np.arange(7)[:, None] % 2, rng.standard_t(4, (7, 3)) / np.sqrt(2), rng.gamma(1.5, 1, (7, 3)) - 1.5)
    a = (100.0 / np.array([1, 1.2, 2, 3, 5, 8, 12]))[:, None] * (dealt @ mix.T)
    a[order + 1 :] = 0
    return lambda T: np.polynomial.chebyshev.chebval((2 * T - 45) / 125, a).T, 5.0, 0.02


def _bends(rng: np.random.Generator) -> tuple[Curve, float, float]:
    """Each unit bends where it likes: tanh and arctan about temperatures of its own, which no few modes span."""
    at, width, size = rng.normal([10, 35], 12, (3, 2)), rng.uniform(8, 20, (3, 2)), rng.laplace(0, 30, (3, 2))
    line = np.stack([rng.normal(0, 40, 3), rng.gamma(2.0, 0.5, 3)])

    def curve(T: np.ndarray) -> np.ndarray:
        z = (T[:, None, None] - at) / width
        return line[0] + np.outer(T, line[1]) + np.tanh(z[..., 0]) * size[:, 0] + np.arctan(z[..., 1]) * size[:, 1]

    return curve, 1.0, 0.01


def _quiet(rng: np.random.Generator) -> tuple[Curve, float, float]:
    """A fibre optic unit: small curves, of which the walk of a soak is no small part."""
    a = rng.standard_t(5, (3, 3)) * np.array([[2.0], [1.5], [0.8]])
    return lambda T: np.stack([np.ones_like(T), T / 30, np.cos(T / 15)], axis=1) @ a, 0.3, 0.01


def _kinks(rng: np.random.Generator) -> tuple[Curve, float, float]:
    """Slopes that differ on both sides of a temperature of the unit's own."""
    at, slope = rng.uniform(0, 40, 3), rng.laplace(0, 1.0, (2, 3))
    level = rng.normal(0, 50, 3)
    return lambda T: level + np.outer(T, slope[0]) + np.maximum(T[:, None] - at, 0) * slope[1], 3.0, 0.03


def _exponentials(rng: np.random.Generator) -> tuple[Curve, float, float]:
    """Curves exponential in temperature, by log-normal laws, the axes together."""
    size = np.exp(rng.normal(3.0, 0.5) + 0.3 * rng.normal(size=3))
    scale, line = 25 * np.exp(0.2 * rng.normal(size=3)), rng.normal(0, 1.0, (2, 3)) * [[40], [0.5]]
    return lambda T: size * np.exp(T[:, None] / scale - 1) + line[0] + np.outer(T, line[1]), 4.0, 0.03


def _designs(rng: np.random.Generator) -> tuple[Curve, float, float]:
    """Two designs in one family, three to one: one waves, the other is nearly straight."""
    a = rng.normal(size=(3, 3)) * [[30], [25], [6]]
    waves = np.array([60.0, -40.0, 25.0]) * (rng.random() < 0.25) * (1 + 0.2 * rng.normal(size=3))
    return (
        lambda T: np.stack([np.ones_like(T), T / 40, np.cos(T / 9)], axis=1) @ a + np.sin(T / 14)[:, None] * waves,
        2.0,
        0.02,
    )


DEVELOPED = {
    "mixed": Kind(-20, 60, 2, _mixed), "polynomials": Kind(-40, 85, 3, _polynomials), "bends": Kind(-20, 60, 2, _bends),
    "quiet": Kind(-20, 60, 4, _quiet),
}  # fmt: skip
CHECKED = {
    "kinks": Kind(-30, 70, 2, _kinks), "exponentials": Kind(-20, 60, 2, _exponentials),
    "designs": Kind(-20, 60, 2, _designs),
}  # fmt: skip

PROGRAMS = ("whole", "lower", "middle", "upper", "quarter", "fast")
"""40 % of range and hours at its lower end, middle or upper end; the first quarter; the whole, four times as fast."""


def soak(kind: Kind, unit: Made, program: str, seed: int) -> SoakRows:
    """Return the rows of a soak up and down again, of the program's part of the range."""
    rng = np.random.default_rng([seed, int(unit.name), PROGRAMS.index(program)])
    share = 0.4 if program in ("lower", "middle", "upper") else 1.0
    hours = kind.hours * {"fast": 0.25}.get(program, share)
    R = round(hours * 3600 / SPAN)
    t = (np.arange(R) + 0.5) * SPAN
    begin = {"middle": 0.3, "upper": 0.6}.get(program, 0.0)
    part = begin + share * (1 - np.cos(2 * np.pi * t / (R * SPAN))) / 2
    if program == "quarter":
        t, part = t[: R // 4], part[: R // 4]
    T = kind.low + part * (kind.high - kind.low)
    white = unit.noise * rng.normal(size=(len(t), 3)) / np.sqrt(SPAN)
    walk = np.cumsum(unit.walk * rng.normal(size=(len(t), 3)) * np.sqrt(SPAN), axis=0)
    return SoakRows(t, T, (unit.curve(T) + walk + white) * DEG_H, np.full(len(t), SPAN), {})
