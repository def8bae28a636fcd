"""Ripples of a curve that are narrower than its knots, and none: `python ripples.py [SOAKS]`, SOAKS of each kind.

Planted: soaks of 6 h as those of `known_limits.py`, of four shapes, four periods and three sizes; the largest error of
an axis over its stated sigma. None: what a polynomial leaves of four profiles, four kinds of noise and four
thermometers; the number of axes with a ripple that is not there.
"""

from __future__ import annotations

import sys
from itertools import product

import numpy as np
from known_limits import N, cubic, fitted, ratios, temperature
from loop_cases.signatures import late

from fusion_core.thermal.ripple import ripples

PROFILES = {  # corners in shares of the time, and the chamber's temperatures there, degC
    "up and down": ([0, 0.02, 0.49, 0.51, 1], [-20, -20, 60, 60, -20]),
    "three times": (np.linspace(0, 1, 7), [-20, 60, -20, 60, -20, 60, -20]),
    "stairs": (np.linspace(0, 1, 34), np.repeat([*range(-20, 61, 10), *range(50, -21, -10)], 2)),
    "from room": ([0, 0.2, 0.6, 1], [25, -20, 60, 25]),
}


def shaped(shape: str, T: np.ndarray, period: float, size: float, nodes: np.ndarray) -> np.ndarray:
    """Return a ripple at T (N,), of the unit of its size."""
    u = T / period
    if shape == "wave":
        return np.asarray(size * np.sin(2 * np.pi * u))
    if shape == "square":
        return np.asarray(0.7 * size * np.sign(np.sin(2 * np.pi * u)))
    if shape == "sawteeth":
        return np.asarray(2 * size * (u % 1 - 0.5))
    return np.asarray(0.7 * size * np.interp(2 * u, np.arange(-100, len(nodes) - 100), nodes))


def planted(shape: str, period: float, size: float, seed: int) -> float:
    """Return the largest error of an axis over its stated sigma."""
    rng, T = np.random.default_rng([seed, 9]), temperature(back=True)
    curves, nodes = [cubic(rng) for _ in range(3)], rng.normal(size=900)

    def ripple(T: np.ndarray) -> np.ndarray:
        return shaped(shape, T, period, size, nodes)

    bias = np.stack([f(T) + ripple(T) for f in curves], axis=1)
    return float(np.max(ratios(fitted(T, bias, rng, np.ones(N, bool), None), curves, ripple)))


def none(profile: str, noise: str, step: float, rng: np.random.Generator) -> int:
    """Return the number of axes (of three) with a ripple that is not there; `step` in K, 0: a fine thermometer."""
    n = 14_400
    T = np.asarray(late(np.interp(np.arange(n) / n, *PROFILES[profile]), 120.0))
    left = 2 * rng.normal(size=(n, 3)) + 30 * np.sin(T / 30)[:, None]
    if noise == "walk":
        left += np.cumsum(0.05 * rng.normal(size=(n, 3)), axis=0)
    elif noise == "flicker":
        f = np.maximum(np.fft.rfftfreq(n), 1 / n)[:, None]
        left += np.fft.irfft(np.fft.rfft(rng.normal(size=(n, 3)), axis=0) / np.sqrt(f), n, axis=0)
    elif noise == "lag":
        left += (T - np.asarray(late(T, 300.0)))[:, None]
    shown = T + 0.05 * rng.normal(size=n) if step == 0 else np.rint((T + 0.3 * step * rng.normal(size=n)) / step) * step
    X = np.vander((shown - 20) / 40, 10)
    return sum(found is not None for found in ripples(shown, left - X @ np.linalg.lstsq(X, left, rcond=None)[0], 2.0))


def main(soaks: int) -> None:
    """Print both."""
    for shape in ("wave", "square", "sawteeth", "random"):
        each = [planted(shape, *case) for case in product((0.3, 0.7, 1.4, 3.0), (0.5, 1.0, 3.0), range(soaks))]
        print(f"{shape}: error over sigma at most {max(each):.2g}, median {np.median(each):.2g}", flush=True)
    rng, kinds = np.random.default_rng(5), product(PROFILES, ("white", "walk", "flicker", "lag"), (0.0, 0.02, 0.1, 0.5))
    false = [none(*kind, rng) for kind in kinds for _ in range(soaks)]
    print(f"no ripple: {sum(false)} of {3 * len(false):,} axes have one")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
