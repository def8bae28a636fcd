"""Quality of the kind of map that `fit-map --compare` takes, on soaks whose curve is known.

    python benchmarks/map_kinds.py [SEEDS] [FIRST] [SHAPE...]

A soak is up and down again, twice, at 1 Hz for 24 h, with white noise and a random walk of the bias. Of every kind the
true error is the rms over the temperatures of its curve less the true one, constant removed. Good is a choice whose
true error is at most 1.1 times that of the kind with the smallest.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from driftlab.maps.kind_selection import KindComparison, candidates, compare, divide
from driftlab.soak.blocks import GrowingSoak
from fusion_core.contracts import ThermalMap
from fusion_core.host.registry import registry

HOURS, SWEEPS, LOW, HIGH = 24, 4, -20.0, 50.0
WHITE = 3 / np.degrees(1) / 3600  # rad/s of a sample of 1 s: 3 deg/h/sqrt(Hz)
WALK = WHITE / 200  # rad/s/sqrt(s)
DEG_H = np.degrees(1) * 3600
SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "cubic": lambda x: np.stack([x - 2 * x**3, 0.5 * x**2 + x**3, 0.3 * x - x**3], axis=1),
    "bent": lambda x: np.stack([np.tanh(8 * (x - 0.3)), 0.3 * x, np.tanh(6 * (x + 0.2)) - x], axis=1),
    "step": lambda x: np.stack([np.tanh(40 * (x - 0.2)), 0.2 * x, 0.1 * x**2], axis=1),
    "kink": lambda x: np.stack([np.maximum(x - 0.3, 0), 0.3 * x + np.abs(x), -0.5 * np.maximum(-x, 0)], axis=1),
    "straight": lambda x: np.stack([x, -0.5 * x, 0.2 * x], axis=1),
    "order 5": lambda x: np.stack([16 * x**5 - 20 * x**3 + 5 * x, x**2, 0.3 * x], axis=1),
    "wavy": lambda x: np.stack([np.sin(5 * x), np.cos(7 * x), 0.5 * np.sin(9 * x)], axis=1),
}
SIZES = {"large": 60.0, "small": 6.0}  # of the curve, deg/h


def soak(shape: str, size: float, seed: int, sweeps: int = SWEEPS) -> tuple[np.ndarray, np.ndarray]:
    """Return T (N,) and bias (N, 3) of a soak."""
    rng = np.random.default_rng(seed)
    N = HOURS * 3600
    x = 1 - 2 * np.abs(1 - (np.arange(N) * sweeps / N) % 2)  # up and down
    T = (LOW + HIGH) / 2 + x * (HIGH - LOW) / 2
    curve = SHAPES[shape](x) * size / DEG_H
    walk = np.cumsum(rng.normal(size=curve.shape) * WALK, axis=0)
    return T, curve + walk + rng.normal(size=curve.shape) * WHITE


def judged(T: np.ndarray, bias: np.ndarray) -> KindComparison:
    """Compare all installed kinds on a soak."""
    growing = GrowingSoak()
    growing.add(np.arange(len(T), dtype=float), T, bias)
    blocks = growing.rows()
    tried = candidates([], registry().classes(ThermalMap).values())
    return compare(tried, blocks.T, blocks.bias, divide([blocks.T]))


def true_errors(found: KindComparison, shape: str, size: float) -> dict[str, float]:
    """Return the true error of every kind in deg/h."""
    T = np.linspace(max(LOW, found.T.min()), min(HIGH, found.T.max()), 500)
    truth = SHAPES[shape]((T - (LOW + HIGH) / 2) * 2 / (HIGH - LOW)) * size
    errors = {}
    for row in found.tried:
        if row.fitted is not None:
            left = row.fitted.bias(T) * DEG_H - truth
            errors[row.name] = float(np.sqrt(np.mean((left - left.mean(axis=0)) ** 2)))
    return errors


def main(seeds: int, first: int, shapes: list[str]) -> None:
    table = Table("shape", "curve", "chosen", "good", "worst ratio", "true error: chosen", "best")
    for shape in shapes or SHAPES:
        for name, size in SIZES.items():
            chosen: Counter[str] = Counter()
            ratios, own, best = [], [], []
            begun = time.monotonic()
            for seed in range(first, first + seeds):
                found = judged(*soak(shape, size, seed))
                errors = true_errors(found, shape, size)
                chosen[found.chosen.name] += 1
                own.append(errors[found.chosen.name])
                best.append(min(errors.values()))
                ratios.append(own[-1] / best[-1])
            good = np.mean(np.array(ratios) <= 1.1)
            names = ", ".join(f"{kind} ({count})" for kind, count in chosen.most_common())
            table.add_row(shape, name, names, f"{good:.0%}", f"{max(ratios):.2f}",
                          f"{np.mean(own):.2f} deg/h", f"{np.mean(best):.2f} deg/h")  # fmt: skip
            print(
                f"{shape} {name}: {names} good {good:.0%}, {(time.monotonic() - begun) / seeds:.1f} s each", flush=True
            )
    Console(width=140).print(table)


if __name__ == "__main__":
    numbers = [int(text) for text in sys.argv[1:3]]
    main(*(numbers + [4, 0][len(numbers) :]), sys.argv[3:])
