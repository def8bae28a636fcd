"""The family's loop: what it names where one unit shows a third of what the loop of one unit needs, and in clean ones.

Families of `examples/06_family` with effects planted; families without any, of types that no two seeds share
(`tests/support/families_at_rest.py`). Develop on some seeds, check on others.

    python benchmarks/family_loop.py [--units 100] [--seeds 0:2] [--clean 0:40]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "examples" / "06_family")]

import family  # noqa: E402
from families_at_rest import COLOURS, DEG_H, effect_of, of_other_type, planted, soaked  # noqa: E402

from driftlab.family.shared_effect import without_effects  # noqa: E402
from driftlab.family.shared_effects import SharedEffects, find_common  # noqa: E402
from driftlab.family.unit_information import UnitInformation  # noqa: E402

SIZES = (20, 40, 20, 60, 30, 20, 100, 20, 50, 200)  # units of clean families
# kind, hyper-parameters, size (deg/h a unit of it), and who has it: everyone, with either sign, or one lot
PLANTED = {
    "hysteresis": ("hysteresis", {"width": 6.0}, 0.1, "all"),
    "hysteresis, signs differ": ("hysteresis", {"width": 6.0}, 0.1, "signs"),
    "hysteresis, one lot of ten": ("hysteresis", {"width": 6.0}, 0.2, "lot"),
    "relaxation": ("relaxation", {"tau": 900.0}, 0.02, "all"),
    "thermal lag": ("thermal_lag", {"tau": 10.0}, 1.0, "all"),
    "turn-on": ("turn_on", {"tau": 600.0}, 1.5, "all"),
    "thermal rate": ("thermal_rate", {"tau": 20.0}, 9.0, "all"),
}


def named(found: SharedEffects) -> str:
    """Return the effects, and what they cannot be distinguished from."""
    said = []
    for effect in found.effects:
        values = ", ".join(f"{value:.3g}" for value in effect.effect.hyper_parameters.values())
        rivals = f" or {' or '.join(effect.indistinguishable_from)}" if effect.indistinguishable_from else ""
        lots = "" if effect.others is None else f" in {','.join(lot.lot for lot in effect.lots if lot.has)}"
        said.append(f"{effect.effect.kind} {values}{rivals}{lots}, {effect.evidence:.0f} of {effect.price:.0f} nats")
    return "; ".join(said) or "nothing"


def map_error(
    units: list[tuple[UnitInformation, str]], dealt: list[family.Unit], found: SharedEffects
) -> tuple[float, float]:
    """Return rms errors of the units' own maps against the truth, without and with the effects, deg/h."""
    T = np.linspace(family.LOW + 1, family.HIGH - 1, 150)
    errors: tuple[list[float], list[float]] = ([], [])
    for unit, (own, lot) in zip(dealt, units, strict=True):
        truth = unit.bias(T)
        for part, one in zip(
            errors, (own, without_effects(own, lot, found.effects, found.noise.get(own.unit))), strict=True
        ):
            for axis in range(truth.shape[1]):
                c = np.linalg.lstsq(one.J[axis], one.h[axis], rcond=1e-10)[0]
                part.append(float(np.mean((one.knots.values(T) @ c - truth[:, axis]) ** 2)))
    return float(np.sqrt(np.mean(errors[0]))) / DEG_H, float(np.sqrt(np.mean(errors[1]))) / DEG_H


def detect(count: int, seeds: range) -> None:
    """Print what is found of each planted effect."""
    for name, (kind, settings, size, who) in PLANTED.items():
        for seed in seeds:
            dealt, rng = family.deal(count, seed=seed), np.random.default_rng([seed, 4])
            sizes = size * (1 + 0.3 * rng.normal(size=(count, 3)))
            if who == "signs":
                sizes *= rng.choice([-1.0, 1.0], size=sizes.shape)
            if who == "lot":
                sizes *= np.array([[unit.lot == "L03"] for unit in dealt])
            units = planted(dealt, effect_of(kind, **settings), sizes, seed)
            began = time.process_time()
            found = find_common(units)
            took = time.process_time() - began
            before, after = map_error(units, dealt, found)
            about = ", ".join(f"{value:g}" for value in settings.values())
            print(f"{name} {about} | {seed} | {named(found)} | map {before:.2f} -> {after:.2f} deg/h | {took:.1f} s")


def clean(seeds: range) -> None:
    """Print how many families without effects get one."""
    false = 0
    for seed in seeds:
        count = SIZES[seed % len(SIZES)]
        colour = (*COLOURS, "example")[seed % 4]
        if colour == "example":
            units = soaked(family.deal(count, seed=seed, law=("mixed", "gaussian")[seed // 4 % 2]), seed)
        else:
            units = of_other_type(count, seed, colour)
        found = find_common(units)
        false += bool(found.effects)
        if found.effects:
            print(f"clean {seed}: {count} units, {colour}: {named(found)}")
    print(f"false additions: {false} of {len(seeds)} clean families, seeds {seeds.start} to {seeds.stop - 1}")


def _range(text: str) -> range:
    first, _, last = text.partition(":")
    return range(int(first), int(last))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--seeds", type=_range, default=range(2))
    parser.add_argument("--clean", type=_range, default=range(40))
    asked = parser.parse_args()
    clean(asked.clean)
    detect(asked.units, asked.seeds)
