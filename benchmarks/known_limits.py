"""Soaks on which what `fit-map` states is known not to hold: `python known_limits.py [UNITS]`.

Three axes, a cubic of the temperature, white noise of 2 deg/h/sqrt(Hz), a walk of 0.01 deg/h/sqrt(s), 6 h from -20 to
60 degC and back at 1 Hz, in plain NumPy. They are not what the methods assume, and they are kept as they are to see
whether a later version does better (docs/explanation/how_a_map_is_judged.md).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from loop_cases.signatures import late

import driftlab

DEG_H = np.deg2rad(1 / 3600)
N, LOW, HIGH, LAG = 21_600, -20.0, 60.0, 120.0  # samples, degC, s of the body behind its chamber
WHITE, WALK = 2.0, 0.01
CONFIG = {
    "filter": {
        "gyro": {
            "noise": f"{WHITE} deg/h/sqrt(Hz)",
            "bias": {"kind": "thermal_derivative", "walk": f"{WALK} deg/h/sqrt(s)", "map": {"kind": "spline"}},
        },
        "accel": None,
    }
}
Curve = Callable[[np.ndarray], np.ndarray]


def temperature(*, back: bool) -> np.ndarray:
    """Return the temperature (N,) of a body that follows a ramp up, and back down."""
    corners = [0.0, 0.02, 0.49, 0.51, 1.0] if back else [0.0, 0.03, 0.97, 1.0, 1.0]
    chamber = np.interp(np.arange(N) / N, corners, [LOW, LOW, HIGH, HIGH, LOW if back else HIGH])
    return np.asarray(late(chamber, LAG))


def cubic(rng: np.random.Generator) -> Curve:
    """Return a curve of the temperature, deg/h."""
    a, b, c = rng.normal(0, [60, 25, 15])
    return lambda T: a * (T - 20) / 40 + b * ((T - 20) / 40) ** 2 + c * ((T - 20) / 40) ** 3


def fitted(T: np.ndarray, bias: np.ndarray, rng: np.random.Generator, keep: np.ndarray, limit: float | None) -> Any:
    """Return the result of `fit-map` on the samples to keep, of a bias (N, 3) in deg/h beside its noise."""
    wandering = np.cumsum(WALK * rng.normal(size=(N, 3)), axis=0)
    gyro = (bias + wandering + WHITE * rng.normal(size=(N, 3))) * DEG_H
    t, limits = np.arange(N, dtype=float), {} if limit is None else {"limits": {"hysteresis": f"{limit} deg/h"}}
    data = {"time": (t[keep], "s"), "gyro": (gyro[keep], "rad/s"), "temperature": (T[keep], "degC")}
    return driftlab.fit_map({**CONFIG, **limits}, data)


def ratios(found: Any, curves: list[Curve], more: Curve | None = None) -> np.ndarray:
    """Return the rms error of the curve over its stated sigma, an axis (3,); `more` is part of every true curve."""
    T = np.linspace(*found.map.domain, 400)[5:-5]
    truth = np.stack([f(T) for f in curves], axis=1) + (0.0 if more is None else more(T)[:, None])
    error = found.map.bias(T) / DEG_H - truth
    error -= error.mean(axis=0)
    sigma = np.array(found.summary["judged"]["sigma"]["rms"]) / DEG_H
    return np.sqrt(np.mean(error**2, axis=0)) / sigma


def one_way(seed: int) -> tuple[np.ndarray, bool]:
    """Return the ratios of a soak that only warms, and whether any is above 3."""
    rng, T = np.random.default_rng([seed, 1]), temperature(back=False)
    curves = [cubic(rng) for _ in range(3)]
    own = ratios(fitted(T, np.stack([f(T) for f in curves], axis=1), rng, np.ones(N, bool), None), curves)
    return own, bool(np.any(own > 3))


def narrow(seed: int) -> tuple[np.ndarray, bool]:
    """Return the ratios of a curve with a ripple narrower than its knots, and whether no misfit is stated."""
    rng, T = np.random.default_rng([seed, 2]), temperature(back=True)
    curves = [cubic(rng) for _ in range(3)]

    def ripple(T: np.ndarray) -> np.ndarray:
        return np.asarray(3 * np.sin(2 * np.pi * T / 0.7))

    found = fitted(T, np.stack([f(T) + ripple(T) for f in curves], axis=1), rng, np.ones(N, bool), None)
    return ratios(found, curves, ripple), not found.summary["judged"]["misfits"]


def two_lags(seed: int) -> tuple[np.ndarray, bool]:
    """Return true over stated size of a lag of 120 s warming and 900 s cooling, and whether 0.8 of it as limit passes.

    The size is that of the largest difference between warming and cooling at one temperature, 2 K from either end.
    """
    rng, T = np.random.default_rng([seed, 3]), temperature(back=True)
    curves, behind, at = [cubic(rng) for _ in range(3)], np.empty(N), LOW
    for k, now in enumerate(T.tolist()):
        at += (now - at) / (120.0 if now > at else 900.0)
        behind[k] = at
    loop = np.zeros((N, 3))
    loop[:, 0] = curves[0](behind) - curves[0](T) + behind - T
    grid, top = np.linspace(LOW + 2, HIGH - 2, 300), int(np.argmax(T))
    up, down = np.interp(grid, T[:top], loop[:top, 0]), np.interp(grid, T[top:][::-1], loop[top:, 0][::-1])
    size = float(np.max(np.abs(up - down)))
    found = fitted(T, np.stack([f(T) for f in curves], axis=1) + loop, rng, np.ones(N, bool), 0.8 * size)
    stated = abs(found.summary["memory"]["size"][0]) / DEG_H
    (limit,) = (row for row in found.limits if row.name == "hysteresis")
    return np.array([size / max(stated, 1e-3)]), limit.decision == "pass"


def no_turn(seed: int) -> tuple[np.ndarray, bool]:
    """Return the ratios of a soak without its hot third, and whether a hysteresis is seen where there is none."""
    rng, T = np.random.default_rng([seed, 4]), temperature(back=True)
    curves, keep = [cubic(rng) for _ in range(3)], np.abs(np.arange(N) / N - 0.5) > 0.13
    found = fitted(T, np.stack([f(T) for f in curves], axis=1), rng, keep, None)
    return ratios(found, curves), found.summary["memory"]["answer"] == "seen"


CASES = {
    "one way: an axis is off by more than 3 sigma": one_way,
    "a ripple of 0.7 K under knots of 1 K: no misfit is stated": narrow,
    "a lag of 120 and 900 s: a limit of 0.8 of it passes": two_lags,
    "no hot third of the soak: a hysteresis is seen": no_turn,
}


def main(units: int) -> None:
    """Print how often what is stated does not hold, and error over sigma, or size over stated size."""
    print("| soak, and what is wrong of it | soaks | error / sigma, or true / stated size: median, largest |")
    print("|---|---|---|")
    for name, case in CASES.items():
        each, wrong = zip(*(case(seed) for seed in range(units)), strict=True)
        own = np.concatenate(each)
        print(f"| {name} | {sum(wrong)} of {units} | {np.median(own):.2f}, {np.max(own):.1f} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 12)
