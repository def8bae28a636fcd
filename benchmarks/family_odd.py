"""Odd units of made-up families of six laws: recall by what was planted, false ones, and the words that are said.

    python benchmarks/family_odd.py [--foreign] [--known] [--check] [--first 1] [--seeds 3] [--units 100] [--laws ...]

One of each plant is in a family of `benchmarks/planted_units.py`, or with `--foreign` of
`benchmarks/foreign_families.py`. The constants of `driftlab.family` were chosen on seeds from 1 on; `--check` takes
seeds from 2001 on, `--first` those from another one on. `--known` judges new units, one at a time, under the family
that was fitted on as many ordinary ones. `--clean` plants nothing.

A cell has how many were found, of how many that the oracle (`benchmarks/odd_oracles.py`) can name, of all; and how
often the words were right. The oracle names a unit whose error has a chance below 5 % / units under the law that the
family was drawn from. Intervals are of 95 %, of Clopper and Pearson.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import foreign_families as foreign
import numpy as np
import planted_units as own
from loop_cases.signatures import dragged
from odd_oracles import Truth, modes_of

from driftlab.family.mixed_model import Family, fit_family
from driftlab.family.outliers import FALSE, Outlier, find_outliers
from driftlab.family.record import Figure, UnitRecord
from driftlab.family.repeatability import hysteresis_of, soaks_of
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import soaked_of
from driftlab.soak.blocks import SoakRows

AXES, STEP, DRAWN = ("x", "y", "z"), 2.5, 20_000
SAID = {
    "swap": "swap", "sign": "sign", "offset": "level", "scale": "scale", "bump": "shape", "walk": "walk",
    "noise": "noise", "hysteresis": "hysteresis", "two units": "soaks",
}  # fmt: skip
KINDS = tuple(SAID)
FOREIGN = dict(zip(foreign.ODD, KINDS, strict=True))


@dataclass(frozen=True, eq=False)
class Dealt:
    """A unit of a line: its rows, what is odd in it (or nothing), and what is true of that."""

    name: str
    rows: tuple[SoakRows, ...]
    odd: str = ""
    truth: Callable[[], Truth] | None = None


def planted(law: str, count: int, seed: int, *, odd: bool) -> list[Dealt]:
    """Return a line of `benchmarks/planted_units.py`."""
    ordinary = own.deal(law, count, seed)
    units = own.plant(ordinary, list(KINDS), seed) if odd else ordinary
    found = []
    for good, unit in zip(ordinary, units, strict=True):
        rows = unit.rows(seed)
        kind, axis = unit.odd[:-2], "xyz".find(unit.odd[-1:])
        truth = (lambda *of: lambda: _of_planted(law, *of))(good, unit, rows, kind, axis)
        found.append(Dealt(unit.name, rows, kind, truth if kind else None))
    return found


def _of_planted(
    law: str, good: own.Planted, unit: own.Planted, rows: tuple[SoakRows, ...], kind: str, axis: int
) -> Truth:
    mean, levels, modes = _law_of_planted(law)
    if kind == "two units":
        axis = int(np.argmax(np.ptp(unit.second - unit.curve, axis=0)))
    signal = []
    for k, one in enumerate(rows):
        after = unit.second if k and unit.second is not None else unit.curve
        changed = np.interp(one.T, own.GRID, (after - good.curve)[:, axis])
        signal.append(changed + (dragged(one.T, 2 * own.PLAY) - one.T) * unit.play[axis])
    bias = [one.bias[:, axis] / own.DEG_H - np.interp(one.T, own.GRID, mean[:, axis]) for one in rows]
    return Truth(
        "level" if kind == "offset" else kind, _levels_of_planted((unit.curve - mean)[None])[0, axis], levels[:, axis],
        [one.t for one in rows], [one.T for one in rows], bias, own.GRID, modes, signal, unit.noise[axis],
        unit.walk[axis], *own.USUAL.get(kind, (0.0, 0.0)),
    )  # fmt: skip


@cache
def _law_of_planted(law: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mean = own.mean_curves()
    curves = np.array([unit.curve for unit in own.deal(law, DRAWN, 4711)]) - mean
    return mean, _levels_of_planted(curves), modes_of(curves[:300].transpose(0, 2, 1).reshape(-1, len(own.GRID)))


def _levels_of_planted(curves: np.ndarray) -> np.ndarray:
    """Return the levels (n, 3) of curves (n, G, 3), beside the other shapes that units differ by."""
    u = (own.GRID - 20) / 40
    shapes = np.stack([np.ones_like(u), u, np.cos(2.2 * u + 0.4), np.tanh(3 * (u - 0.3))], axis=1)
    return np.einsum("g,nga->na", np.linalg.pinv(shapes)[0], curves)


def drawn(law: str, count: int, seed: int, *, odd: bool) -> list[Dealt]:
    """Return a line of `benchmarks/foreign_families.py`."""
    good = foreign.draw(seed, law, count).units
    line = foreign.draw(seed, law, count, foreign.ODD if odd else ())
    found = []
    for ordinary, unit in zip(good, line.units, strict=True):
        rows = tuple(
            SoakRows(soak.t, soak.T, soak.bias, np.full(len(soak.t), soak.interval), {})
            for soak in line.soaks if soak.unit == unit.name
        )  # fmt: skip
        kind = FOREIGN.get(unit.odd, "")
        truth = (lambda *of: lambda: _of_drawn(law, *of))(ordinary, unit, rows, kind)
        found.append(Dealt(unit.name, rows, kind, truth if kind else None))
    return found


def _of_drawn(law: str, good: foreign.Unit, unit: foreign.Unit, rows: tuple[SoakRows, ...], kind: str) -> Truth:
    mean, levels, modes = _law_of_drawn(law)
    axis, signal = unit.axis, []
    if axis < 0:
        changed = (unit.curve if unit.other is None else unit.other) - good.curve
        axis = int(np.argmax(np.ptp(changed, axis=0)))
    for k, one in enumerate(rows):
        after = unit.other if k and unit.other is not None else unit.curve
        loop = unit.slope * (foreign.play(one.T, unit.width) - one.T) if unit.slope else 0.0
        signal.append(np.interp(one.T, foreign.GRID, (after - good.curve)[:, axis]) + loop)
    usual = {"walk": (foreign.WALK, 0.2), "noise": (foreign.WHITE, 0.1)}.get(kind, (0.0, 0.0))
    return Truth(
        "level" if kind == "offset" else kind, float(np.mean((unit.curve - mean)[:, axis])), levels[:, axis],
        [one.t for one in rows], [one.T for one in rows],
        [one.bias[:, axis] - np.interp(one.T, foreign.GRID, mean[:, axis]) for one in rows], foreign.GRID, modes,
        signal, unit.white[axis], unit.walk[axis], *usual,
    )  # fmt: skip


@cache
def _law_of_drawn(law: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4712)
    pairs = [foreign._deviation(law, rng) for _ in range(DRAWN)]
    shapes = np.array([shape for shape, _ in pairs[:300]])
    levels = np.array([level for _, level in pairs])
    return foreign._means(6.0), levels, modes_of(shapes.transpose(0, 2, 1).reshape(-1, len(foreign.GRID)))


def soaked(unit: Dealt) -> tuple[UnitInformation, UnitRecord]:
    """Return the information of a unit's soaks, and its record."""
    found, noise = soaked_of(unit.name, AXES, unit.rows, STEP)
    figures = {
        "noise": Figure.of(noise.white, noise.white_sigma), "walk": Figure.of(noise.walk, noise.walk_sigma),
        "hysteresis": hysteresis_of(unit.rows, noise.white, noise.likely, STEP), "soaks": soaks_of(unit.rows, STEP),
    }  # fmt: skip
    return found, UnitRecord(key="", unit=unit.name, state="done", axes=AXES, figures=figures)


