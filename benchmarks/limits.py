"""Consumer's risk of each limit: the share of units beyond it that pass, on twins drawn with NumPy alone.

A cell is a quantity, a law of the noise and a program of temperatures. Its units are measured as driftlab measures
them, each axis is held against limits that are set by the truth: at the truth itself, where the risk is greatest and
must be 5 % (a unit a hair beyond its limit), and at some multiples of it. What is true:

- noise, bias instability: the densities that were drawn from;
- swing: largest less smallest value of the curve that was drawn, over the map's domain;
- residual: root of the mean over many such soaks of the mean square that the map leaves of 30 s averages;
- coast: root of the mean over many such runs of the mean square of prediction less 30 s average over 10 min;
- hysteresis: largest difference between warming and cooling of the memory that was drawn (`foreign_soaks`, of any
  program, hours, noise and size).

    python benchmarks/limits.py [--units 100] [--only NAME ...] [--seed 1]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import foreign_soaks
import numpy as np
from loop_cases.signatures import dragged
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from driftlab.config import Limits
from driftlab.evaluation.limits import Measured, check_limits
from driftlab.evaluation.measurements import of_allan, of_coast, of_map
from driftlab.evaluation.scores import score
from driftlab.maps.assessment import MapVerdict
from driftlab.maps.residual import residual_of
from driftlab.noise.allan import curve
from driftlab.noise.allan_fit import fit
from driftlab.soak.blocks import brief
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

Array = NDArray[np.float64]
DEG_H = np.deg2rad(1) / 3600
WHITE = 10 * DEG_H  # rad/s/sqrt(Hz)
DT = 2.0  # s, between samples
AXES = ("x", "y", "z")
TIMES = (0.9, 1.0, 1.25, 1.5, 2.0, 3.0)  # limits, in truths: units are beyond the first two
Rng = np.random.Generator


def flicker(rng: Rng, N: int) -> Array:
    """Return noise (N, 3) whose spectrum falls as 1 / f, of a bias instability of 1 by IEEE Std 952."""
    f = np.fft.rfftfreq(N, DT)[1:]
    amplitude = np.sqrt(N / (4 * DT) * 1 / (np.pi * f))[:, None]  # one-sided density B^2 / (pi f)
    lines = amplitude * (rng.normal(size=(len(f), 3)) + 1j * rng.normal(size=(len(f), 3)))
    return np.fft.irfft(np.concatenate([np.zeros((1, 3)), lines]), N, axis=0)


def walk(rng: Rng, N: int) -> Array:
    """Return a random walk (N, 3) of density 1 / sqrt(s)."""
    return np.cumsum(rng.normal(size=(N, 3)), axis=0) * np.sqrt(DT)


def gauss_markov(rng: Rng, N: int, tau: float) -> Array:
    """Return a stationary process (N, 3) of deviation 1 and correlation time tau."""
    part = np.exp(-DT / tau)
    steps = rng.normal(size=(N, 3)) * np.sqrt(1 - part**2)
    steps[0] = rng.normal(size=3)
    return np.asarray(lfilter([1], [1, -part], steps, axis=0))


LAWS: dict[str, Callable[[Rng, int], Array]] = {
    "white": lambda rng, N: np.zeros((N, 3)),
    "walk 0.03": lambda rng, N: 0.03 * DEG_H * walk(rng, N),
    "walk 0.1": lambda rng, N: 0.1 * DEG_H * walk(rng, N),
    "flicker 2": lambda rng, N: 2 * DEG_H * flicker(rng, N),
    "Gauss-Markov 3, 1 h": lambda rng, N: 3 * DEG_H * gauss_markov(rng, N, 3600.0),
}
PROGRAMS: dict[str, tuple[float, Callable[[Array], Array]]] = {  # hours, and degC over the part of the time
    "cycle 6 h": (6.0, lambda u: 15 - 35 * np.sin(2 * np.pi * u)),
    "once 4 h": (4.0, lambda u: 15 - 35 * np.cos(2 * np.pi * u)),
    "three sines 8 h": (8.0, lambda u: 15 - 35 * np.cos(6 * np.pi * u)),
}
Unit = tuple[
    Measured, Array
]  # what was measured of three axes, and what is true (3,), NaN: the root mean square of all


def soak(rng: Rng, law: str, program: str) -> tuple[Array, Array, Array]:
    """Return temperature (N,), bias (N, 3), and the coefficients (4, 3) of the curve in (T - 15) / 35."""
    hours, shape = PROGRAMS[program]
    N = int(hours * 3600 / DT)
    T = shape(np.arange(N) / N)
    c = rng.normal(size=(4, 3)) * np.array([50, 100, 40, 30])[:, None] * DEG_H
    bias = np.polynomial.polynomial.polyval((T - 15) / 35, c).T
    return T, bias + LAWS[law](rng, N) + rng.normal(size=(N, 3)) * WHITE / np.sqrt(DT), c


def of_soak(rng: Rng, law: str, program: str, kind: str) -> dict[str, Unit]:
    """Return residual and swing of a unit's map."""
    T, bias, c = soak(rng, law, program)
    settings = Polynomial(order=3) if kind == "cubic" else Spline()
    fitted = settings.fit(T, bias, {})
    left = residual_of(fitted, settings, T, bias, [0], DT)
    record = fitted.record.model_copy(update=left.as_record(DT * len(T)))
    found = of_map(replace(fitted, record=record))
    grid = np.polynomial.polynomial.polyval((np.linspace(*fitted.domain, 2000) - 15) / 35, c)
    return {"residual": (found["residual"], np.full(3, np.nan)), "swing": (found["swing"], np.ptp(grid, axis=1))}


