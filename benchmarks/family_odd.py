"""Odd units of made-up families: recall and false discoveries over seeds, and the time that fit and search take.

    python benchmarks/family_odd.py [--check] [--seeds 5] [--units 200]

The constants of `driftlab.family` were chosen on seeds from 1 on; `--check` takes seeds from 1001 on. Families are
those of examples/06_family (heavy tails, skew, two humps) and of tests/support/other_families.py.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "examples" / "06_family"), str(ROOT / "tests" / "support")]

import family as example  # noqa: E402
import other_families as others  # noqa: E402

from driftlab.family.model import fit_family  # noqa: E402
from driftlab.family.odd import find_odd  # noqa: E402

KINDS = ("example", "polynomial", "together", "steps", "rough")


def made(kind: str, count: int, seed: int, *, odd: bool) -> list[others.Made]:
    """Return units of a family, of the example's with its own odd ones."""
    if kind != "example":
        units = others.deal(kind, count, seed, d=3, lots=10, size=1e-4)
        return others.plant(units, 0.05, seed) if odd else units
    dealt = example.deal(count, seed)
    if odd:
        dealt = example.plant(dealt, seed=seed)
    unit = example.DEG_H
    return [others.Made(u.name, u.lot, u.bias(others.GRID), u.noise * unit, u.walk * unit, odd=u.odd) for u in dealt]


def main() -> None:
    """Print a line for each kind of family."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--units", type=int, default=200)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    asked = parser.parse_args()
    first = 1001 if asked.check else 1
    axes = ("x", "y", "z")
    print(f"{asked.units} units, 3 axes, seeds {first} to {first + asked.seeds - 1}")
    print("family      planted  found  false  in clean families  fit [s]  search [s]")
    for kind in asked.kinds:
        planted = hit = false = clean = 0
        fits, searches = [], []
        for seed in range(first, first + asked.seeds):
            for odd in (True, False):
                units = made(kind, asked.units, seed, odd=odd)
                pairs = [(unit.soaked(seed, axes), unit.lot) for unit in units]
                records = [unit.record(seed, axes) for unit in units]
                begun = time.perf_counter()
                family = fit_family(pairs)
                between = time.perf_counter()
                found = set(find_odd(family, pairs, records))
                fits.append(between - begun)
                searches.append(time.perf_counter() - between)
                true = {unit.name for unit in units if unit.odd}
                planted, hit = planted + len(true), hit + len(true & found)
                false, clean = false + len(found - true) * odd, clean + len(found) * (not odd)
        print(
            f"{kind:12}{planted:7}{hit:7}{false:7}{clean:19}{np.median(fits):9.1f}{np.median(searches):12.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
