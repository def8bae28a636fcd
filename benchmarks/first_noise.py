"""Noise and walk that a first config guesses from a soak, held against those that it was simulated with.

Two hundred soaks of ramps, steps and cycles over 70 K: white noise and walk over two decades each, a curve that bends,
a body that follows its chamber, thermometers that are rounded. The simulation shares nothing with the estimator.

    python benchmarks/first_noise.py [COUNT]
"""

from __future__ import annotations

import sys

import numpy as np

from driftlab.noise.quick import noise_of

SHAPES = ("ramp", "steps", "cycle", "warm-up")
SPAN = 70.0  # K


def chamber(shape, t, rng):
    """Set points over time (N,), degC."""
    u = t / t[-1]
    if shape == "ramp":
        return -20 + SPAN * np.interp(u, [0, 0.1, 0.9, 1], [0, 0, 1, 1])
    if shape == "steps":
        return -20 + SPAN * np.floor(u * 7.999) / 7
    if shape == "cycle":
        return 15 + SPAN / 2 * np.sin(2 * np.pi * u * rng.integers(1, 4))
    return 20 + SPAN * (1 - np.exp(-u * 6))


def soak(seed):
    """One soak: shape, t (N,), values (N, 1), temperature (N,), white noise and walk as drawn."""
    rng = np.random.default_rng([seed, 28])
    shape = SHAPES[seed % len(SHAPES)]
    rate, hours = rng.choice([1.0, 2.0, 5.0, 10.0]), rng.uniform(1.5, 6)
    n = int(rate * 3600 * hours)
    t, dt = np.arange(n) / rate, 1 / rate
    white, walk = 10 ** rng.uniform(-6, -4), 10 ** rng.uniform(-8.5, -6)  # rad/s/sqrt(Hz), rad/s/sqrt(s)
    body, target, tau = np.empty(n), chamber(shape, t, rng), rng.uniform(100, 900)
    body[0] = target[0]
    for k in range(1, n):
        body[k] = body[k - 1] + dt / tau * (target[k] - body[k - 1])
    v = (body - 15) / 35
    slopes = rng.standard_normal(4) * [1.5e-3, 6e-4, 4e-4, 2e-4]
    curve = sum(c * v ** (k + 1) for k, c in enumerate(slopes)) + 1e-4 * rng.standard_normal() * np.sin(4 * v)
    values = rng.normal(0, 2e-3) + curve + np.cumsum(walk * np.sqrt(dt) * rng.standard_normal(n))
    values += white / np.sqrt(dt) * rng.standard_normal(n)
    resolution = rng.choice([0.0, 0.01, 0.0625])
    shown = body + 0.02 * rng.standard_normal(n)
    temperature = np.round(shown / resolution) * resolution if resolution else shown
    return shape, t, values[:, None], temperature, white, walk


def held(seed):
    """Ratios of white noise and walk to those drawn, and whether the walk is said to be known; None without a guess."""
    shape, t, values, temperature, white, walk = soak(seed)
    found = noise_of(t, values, temperature)
    return None if found is None else (shape, found.white[0] / white, found.walk[0] / walk, bool(found.known[0]))


def count(seeds):
    """Count the soaks that have a guess, white noise within a factor of 2, a known walk, and of these one within it."""
    rows = [row for row in map(held, seeds) if row is not None]
    within = [max(r, 1 / r) <= 2 for _, r, _, _ in rows]
    known = [r for _, _, r, known in rows if known]
    bounds = [r for _, _, r, known in rows if not known]
    return {
        "soaks": len(seeds),
        "guessed": len(rows),
        "white noise within a factor of 2": sum(within),
        "walk known": len(known),
        "of these within a factor of 2": sum(max(r, 1 / r) <= 2 for r in known),
        "walk unknown": len(bounds),
        "of these above the truth, as a bound is": sum(r >= 1 for r in bounds),
    }


if __name__ == "__main__":
    for what, number in count(range(int(sys.argv[1]) if len(sys.argv) > 1 else 200)).items():
        print(f"{what:45} {number}")