def judged(family: Family | None, units: list[Dealt]) -> dict[str, tuple[Outlier, ...]]:
    """Return the odd units: of a family that they are, or each alone under one that is known."""
    pairs = [soaked(unit) for unit in units]
    if family is None:
        family = fit_family([(one, "") for one, _ in pairs])
        return find_outliers(family, [(one, "") for one, _ in pairs], [record for _, record in pairs]).odd
    found = {}
    for one, record in pairs:
        found |= find_outliers(family, [(one, "")], [record], fitted=False).odd
    return found


def known(units: list[Dealt]) -> Family:
    """Return a family of ordinary units, with its laws."""
    pairs = [soaked(unit) for unit in units]
    family = fit_family([(one, "") for one, _ in pairs])
    found = find_outliers(family, [(one, "") for one, _ in pairs], [record for _, record in pairs])
    return family.model_copy(update={"laws": found.laws})


def interval(k: int, n: int) -> str:
    """Return a share in percent with its interval."""
    from scipy.stats import beta

    low, high = (0.0 if k == 0 else beta.ppf(0.025, k, n - k + 1)), (1.0 if k == n else beta.ppf(0.975, k + 1, n - k))
    return f"{k} of {n}, {100 * k / max(n, 1):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def main() -> None:
    """Print a line for each law, and what they come to."""
    parser = argparse.ArgumentParser()
    for name in ("--foreign", "--known", "--check", "--clean", "--verbose"):
        parser.add_argument(name, action="store_true")
    parser.add_argument("--first", type=int)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--laws", nargs="*")
    asked = parser.parse_args()
    dealt, laws = (drawn, foreign.LAWS) if asked.foreign else (planted, own.LAWS)
    first = asked.first or (2001 if asked.check else 1)
    print(f"{asked.units} units, seeds {first} to {first + asked.seeds - 1}; found, nameable, planted; right words")
    print(f"{'law':11}" + "".join(f"{kind:>13}" for kind in KINDS) + "  false   units")
    every: Counter[tuple[str, str]] = Counter()
    for law in asked.laws or laws:
        count: Counter[tuple[str, str]] = Counter()
        begun = time.perf_counter()
        for seed in range(first, first + asked.seeds):
            family = known(dealt(law, asked.units, seed + 500, odd=False)) if asked.known else None
            units = dealt(law, asked.units, seed, odd=not asked.clean)
            found = judged(family, units)
            for unit in units:
                odd = found.get(unit.name, ())
                chance = unit.truth().chance(seed) if unit.truth is not None else 1.0
                nameable = chance < FALSE / asked.units
                for what, counts in (
                    ("all", True), ("found", bool(odd)), ("nameable", nameable), ("both", bool(odd) and nameable),
                    ("right", bool(unit.odd) and SAID[unit.odd] in {one.what for one in odd}),
                ):  # fmt: skip
                    count[unit.odd, what] += counts
                if asked.verbose and (bool(odd) != bool(unit.odd) or (unit.odd and SAID[unit.odd] != odd[0].what)):
                    said = [(one.sentence, f"{one.p:.1e}") for one in odd]
                    print("   ", seed, unit.name, unit.odd, f"oracle {chance:.1e}", said)
        every += count
        print(_row(law, count), f" {time.perf_counter() - begun:.0f} s", flush=True)
    print(_row("all", every))
    for what, k, n in (
        ("recall of all", "found", "all"), ("recall of what the oracle can name", "both", "nameable"),
        ("right words among those found", "right", "found"),
    ):  # fmt: skip
        print(f"{what}: {interval(sum(every[kind, k] for kind in KINDS), sum(every[kind, n] for kind in KINDS))}")
    false, hits = every["", "found"], sum(every[kind, "found"] for kind in KINDS)
    print(f"false among those named: {interval(false, false + hits)}; of ordinary: {interval(false, every['', 'all'])}")


def _row(law: str, count: Counter[tuple[str, str]]) -> str:
    cells = (
        f"{count[kind, 'both']}+{count[kind, 'found'] - count[kind, 'both']}/{count[kind, 'nameable']}/"
        f"{count[kind, 'all']} {count[kind, 'right']}" for kind in KINDS
    )  # fmt: skip
    return f"{law:11}" + "".join(f"{cell:>13}" for cell in cells) + f"{count['', 'found']:7}{count['', 'all']:8}"


if __name__ == "__main__":
    main()
