"""Bands of running bias and prediction under thermometers of all kinds, over many more units than `coast_bands.py`.

The temperature, its readings (`foreign_thermometers.py`) and the errors of a filter of one state are drawn here; the
smooth temperature and sigma are driftlab's. The map is known: what its curve is off by is left to `coast_bands.py`.

    python benchmarks/thermometer_bands.py --minutes 5 --seed 1000
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from coast_bands import WIDTHS, Coarse
from foreign_thermometers import KINDS, read, true_temperature
from numba import njit

PRIOR = 10 * np.deg2rad(1) / 3600
REST = 60.0  # s, after which it coasts
STEPS, NOISES = (0.0, 0.05, 0.2, 0.5, 1.0), (0.0, 0.02, 0.2)
GROUPS = (), ("step",), ("kind", "step"), ("step", "noise"), ("averaged", "interval")


def temperatures(case: Coarse, rng: np.random.Generator, profile: str):
    """Return epochs of readings as the filter gets them, the error of what maps see of them, and the truth (N,)."""
    from driftlab.filtering.thermometer import ThermometerError
    from fusion_core.chunk import Chunk
    from fusion_core.thermal.rate_estimators import Regression, with_rate
    from fusion_core.thermal.thermometer import NO_STEPS, Steps, readings, sawtooth, started

    rate, hours = (100.0, 0.5) if case.interval < 0.1 else (10.0, 2.0)
    t = np.arange(round(hours * 3600 * rate)) / rate
    T = true_temperature(profile, t, rng)
    shown = read(T, case.step, case.noise, rng, case.averaged)
    step, variance = readings(shown, started())
    per = max(1, round(case.interval * rate))
    mean, true = (x[: len(x) // per * per].reshape(-1, per).mean(axis=1) for x in (shown, T))
    end = np.arange(1, len(mean) + 1) * per - 1
    known = Steps(case.step, case.noise) if case.step else NO_STEPS
    coarse = known.size, float(np.sum(sawtooth(*known)))
    first = Chunk(t[end[:1]] - case.interval, {"temperature": mean[:1]})
    channels = {"temperature": mean, "temperature_step": step[end], "temperature_variance": variance[end]}
    chunk, _ = with_rate(Chunk(t[end], channels, first), Regression(), None, coarse, (-50.0, 100.0))
    return np.ascontiguousarray(chunk["temperature"]), ThermometerError(known, 60.0).look(chunk), true


@njit
def filtered(e, walk, noise, Q, R, at, now):
    """Return the variance (N, 1) of a filter of one state and its error (N,), of which e is the thermometer's."""
    P, off = np.empty((len(e), 1)), np.empty(len(e))
    for k in range(len(e)):
        at += Q
        gain = at / (at + R)
        at *= 1 - gain
        now += (e[k] - e[k - 1] if k else 0.0) - walk[k]
        now += gain * (noise[k] - now)
        P[k, 0], off[k] = at, now
    return P, off


def errors(case: Coarse, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return error over sigma of prediction and running bias once a minute, (n,) each, of one axis."""
    from driftlab.filtering.coasting import _deviations

    rng, law = np.random.default_rng([seed, 77]), KINDS[case.kind]
    T, error, true = temperatures(case, rng, ("chamber", "day", "warm_up", "chamber")[seed % 4])
    N, b = len(T), law.slope * rng.uniform(0.5, 1.0)
    e, R, Q = b * (T - true), law.white**2 / case.interval, law.walk**2 * case.interval
    walk, noise = rng.normal(size=N) * np.sqrt(Q), rng.normal(size=N) * np.sqrt(R)
    P, off = filtered(e, walk, noise, Q, R, 1e4 * PRIOR**2, 100 * PRIOR * rng.normal())
    cut = max(1, round(REST / case.interval))
    first, later = (
        type(error)(*(np.ascontiguousarray(x[part]) for x in error)) for part in (slice(cut), slice(cut, N))
    )
    tables = (-60.0, 1.0, np.full((200, 1), b), np.zeros((200, 0, 1)), np.zeros((200, 1)))
    known, learnt = np.zeros((3, 2, 1)), np.array([[np.nan], [0.0], [0.0]])
    weight, given = np.full(N, case.interval), (np.array([law.white**2]), np.zeros(1), np.zeros(1), *tables)
    sigma, coasting = np.empty((N, 1)), np.empty((N, 1))
    walked = P[cut - 1, 0] + Q * np.arange(1 - cut, N - cut + 1)[:, None]  # from the departure on
    for part, error in ((slice(cut), first), (slice(cut, N), later)):
        variances, outputs = (P[part], walked[part]), (sigma[part], coasting[part])
        _deviations(T[part], *error, *variances, weight[part], *given, known, known.copy(), learnt, *outputs)
    coast = off[cut - 1] + e[cut:] - e[cut - 1] - np.cumsum(walk[cut:])
    each = max(1, round(60 / case.interval))
    return (coast / coasting[cut:, 0])[::each], (off[cut:] / sigma[cut:, 0])[::each]


def shares(drawn: list[tuple[np.ndarray, np.ndarray]], k: int) -> str:
    """Return the shares within the bands in percent, each with its 95 % limit over units, and the rms."""
    held = 100 * np.array([[np.mean(np.abs(one[k]) < width) for width in WIDTHS] for one in drawn])
    limit = 1.96 * held.std(axis=0, ddof=1) / np.sqrt(len(held)) if len(held) > 1 else np.full(3, np.nan)
    rms = np.sqrt(np.mean([np.mean(one[k] ** 2) for one in drawn]))
    return " | ".join(f"{m:.1f} ± {s:.1f}" for m, s in zip(held.mean(axis=0), limit, strict=True)) + f" | {rms:.2f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cases = [
        Coarse(kind, step, noise, averaged, interval)
        for interval in (0.01, 1.0, 10.0) for kind in ("FOG", "MEMS") for step in STEPS for noise in NOISES
        for averaged in (1, 10)
    ]  # fmt: skip
    rng, end, seed = np.random.default_rng(options.seed), time.monotonic() + 60 * options.minutes, options.seed
    found: list[tuple[Coarse, tuple[np.ndarray, np.ndarray]]] = []
    while time.monotonic() < end:
        case, seed = cases[rng.integers(len(cases))], seed + 1
        found.append((case, errors(case, seed)))
    print("| | units | coast 68.3 | 95.0 | 99.7 | rms | running bias 68.3 | 95.0 | 99.7 | rms |")
    print("|---" * 10 + "|")
    for names in GROUPS:
        groups: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for case, drawn in found:
            groups.setdefault(", ".join(f"{name} {getattr(case, name)}" for name in names), []).append(drawn)
        for key, drawn in sorted(groups.items()):
            print(f"| {key or 'all'} | {len(drawn)} | {shares(drawn, 0)} | {shares(drawn, 1)} |")


if __name__ == "__main__":
    main()