def of_run(rng: Rng, law: str, hours: float) -> dict[str, Unit]:
    """Return the error of prediction of a run of a unit whose map is right."""
    N = int(hours * 3600 / DT)
    t = DT * np.arange(1, N + 1)
    rate = LAWS[law](rng, N) + rng.normal(size=(N, 3)) * WHITE / np.sqrt(DT)
    align = round(60 / DT)
    level = np.mean(rate[:align], axis=0)
    coast = np.where(np.arange(N)[:, None] < align, np.nan, level)
    estimates = {"t": t, "tau": np.full(N, DT), "still": np.ones(N, dtype=bool), "rate": rate, "bias": coast,
                 "coast": coast, "coast_sigma": coast}  # fmt: skip
    found = of_coast(score(estimates, None, AXES), float(t[-1] - t[align - 1]), 60.0)
    return {"coast": (found, np.full(3, np.nan))}


SMOOTHED: dict[str, Callable[[Array], Array]] = {
    "low-pass 0.2": lambda rate: lfilter(*butter(2, 0.2), rate),  # corner in parts of half the sampling rate
    "low-pass 0.4": lambda rate: lfilter(*butter(2, 0.4), rate),
    "interpolated": lambda rate: np.interp(np.arange(10 * len(rate)) / 10, np.arange(len(rate)), rate),
    "held": lambda rate: np.repeat(rate, 10),
}


def of_log(rng: Rng, law: str, hours: float, smoothed: Callable[[Array], Array] = np.asarray) -> dict[str, Unit]:
    """Return noise and bias instability of a static log, of its samples as they are or `smoothed`."""
    N = int(hours * 3600 / DT)
    rate = LAWS[law](rng, N) + rng.normal(size=(N, 3)) * WHITE / np.sqrt(DT)
    seen = [np.ascontiguousarray(smoothed(axis)) for axis in rate.T]
    found = of_allan([fit(curve(axis, DT * N / len(axis))) for axis in seen], AXES, DT * N)
    true = {"noise": WHITE, "bias_instability": 2 * DEG_H}
    return {name: (found[name], np.full(3, value)) for name, value in true.items()}


def of_play(rng: Rng, law: str, program: str, width: float) -> dict[str, Unit]:
    """Return the hysteresis of a unit whose bias follows a play operator of temperature, half a `width` wide."""
    T, bias, _ = soak(rng, law, program)
    slope = rng.uniform(0.5, 3, size=3) * rng.choice([-1, 1], size=3) * DEG_H
    bias = bias + (T - dragged(T, 2 * width))[:, None] * slope
    settings = Spline()
    fitted = settings.fit(T, bias, {})
    verdict = MapVerdict(fitted, settings, brief(T, bias, [0], DT))
    return {"hysteresis": (of_map(verdict.map)["hysteresis"], 2 * width * np.abs(slope))}


def of_memory(rng: Rng, memory: str) -> dict[str, Unit]:
    """Return the hysteresis of a unit with a memory of one of `foreign_soaks.MEMORIES`, of 4 to 40 deg/h in x."""
    size = np.exp(rng.uniform(*np.log([4, 40]))) * DEG_H * np.array([1, -2 / 3, 1 / 3])
    program, noise = rng.choice(foreign_soaks.PROFILES), rng.choice(foreign_soaks.NOISES[:3])
    hours, number = float(rng.choice([4.0, 6.0, 8.0, 12.0])), int(rng.integers(2**31))
    one = foreign_soaks.draw(number, str(program), hours, str(noise), memory, size, interval=5.0)
    settings = Spline()
    fitted = settings.fit(one.T, one.bias, {})
    verdict = MapVerdict(fitted, settings, brief(one.T, one.bias, [0], one.interval))
    return {"hysteresis": (of_map(verdict.map)["hysteresis"], one.size)}


