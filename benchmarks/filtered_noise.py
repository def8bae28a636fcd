"""Limits of the white noise of filtered, interpolated and repeated samples: `python filtered_noise.py [SEEDS]`.

900 s at 100 Hz, of white noise N = 1, flicker B = 0.05 and a walk K = 0.01, in plain NumPy; the 95 % limits of N by
`driftlab allan` are held against 1 (docs/explanation/noise.md).
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
from scipy.signal import butter, lfilter

from driftlab.noise.allan import curve
from driftlab.noise.allan_fit import KEYS, fit

RATE, SECONDS = 100, 900.0  # Hz, s
WHITE, FLICKER, WALK = 1.0, 0.05, 0.01
N = KEYS.index("white")
Filter = Callable[[np.ndarray], np.ndarray]


def noise(rng: np.random.Generator, rate: float) -> np.ndarray:
    """Return the samples (n,) of a unit at rest, 20 s of which are there for a filter to settle."""
    n = int((SECONDS + 20) * rate)
    f = np.fft.rfftfreq(n, 1 / rate)[1:]
    lines = np.sqrt(n * rate / (4 * np.pi * f)) * (rng.normal(size=len(f)) + 1j * rng.normal(size=len(f)))
    flicker = np.fft.irfft(np.concatenate([[0.0], lines]), n)  # of the one-sided density B^2 / (pi f)
    walk = np.cumsum(rng.normal(size=n)) / np.sqrt(rate)
    return np.asarray(WHITE * np.sqrt(rate) * rng.normal(size=n) + FLICKER * flicker + WALK * walk)


def low_passed(order: int, corner: float) -> Filter:
    """Return a Butterworth filter; `corner` in Hz."""
    return lambda rate: lfilter(*butter(order, corner / (RATE / 2)), rate)


def interpolated(rate: np.ndarray) -> np.ndarray:
    """Return ten samples for each, on straight lines."""
    return np.asarray(np.interp(np.arange(10 * len(rate)) / 10, np.arange(len(rate)), rate))


FILTERS: dict[str, tuple[int, Filter]] = {  # rate of the samples in Hz, and what becomes of them
    "as they are": (RATE, np.asarray),
    "Butterworth, second order, 10 Hz": (RATE, low_passed(2, 10.0)),
    "Butterworth, second order, 20 Hz": (RATE, low_passed(2, 20.0)),
    "first order, 5 Hz": (RATE, low_passed(1, 5.0)),
    "means of 10": (RATE, lambda rate: np.convolve(rate, np.full(10, 0.1), "valid")),
    "10 Hz, interpolated on lines": (RATE // 10, interpolated),
    "10 Hz, each value ten times": (RATE // 10, lambda rate: np.repeat(rate, 10)),
}


def main(seeds: int) -> None:
    """Print how often the limits of N cover it, and their medians."""
    print("| samples | limits that cover N | limits, medians |")
    print("|---|---|---|")
    for name, (rate, smoothed) in FILTERS.items():
        samples = (smoothed(noise(np.random.default_rng(seed), rate))[20 * RATE :] for seed in range(seeds))
        found = [fit(curve(np.ascontiguousarray(one), 1 / RATE)) for one in samples]
        low, high = np.array([(one.low[N], one.high[N]) for one in found]).T
        covered = np.mean((low <= WHITE) & (high >= WHITE))
        print(f"| {name} | {covered:.0%} | {np.median(low):.3f} to {np.median(high):.3f} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
