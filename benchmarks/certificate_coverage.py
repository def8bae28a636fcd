"""Coverage of the expanded uncertainty of a certificate: the share of true biases that are within it, by simulation.

Soaks are drawn with NumPy alone, with a thermometer that is off by what is declared. The truth at T is the curve that
was drawn, with the level of what wanders in the mean over the soak; of a play operator of temperature there are two,
warming and cooling. Nothing is shared with the budget: 95 % of the truths must lie within U, whichever source is the
largest.

    python benchmarks/certificate_coverage.py [--soaks 60] [--seed 1] [--only LAW]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from limits import DEG_H, DT, LAWS, PROGRAMS, WHITE
from loop_cases.signatures import dragged
from numpy.typing import NDArray

from driftlab.evaluation.uncertainty import UncertaintyBudget, bias_budget
from driftlab.maps.assessment import MapVerdict
from driftlab.soak.blocks import brief
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

Array = NDArray[np.float64]
KINDS = {"cubic": Polynomial(order=3), "spline": Spline()}
THERMOMETER = 0.3  # K, expanded: half of it is the deviation of its offset
WIDTH = 4.0  # K, half of that of a play operator
PLAY = "play, walk 0.03"
CELLS = [(kind, law, off) for laws in (LAWS, [PLAY]) for kind in KINDS for law in laws for off in (0.0, THERMOMETER)]


def soaked(rng: np.random.Generator, kind: str, law: str, off: float, program: str) -> tuple[UncertaintyBudget, Array]:
    """Return the budget of a simulated soak, and the truths (2, N, d) at its temperatures; `off` is expanded, K."""
    hours, shape = PROGRAMS[program]
    T = shape(np.arange(int(hours * 3600 / DT)) * DT / hours / 3600)
    c = rng.normal(size=(4, 3)) * np.array([50, 100, 40, 30])[:, None] * DEG_H
    wandering = LAWS[law.removeprefix("play, ")](rng, len(T))
    slope = rng.uniform(0.5, 3, size=3) * rng.choice([-1, 1], size=3) * DEG_H * (law == PLAY)
    bias = np.polynomial.polynomial.polyval((T - 15) / 35, c).T + wandering + np.outer(T - dragged(T, 2 * WIDTH), slope)
    bias = bias + rng.normal(size=bias.shape) * WHITE / np.sqrt(DT)
    read = T + off / 2 * rng.normal()
    fitted = KINDS[kind].fit(read, bias, {})
    verdict = MapVerdict(fitted, KINDS[kind], brief(read, bias, [0], DT))
    budget = bias_budget(verdict.map, thermometer=off or None)
    truth = np.polynomial.polynomial.polyval((budget.T - 15) / 35, c).T + np.mean(wandering, axis=0)
    return budget, np.array([truth - WIDTH * slope, truth + WIDTH * slope])


def coverages(soaks: int, seed: int, only: str = "") -> Iterator[tuple[str, float, float]]:
    """Yield name, share of the truths within U, and rms of error / u, of each cell whose law has a text in it."""
    for number, (kind, law, off) in enumerate(CELLS):
        if only not in law:
            continue
        errors = []
        for k in range(soaks):
            rng = np.random.default_rng([seed, number, k])
            budget, truth = soaked(rng, kind, law, off, list(PROGRAMS)[k % len(PROGRAMS)])
            errors.append(((budget.values - truth) / budget.u).ravel())
        all_of_them = np.concatenate(errors)
        name = f"{kind}, {law}, thermometer {off:g} K"
        yield name, float(np.mean(np.abs(all_of_them) <= 2)), float(np.sqrt(np.mean(all_of_them**2)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--soaks", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    for name, share, rms in coverages(options.soaks, options.seed, options.only):
        print(f"{name:50} {100 * share:5.1f} % within U, rms of error / u {rms:.2f}", flush=True)


if __name__ == "__main__":
    main()
