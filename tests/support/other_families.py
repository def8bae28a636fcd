"""Families of units by laws that are not those of `examples/06_family`, and what their soaks say.

Curves are polynomials, steps at a place of the unit's own, or rough; axes may go together; units may have seen one half
of the range. Rows are made straight away: what a recording is made of is not asked here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftlab.family.record import Figure, UnitRecord
from driftlab.family.unit_information import UnitInformation
from driftlab.soak.blocks import SoakRows

LOW, HIGH = -20.0, 60.0  # degC
GRID = np.linspace(LOW, HIGH, 81)
ROW = 20.0  # s


@dataclass
class Made:
    """A unit: its `curve` (81, d) at GRID, densities of noise and walk (d,), the part of the range that it saw."""

    name: str
    lot: str
    curve: np.ndarray
    noise: np.ndarray
    walk: np.ndarray
    part: tuple[float, float] = (0.0, 1.0)
    odd: str = ""
    at: float = np.nan

    def soaked(self, seed: int, axes: tuple[str, ...], hours: float = 2.0) -> UnitInformation:
        """Return what a soak up and down over its part of the range says."""
        rng = np.random.default_rng([seed, int(self.name)])
        R = round(hours * 3600 / ROW)
        t = (np.arange(R) + 0.5) * ROW
        low, high = (LOW + share * (HIGH - LOW) for share in self.part)
        T = low + (high - low) * (1 - np.cos(2 * np.pi * t / t[-1])) / 2
        d = len(axes)
        bias = np.stack([np.interp(T, GRID, self.curve[:, k]) for k in range(d)], axis=1)
        walk = np.cumsum(self.walk * np.sqrt(ROW) * rng.normal(size=(R, d)), axis=0)
        bias += walk - walk[0] + self.noise / np.sqrt(ROW) * rng.normal(size=(R, d))
        return UnitInformation.of(
            self.name, axes, [SoakRows(t, T, bias, np.full(R, ROW), {})], self.noise, self.walk, 2.5
        )

    def record(self, seed: int, axes: tuple[str, ...]) -> UnitRecord:
        """Return a record with noise and walk as they would be estimated, to 1 and 15 %."""
        rng = np.random.default_rng([seed, int(self.name), 1])

        def figure(values: np.ndarray, share: float) -> Figure:
            seen = values * np.exp(share * rng.normal(size=len(values)))
            return Figure(value=tuple(seen.tolist()), sigma=tuple((share * seen).tolist()))

        figures = {"noise": figure(self.noise, 0.01), "walk": figure(self.walk, 0.15)}
        domain = tuple(LOW + share * (HIGH - LOW) for share in self.part)
        return UnitRecord(
            key="", unit=self.name, lot=self.lot, state="done", axes=axes, domain=domain, figures=figures  # type: ignore[arg-type]
        )  # fmt: skip


def deal(
    kind: str, count: int, seed: int, *, d: int = 1, lots: int = 1, size: float = 1.0, halves: bool = False
) -> list[Made]:
    """Deal units of `kind` polynomial, steps, rough or together (correlated axes), of spreads of about `size`."""
    rng = np.random.default_rng([seed, 77])
    u = (GRID - 20) / 40
    common = np.stack([np.sin(u * (2 + k)) * 2 + u**2 for k in range(d)], axis=1)
    made = []
    for k in range(count):
        curve = size * (common + _curve(kind, u, d, rng))
        noise, walk = size * 0.02 * np.exp(0.1 * rng.normal(size=d)), size * 1e-4 * np.exp(0.2 * rng.normal(size=d))
        part = (0.0, 1.0)
        if halves:
            part = ((0.0, 0.55), (0.45, 1.0))[k % 2] if k % 5 else (0.0, 1.0)
        made.append(Made(f"{k:04d}", f"L{k * lots // count}", curve, noise, walk, part))
    return made


def plant(units: list[Made], share: float, seed: int) -> list[Made]:
    """Make a share of the units odd, in place: a bend of twice the family's spread, noise and walk in turn."""
    rng = np.random.default_rng([seed, 78])
    spread = np.std([unit.curve for unit in units], axis=0)
    for n, k in enumerate(rng.choice(len(units), max(3, round(share * len(units))), replace=False)):
        unit, axis = units[k], int(rng.integers(spread.shape[1]))
        low, high = (LOW + part * (HIGH - LOW) for part in unit.part)
        unit.odd = ("shape", "noise", "walk")[n % 3]
        if unit.odd == "shape":
            unit.at = float(rng.uniform(low + 12, high - 12))
            height = 2 * np.interp(unit.at, GRID, spread[:, axis]) * rng.choice([-1, 1])
            unit.curve[:, axis] += height * np.exp(-(((GRID - unit.at) / rng.uniform(5, 9)) ** 2))
        else:
            getattr(unit, unit.odd)[axis] *= 3.0 if unit.odd == "noise" else 8.0
    return units


def _curve(kind: str, u: np.ndarray, d: int, rng: np.random.Generator) -> np.ndarray:
    if kind == "polynomial":
        powers = np.stack([u**k for k in range(5)], axis=1)
        return np.asarray(powers @ (np.array([1, 0.7, 0.5, 0.3, 0.2])[:, None] * rng.normal(size=(5, d))))
    if kind == "steps":  # at a place of the unit's own: no sum of few shapes
        at, sharp = rng.normal(0.2, 0.15, size=d), rng.uniform(3, 6, size=d)
        level = rng.standard_t(4, size=d)
        return np.asarray(level + rng.gamma(3, 0.3, size=d) * np.tanh(sharp * (u[:, None] - at)))
    if kind == "rough":
        K = np.exp(-0.5 * ((u[:, None] - u) / 0.25) ** 2) + 1e-9 * np.eye(len(u))  # 10 K
        return np.asarray(np.linalg.cholesky(K) @ rng.normal(size=(len(u), d)))
    assert kind == "together", kind
    one = rng.normal(size=3)
    own = np.stack([one + 0.3 * rng.normal(size=3) for _ in range(d)], axis=1)
    return np.asarray(np.stack([np.ones_like(u), u, np.cos(2 * u)], axis=1) @ own)