CELLS: dict[str, Callable[[Rng], dict[str, Unit]]] = {
    **{f"{kind} map, {law}, {program}":
       lambda rng, kind=kind, law=law, program=program: of_soak(rng, law, program, kind)
       for kind in ("cubic", "spline") for law in LAWS for program in PROGRAMS},
    **{f"run {hours:g} h, {law}": lambda rng, law=law, hours=hours: of_run(rng, law, hours)
       for hours in (0.5, 2.0, 8.0) for law in LAWS},
    **{f"log {hours:g} h, flicker 2": lambda rng, hours=hours: of_log(rng, "flicker 2", hours) for hours in (2.0, 8.0)},
    **{f"log 2 h, flicker 2, {name}": lambda rng, name=name: of_log(rng, "flicker 2", 2.0, SMOOTHED[name])
       for name in SMOOTHED},
    **{f"play {width:g} K, {law}, {program}": lambda rng, law=law, program=program, width=width:
       of_play(rng, law, program, width)
       for width in (1.0, 4.0) for law in ("walk 0.03", "flicker 2") for program in PROGRAMS},
    **{f"foreign {memory}": lambda rng, memory=memory: of_memory(rng, memory) for memory in foreign_soaks.MEMORIES},
}  # fmt: skip


def decided(units: list[Unit], name: str, times: float) -> list[str]:
    """Return the decision on each axis of the units, of a limit so many times the truth."""
    values = np.array([measured.values for measured, _ in units])
    mean = np.sqrt(np.mean(values**2, axis=0))
    found = []
    for measured, true in units:
        for k, truth in enumerate(np.where(np.isfinite(true), true, np.mean(mean))):
            one = {field: getattr(measured, field) for field in ("values", "low", "high")}
            cut = {field: None if array is None else array[k : k + 1] for field, array in one.items()}
            own = Measured(axes=AXES[k : k + 1], missing=measured.missing, seconds=1.0, **cut)
            found.append(check_limits(Limits(**{name: times * truth}), {name: own})[0].decision)
    return found


def risk(passed: int, n: int) -> str:
    """Return the percentage that passes, with the binomial limits of 95 %."""
    from scipy.stats import binomtest

    low, high = binomtest(passed, n).proportion_ci(0.95)
    return f"{100 * passed / n:5.1f} ({100 * low:.1f}-{100 * high:.1f}) p"


def rows(name: str, units: dict[str, list[Unit]], whole: dict[str, tuple[int, int]]) -> Iterator[str]:
    """Yield a line a quantity: shares that pass (p) and fail (f) at each limit, and the 95 % limits of the risk.

    Counts of those that pass at the truth, and of all, are added to `whole`.
    """
    for quantity, each in units.items():
        shares = []
        for times in TIMES:
            said = decided(each, quantity, times)
            n, passed, failed = len(said), said.count("pass"), said.count("fail")
            if times == 1.0:
                before = whole.get(quantity, (0, 0))
                whole[quantity] = before[0] + passed, before[1] + n
                shares.append(f"{risk(passed, n)} {100 * failed / n:5.1f} f")
            else:
                shares.append(f"{100 * passed / n:5.1f} p {100 * failed / n:5.1f} f")
        yield f"{quantity:16} {name:42} {n:5} | " + " | ".join(shares)


def main() -> None:
    """Draw the cells and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--only", nargs="*", default=[""], help="cells whose name has one of these texts in it")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(f"percent that pass (p) and fail (f), limit / truth = {', '.join(map(str, TIMES))}")
    whole = dict[str, tuple[int, int]]()
    for number, (name, draw) in enumerate(CELLS.items()):
        if not any(text in name for text in options.only):
            continue
        begun, units = time.monotonic(), dict[str, list[Unit]]()
        for unit in range(options.units):
            rng = np.random.default_rng([options.seed, number, unit])
            for quantity, found in draw(rng).items():
                units.setdefault(quantity, []).append(found)
        for line in rows(name, units, whole):
            print(f"{line}   {(time.monotonic() - begun) / options.units:.2f} s", flush=True)
    for quantity, (passed, n) in whole.items():
        print(f"{quantity:16} {'all cells, at the limit':42} {n:5} | {risk(passed, n)}")


if __name__ == "__main__":
    main()
