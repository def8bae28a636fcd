"""Gain of a family for a unit that is soaked short, on made-up families whose law is not Gaussian.

    python benchmarks/family.py [check] [--seed N] [KIND...]

A family of UNITS is fitted to whole soaks, and its bands are measured on units left out. NEW units of the same law,
dealt with another seed, are then soaked by each program of `family_generators.py`, and their posterior maps are held
against the truth over the whole range, level and all. Beside them: the family's mean; the unit's own polynomials of
order 1 to 5, by plain and by generalised least squares, as they go on, clamped, or straight on, and its own spline,
clamped: of these the best in hindsight of each program. Units' noise is as it is estimated from their rows.
`check`: the generators and seeds that were not looked at while all this was written. Behind what the 95 % bands hold is
its interval of 95 %, by the spread of the shares of single units.
"""

from __future__ import annotations

import argparse

import numpy as np
from family_generators import CHECKED, DEG_H, DEVELOPED, PROGRAMS, Kind, Made, soak

from driftlab.family.band_calibration import measure_bands
from driftlab.family.mixed_model import Family, fit_family
from driftlab.family.posterior_map import unit_posterior
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import densities_of
from driftlab.soak.blocks import SoakRows

UNITS, NEW, STEP = 200, 100, 2.5
AXES = ("x", "y", "z")
SEEDS = {"developed": 1, "checked": 101}
LEVELS = (0.994458, 1.959964, 2.967738)  # of 68, 95, 99.7 %
Maps = dict[str, np.ndarray]


def soaked(kind: Kind, unit: Made, program: str, seed: int) -> UnitInformation:
    rows = soak(kind, unit, program, seed)
    noise = densities_of([rows], STEP)
    return UnitInformation.of(unit.name, AXES, [rows], noise.white, noise.likely, STEP)


def family_of(kind: Kind, seed: int) -> Family:
    units = [(soaked(kind, unit, "whole", seed), "") for unit in kind.units(UNITS, seed)]
    family = fit_family(units)
    return family.model_copy(update={"bands": measure_bands(family, units)})


def own_maps(found: UnitInformation, T: np.ndarray) -> Maps:
    """Return the unit's own maps (N, 3) at T by name, SI."""
    rows = found.recordings[0]
    low, high = rows.T.min(), rows.T.max()
    middle, half = (low + high) / 2, (high - low) / 2
    inside = np.clip(T, low, high)
    maps = {"spline": found.knots.values(inside) @ np.stack([_spline(found, axis) for axis in range(3)], axis=1)}
    for order in range(1, 6):
        V = np.polynomial.chebyshev.chebvander((rows.T - middle) / half, order)
        for how in ("", " gls"):
            a = np.stack([_solved(found, rows, V, axis, weighted=bool(how)) for axis in range(3)], axis=1)
            curve = [np.polynomial.Chebyshev(own, [low, high]) for own in a.T]
            ends = np.stack([own(inside) for own in curve], axis=1)
            slope = np.stack([own.deriv()(inside) for own in curve], axis=1)
            maps[f"{order}{how}"] = np.stack([own(T) for own in curve], axis=1)
            maps[f"{order}{how} clamp"] = ends
            maps[f"{order}{how} tangent"] = ends + (T - inside)[:, None] * slope
    return maps


def _spline(found: UnitInformation, axis: int) -> np.ndarray:
    bends = np.diff(np.eye(found.knots.q), n=2, axis=0)
    J = found.J[axis]
    return np.asarray(np.linalg.solve(J + 1e-6 * np.trace(J) / len(J) * bends.T @ bends, found.h[axis]))


def _solved(found: UnitInformation, rows: SoakRows, V: np.ndarray, axis: int, *, weighted: bool) -> np.ndarray:
    X = np.column_stack([V, rows.bias[:, axis]])
    if weighted:
        X = rows.whitened(X, found.white[axis], found.walk[axis], free=False)
    return np.asarray(np.linalg.lstsq(X[:, :-1], X[:, -1], rcond=None)[0])


def judged(name: str, kind: Kind, seed: int) -> list[bool]:
    """Print a row for each program; return whether each meets its aims."""
    family = family_of(kind, seed)
    T = np.linspace(kind.low, kind.high, 81)
    B = family.knots.values(T)
    new = kind.units(NEW, seed + 50)
    truth = np.stack([unit.curve(T) for unit in new])
    mean = B @ family.marginal().c.T / DEG_H - truth
    met = []
    for program in PROGRAMS[1:]:
        error, z, said, own = [], [], [], dict[str, list[np.ndarray]]()
        for k, unit in enumerate(new):
            found = soaked(kind, unit, program, seed + 50)
            known = unit_posterior(family, found)
            error.append(B @ known.posterior.c.T / DEG_H - truth[k])
            said.append(known.sigma_at(T) / DEG_H)
            z.append(error[-1] / said[-1])
            for what, curve in own_maps(found, T).items():
                own.setdefault(what, []).append(curve / DEG_H - truth[k])
        best = min(own, key=lambda what: rms(own[what]))
        held = [float(np.mean(np.abs(z) < level)) for level in LEVELS]
        off = 1.96 * float(np.std(np.mean(np.abs(z) < LEVELS[1], axis=(1, 2)), ddof=1)) / np.sqrt(NEW)
        ours, alone = rms(error), rms(own[best])
        worst = max(ours / alone, ours / rms(mean))
        met.append(ours <= 0.5 * alone and 0.93 <= held[1] <= 0.97 and worst <= 1.05)
        print(
            f"| {name} | {program} | {ours:.3g} | {rms(said):.3g} | {rms(mean):.3g} | {alone:.3g} ({best}) | "
            f"{ours / alone:.2f} | {100 * held[0]:.1f} {100 * held[1]:.1f} ({100 * (held[1] - off):.1f} to "
            f"{100 * (held[1] + off):.1f}) {100 * held[2]:.1f} | {worst:.2f} |",
            flush=True,
        )
    return met


def rms(values: np.ndarray | list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seed", type=int)
    asked = parser.parse_args()
    which = "checked" if asked.names[:1] == ["check"] else "developed"
    kinds, seed = (CHECKED if which == "checked" else DEVELOPED), asked.seed or SEEDS[which]
    print("| family | soak | error | its sigma | family's mean | best own | ratio | holds 68 95 99.7 % | worst |")
    print("|---|---|---|---|---|---|---|---|---|")
    met = [one for name in [n for n in asked.names if n != "check"] or kinds for one in judged(name, kinds[name], seed)]
    print(f"\n{sum(met)} of {len(met)} meet all: ratio at most 0.5, 95 % band holds 93 to 97, worst at most 1.05")


if __name__ == "__main__":
    main()
