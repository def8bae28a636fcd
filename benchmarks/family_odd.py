"""Odd units of made-up families of six laws: recall by what was planted, false ones, and the words that are said.

    python benchmarks/family_odd.py [--check] [--seeds 5] [--units 100] [--laws normal ...] [--known]

`benchmarks/planted_units.py` deals them; one of each plant is in a family. The constants of `driftlab.family` were
chosen on seeds from 1 on; `--check` takes seeds from 1001 on. `--known` judges new units, one at a time, under the
family that was fitted on as many ordinary ones.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace

from planted_units import LAWS, PLANTS, Planted, deal, plant

from driftlab.family.densities import densities_of
from driftlab.family.law import Family
from driftlab.family.model import fit_family
from driftlab.family.outliers import Odd, find_outliers
from driftlab.family.record import UnitRecord
from driftlab.family.repeatability import hysteresis_of, soaks_of
from driftlab.family.soaked import Soaked
from driftlab.fleets.figures import figure

AXES, STEP = ("x", "y", "z"), 2.5
SAID = {
    "swap": "swap", "sign": "sign", "offset": "level", "scale": "scale", "bump": "shape", "walk": "walk",
    "noise": "noise", "hysteresis": "hysteresis", "two units": "soaks",
}  # fmt: skip


def soaked(unit: Planted, seed: int) -> tuple[Soaked, UnitRecord]:
    """Return what a unit's soaks say, and its record."""
    rows = unit.rows(seed)
    found = densities_of(rows, STEP)
    figures = {
        "noise": figure(found.white, found.white_sigma), "walk": figure(found.walk, found.walk_sigma),
        "hysteresis": hysteresis_of(rows, found.white, found.likely, STEP), "soaks": soaks_of(rows, STEP),
    }  # fmt: skip
    record = UnitRecord(key="", unit=unit.name, state="done", axes=AXES, figures=figures)
    return Soaked.of(unit.name, AXES, rows, found.white, found.likely, STEP), record


def judged(family: Family, units: list[Planted], seed: int, *, fitted: bool) -> dict[str, tuple[Odd, ...]]:
    pairs = [soaked(unit, seed) for unit in units]
    if fitted:
        family = fit_family([(own, "") for own, _ in pairs])
        return find_outliers(family, [(own, "") for own, _ in pairs], [record for _, record in pairs]).odd
    found = {}
    for own, record in pairs:
        found |= find_outliers(family, [(own, "")], [record], fitted=False).odd
    return found


def known(law: str, count: int, seed: int) -> Family:
    """Return a family of ordinary units, with its laws."""
    pairs = [soaked(unit, seed) for unit in deal(law, count, seed)]
    family = fit_family([(own, "") for own, _ in pairs])
    found = find_outliers(family, [(own, "") for own, _ in pairs], [record for _, record in pairs])
    return replace(family, laws=found.laws)


def main() -> None:
    """Print a line for each law."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--known", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--laws", nargs="*", default=list(LAWS))
    asked = parser.parse_args()
    first = 1001 if asked.check else 1
    print(f"{asked.units} units, seeds {first} to {first + asked.seeds - 1}; planted found, right words")
    print(f"{'law':11}" + "".join(f"{kind:>12}" for kind in PLANTS) + "   recall  false  units")
    for law in asked.laws:
        hits, right = Counter[str](), Counter[str]()
        false = clean = 0
        begun = time.perf_counter()
        for seed in range(first, first + asked.seeds):
            family = known(law, asked.units, seed + 500) if asked.known else None
            units = plant(deal(law, asked.units, seed), list(PLANTS), seed)
            found = judged(family, units, seed, fitted=family is None)  # type: ignore[arg-type]
            for unit in units:
                odd, kind = found.get(unit.name, ()), unit.odd[:-2]
                hits[kind] += bool(odd)
                right[kind] += bool(kind) and SAID[kind] in {one.what for one in odd}
                false += bool(odd) and not kind
                clean += not kind
                if asked.verbose and (bool(odd) != bool(kind) or (kind and SAID[kind] != odd[0].what)):
                    print("   ", seed, unit.name, unit.odd, [(one.sentence, f"{one.p:.1e}") for one in odd])
        recall = sum(hits[kind] for kind in PLANTS) / (len(PLANTS) * asked.seeds)
        cells = "".join(f"{f'{hits[kind]}/{asked.seeds} {right[kind]}':>12}" for kind in PLANTS)
        print(f"{law:11}{cells}{100 * recall:8.0f}%{false:7}{clean:7}  {time.perf_counter() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
