"""Accuracy of a plan: its predicted sigma against simulated soaks of the same profiles, fitted.

    python benchmarks/plan.py [SEEDS]

Each soak goes the whole way: the source `synthetic`, the screening and the fit of `driftlab fit-map`. What a fit is off
by is its curve less the true one, without the mean over the soak, as sigma has it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from common import Row, show

import driftlab
from driftlab.commands.inputs import config_of
from driftlab.planning.chamber import Chamber, Profile, ramps, staircase
from driftlab.planning.search import RatedProfile, judge, search
from driftlab.planning.unit_model import UnitModel, twin_of

LOW, HIGH, LAG, HOURS = -20.0, 50.0, 300.0, 8.0
PAPER = {"kind": "soak"}  # its defaults are those of the paper, sec. 4
WITHIN = 0.15
POINTS = 200

# curves that both kinds can follow, so that it is the noise that is judged
CURVES = [
    {"offset": "0.1 deg/s", "linear": "2e-3 deg/s/K", "quadratic": "-3e-5 deg/s/K^2", "cubic": "6e-7 deg/s/K^3"},
    {"offset": "-0.2 deg/s", "linear": "-1.2e-3 deg/s/K", "quadratic": "5e-5 deg/s/K^2"},
    {"linear": "3e-3 deg/s/K", "quadratic": "2e-5 deg/s/K^2", "cubic": "-8e-7 deg/s/K^3"},
]
SMALL = [
    {"offset": "0.4 deg/h", "linear": "0.02 deg/h/K", "quadratic": "-4e-4 deg/h/K^2"},
    {"linear": "-0.03 deg/h/K", "cubic": "4e-6 deg/h/K^3"},
    {"offset": "-0.2 deg/h", "linear": "0.01 deg/h/K", "quadratic": "3e-4 deg/h/K^2"},
]
UNITS: dict[str, dict[str, Any]] = {
    # the walk of the floor of the paper's Allan curve, not that of its filter
    "mems_crs05": {"noise": "3.18 deg/h/sqrt(Hz)", "walk": "2.2e-5 deg/s/sqrt(s)", "curve": CURVES},
    "fog_kvh_p1775": {"noise": "0.012 deg/sqrt(h)", "walk": "3.0e-3 deg/h/sqrt(s)", "curve": SMALL},
}
MAPS: dict[str, dict[str, Any]] = {"polynomial": {"order": 5}, "spline": {}}


@dataclass(frozen=True)
class Came:
    """Result of 20 soaks: rms of the errors of the fits, and the median of their sigma, SI."""

    true: float
    said: float


def config(product: str, kind: str, profile: dict[str, Any], lag: float, seed: int = 0) -> dict[str, Any]:
    source = {
        "kind": "synthetic", "rate": "1 Hz", "profile": profile, "lag": f"{lag} s", "seed": seed,
        "gyro": UNITS[product],
    }  # fmt: skip
    bias = {"kind": "thermal_derivative", "walk": UNITS[product]["walk"], "map": {"kind": kind, **MAPS[kind]}}
    return {"extends": product, "source": source, "filter": {"update_interval": "1 s", "gyro": {"bias": bias}}}


def table(profile: Profile) -> dict[str, Any]:
    """Return a profile as the source has it."""
    return {
        "kind": "table",
        "time": [f"{t!r} s" for t in profile.time.tolist()],
        "temperature": [f"{T!r} degC" for T in profile.temperature.tolist()],
    }


def subject_of(product: str, kind: str) -> UnitModel:
    flat = {"kind": "table", "time": ["0 s", "1 h"], "temperature": ["20 degC", "20 degC"]}
    return UnitModel.of(config_of(config(product, kind, flat, 0.0)), None, None)


def recorded(product: str, kind: str, profile: dict[str, Any], lag: float, grid: np.ndarray, seeds: int) -> Came:
    """Fit soaks that are simulated."""
    squares, said = [], []
    for seed in range(seeds):
        described = config_of(config(product, kind, profile, lag, seed))
        fitted = driftlab.fit_map(described).map
        twin = twin_of(described)
        assert twin is not None
        t = np.arange(0.0, twin.time[-1], 5.0)
        T = Profile("", "mixed", twin.time, twin.temperature).body(t, lag)
        T, at = (np.clip(x, *fitted.domain) for x in (T, grid))
        error = fitted.bias(at) - twin.curve(at) - np.mean(fitted.bias(T) - twin.curve(T), axis=0)
        squares.append(np.mean(error**2, axis=0))
        said.append(np.mean(fitted.sigma(at) ** 2, axis=0))
    return Came(float(np.sqrt(np.mean(squares))), float(np.median(np.sqrt(np.mean(said, axis=1)))))


def foretold(judged: RatedProfile, grid: np.ndarray) -> float:
    """Return the rms of sigma over the grid and all axes."""
    columns = [np.interp(grid, judged.temperature, column) for column in judged.sigma.T]
    return float(np.sqrt(np.mean(np.square(columns))))


def rows_of(name: str, product: str, kind: str, judged: RatedProfile, chamber: Chamber, seeds: int) -> list[Row]:
    low, high = judged.covered
    grid = np.linspace(max(low, chamber.low) + 0.1, min(high, chamber.high) - 0.1, POINTS)
    expected = foretold(judged, grid)
    came = recorded(product, kind, table(judged.profile), chamber.lag, grid, seeds)
    shown = np.rad2deg(1) * 3600
    rows = []
    for what, value in (("true error", came.true), ("fits say", came.said)):
        text = f"{product}, {kind}, {name}: foretold {expected * shown:.3g} deg/h, {what} {value * shown:.3g} deg/h"
        ratio = value / expected
        rows.append(Row(text, f"{ratio:.2f}", f"1 ± {WITHIN}", abs(ratio - 1) <= WITHIN))
        print(f"{text}: {ratio:.2f}", file=sys.stderr, flush=True)
    return rows


def comes_true(seeds: int) -> list[Row]:
    """Compare for three profiles, two units and two kinds of map."""
    chamber = Chamber(LOW, HIGH, 25.0, 2 / 60, LAG)
    rows = []
    for product in UNITS:
        for kind in MAPS:
            subject = subject_of(product, kind)
            chosen = search(subject, chamber, HOURS).chosen.profile
            tried = {"staircase": staircase(chamber, HOURS, 5.0), "up and down": ramps(chamber, HOURS, 1)}
            for name, profile in {**tried, f"planned ({chosen.name})": chosen}.items():
                assert profile is not None
                rows += rows_of(name, product, kind, judge(profile, subject, chamber, 8), chamber, seeds)
    return rows


def half_the_hours(seeds: int) -> list[Row]:
    """Compare a plan of half the hours of the paper's soak with that soak, on paper and on simulated recordings."""
    rows, shown = [], np.rad2deg(1) * 3600
    for product, kind in (("mems_crs05", "spline"), ("mems_crs05", "polynomial"), ("fog_kvh_p1775", "spline")):
        twin = twin_of(config_of(config(product, kind, PAPER, LAG)))
        assert twin is not None
        long = Profile("the paper's soak", "staircase", twin.time, twin.temperature)
        low, high = float(np.min(twin.temperature)), float(np.max(twin.temperature))
        chamber, subject = Chamber(low, high, 25.0, 2 / 60, LAG), subject_of(product, kind)
        theirs = judge(long, subject, chamber, 4)
        found = search(subject, chamber, long.hours / 2).chosen
        grid = np.linspace(low + 0.8, high - 0.8, POINTS)
        paper = [foretold(item, grid) * shown for item in (theirs, found)]
        came = [
            recorded(product, kind, profile, LAG, grid, seeds).true * shown for profile in (PAPER, table(found.profile))
        ]
        for what, (whole, half) in (("foretold", paper), ("true error", came)):
            text = (
                f"{product}, {kind}: {what} {whole:.3g} deg/h after {long.hours:.3g} h of the paper's soak, {half:.3g} "
                f"deg/h after {found.profile.hours:.3g} h of {found.profile.name}"
            )
            rows.append(Row(text, f"{half / whole:.2f}", "≤ 1", half <= whole))
            print(f"{text}: {half / whole:.2f}", file=sys.stderr, flush=True)
    return rows


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    show(f"What a plan foretells, over what {seeds} simulated soaks come to", comes_true(seeds))
    show("Half the hours of the paper's soak", half_the_hours(max(seeds // 2, 3)))


if __name__ == "__main__":
    main()
