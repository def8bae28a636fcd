"""Five families of smooth curves over temperature, and what bends a little more: in plain NumPy.

    bias = amplitude f(u),   u = (T - middle) / half width, -1 to 1 over the range,   max f - min f = 1

None of them is a spline or a sum of pieces, so they say whether a method finds in a smooth curve what is not there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


def _sin(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return sin(4 u + phase): one and a quarter periods."""
    return np.sin(4 * u + rng.uniform(-np.pi, np.pi))


def _cubic(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    a = rng.normal(size=3) * [1.0, 1.0, 1.5]
    return a[0] * u + a[1] * u**2 + a[2] * u**3


def _sigmoid(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a straight line with a soft step somewhere, 0.15 to 0.5 of the half width wide."""
    at, width = rng.uniform(-0.6, 0.6), rng.uniform(0.15, 0.5)
    return np.tanh((u - at) / width) + rng.normal() * 0.5 * u


def _exponential(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    rate = rng.uniform(1.0, 3.0) * rng.choice([-1.0, 1.0])
    return np.exp(rate * (u - np.sign(rate))) * rng.choice([-1.0, 1.0]) + rng.normal() * 0.3 * u


def _chirp(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a wave whose pitch rises mildly with temperature."""
    return np.sin(2.5 * u + rng.uniform(0.5, 1.2) * u**2 + rng.uniform(-np.pi, np.pi))


FAMILIES: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "sin": _sin,
    "cubic": _cubic,
    "sigmoid": _sigmoid,
    "exponential": _exponential,
    "chirp": _chirp,
}


@dataclass(frozen=True)
class Curve:
    """A smooth curve of one axis: call it with T (any shape, degC) for the bias in the unit of `amplitude`."""

    family: str
    seed: tuple[int, ...]
    low: float  # degC
    high: float  # degC
    amplitude: float  # greatest less least over the range
    level: float = 0.0

    def __call__(self, T: np.ndarray) -> np.ndarray:
        """Return the bias at temperatures T; outside the range the same formula goes on."""
        grid = self._raw(np.linspace(self.low, self.high, 801))
        return self.level + self.amplitude * (self._raw(T) - grid.mean()) / np.ptp(grid)

    def _raw(self, T: np.ndarray) -> np.ndarray:
        u = (2 * np.asarray(T, float) - self.low - self.high) / (self.high - self.low)
        return FAMILIES[self.family](u, np.random.default_rng(self.seed))


def draw_curves(
    seed: int, amplitude: float, *, low: float = -20.0, high: float = 50.0, family: str | None = None, axes: int = 3
) -> list[Curve]:
    """Draw one curve an axis.

    Parameters
    ----------
    seed : int
        Same seed, same curves.
    amplitude : float
        Greatest less least over the range, the same for all axes, in any unit.
    low, high : float
        Range of temperature [degC].
    family : str, optional
        One of `FAMILIES`; drawn for each axis where it is None.
    axes : int
        How many.
    """
    rng = np.random.default_rng([seed, 101])
    kinds = [family or str(rng.choice(list(FAMILIES))) for _ in range(axes)]
    return [Curve(kind, (seed, 102, k), low, high, amplitude) for k, kind in enumerate(kinds)]
