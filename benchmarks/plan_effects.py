"""Does the loop find what `driftlab plan` says that it would, from the size on that it says, and not below?

`python benchmarks/plan_effects.py [--seeds N] [--profiles NAME ...] [--effects NAME ...]`

A unit at rest in a chamber is made up sample by sample, sharing nothing with driftlab: a bent curve, white noise, a
walk, and one effect, at twice and at half of the size from which on the plan says that the loop finds it. The loop is
then given that one recording.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

os.environ.setdefault("OMP_NUM_THREADS", "1")  # cases run side by side
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from loop_cases.signatures import dragged, late

HOURS = 6.0
WHITE, WALK = np.deg2rad(3.18 / 3600), np.deg2rad(2.2e-5)  # rad/s/sqrt(Hz), rad/s/sqrt(s)
LAG = 200.0  # s, of the body behind the chamber
EFFECTS = ("hysteresis", "relaxation", "thermal_rate", "thermal_lag", "turn_on", "drift")
PROFILES = ("staircase up", "staircase up and down", "ramps 1", "ramps 3")
d = 3


def chamber(name, t):
    """Return the set points at t (N,)."""
    if name.startswith("ramps"):
        cycles = int(name.split()[1])
        return -15 + 65 * (1 - np.abs(1 - 2 * (t / (HOURS * 3600) * cycles % 1)))
    levels = np.arange(-15.0, 51.0, 5.0)
    if name.endswith("down"):
        levels = np.concatenate([levels, levels[::-1]])
    return levels[np.minimum((t / (HOURS * 3600) * len(levels)).astype(int), len(levels) - 1)]


def curve(T, slope=1.0):
    """Return the bias (N,) over temperature, bent: its slope grows three times from -15 to 50 degC."""
    x = (T - 17.5) / 32.5
    return slope * np.deg2rad(100 / 3600) * (x + x**2 / 4)


def shown(effect, t, T):
    """Return the signature of an effect (N,), with the hyper-parameters that stand in `effect`, of any size."""
    values = dict(effect.hyper_parameters)
    return {
        "hysteresis": lambda: dragged(T, values["width"]) - T,
        "relaxation": lambda: T - late(T, values["tau"]),
        "thermal_rate": lambda: late(late(np.gradient(T, t), values["tau"]), values["tau"]),
        "thermal_lag": lambda: curve(late(T, values["tau"])) - curve(T),
        "turn_on": lambda: np.exp(-t / values["tau"]),
        "drift": lambda: t - t[0],
    }[effect.kind]()


@dataclass(frozen=True)
class Case:
    """One recording: a profile, an effect at some times its smallest size, a seed."""

    profile: str
    kind: str
    times: float
    seed: int


def unit():
    """Return the plan's model of the unit."""
    from driftlab.planning.unit_model import UnitModel
    from driftlab.units import BiasUnit
    from fusion_plugins.thermal_maps.spline import Spline

    of_all = lambda T: np.stack([curve(T)] * d, axis=1)  # noqa: E731
    noise = np.full(d, WHITE), np.full(d, WALK)
    return UnitModel("gyro", ("x", "y", "z"), BiasUnit("rad/s", "deg/h"), Spline(), *noise, "", of_all, "")


def temperature(profile):
    """Return times (N,) and the body's temperature (N,) at 1 Hz."""
    t = np.arange(1.0, HOURS * 3600 + 1)
    return t, late(chamber(profile, t), LAG)


def outlook(profile, kinds=()):
    """Return the plan's prediction for a profile."""
    from driftlab.planning.detectability import predict_detectability

    t, T = temperature(profile)
    return predict_detectability(unit(), lambda at: np.interp(at, t, T), HOURS * 3600, kinds)


def recording(case, effect, size):
    """Return a made-up recording as the loop has it."""
    from driftlab.identification.records import Evidence, Record, lengths
    from fusion_core.chunk import Chunk

    t, T = temperature(case.profile)
    rng = np.random.default_rng([case.seed, 7])
    bias = curve(T)
    part = shown(effect, t, T)
    swing = np.ptp(part)
    if effect.kind == "thermal_lag":  # grows with the slope of the curve
        bias, part = 0.0, part + curve(T)
    bias = bias + size / swing * part
    walk = np.cumsum(rng.normal(size=(len(t), d)), axis=0) * WALK
    gyro = bias[:, None] + rng.normal(0, 1e-4, d) + walk + rng.normal(size=(len(t), d)) * WHITE
    fine, interval = lengths(HOURS * 3600, 1.0)
    n = int(fine)
    means = [x[: len(t) // n * n].reshape(-1, n, *x.shape[1:]).mean(axis=1) for x in (t, T, gyro)]
    chunk = Chunk(means[0], {"temperature": means[1], "gyro": means[2]}, sensors=frozenset({"gyro"}))
    number = np.floor((chunk.t - chunk.t[0] + 1e-6) / interval)
    record = Record("made up", True, True, chunk, np.flatnonzero(np.diff(number, prepend=-1.0)))
    return Evidence((record,), "gyro", ("x", "y", "z"), unit().unit, interval, 60.0)


def answer(case, effect, size):
    """Return the identified effects: names, and their rivals."""
    from driftlab.identification.result import investigate
    from fusion_plugins.thermal_maps.spline import Spline

    verdict = investigate(recording(case, effect, size), Spline(), (), lambda text: None).verdict
    return {f.effect.kind: (*f.names, *f.alike) for f in verdict.findings}


def asked(job):
    """Answer one case: it, its size and the identified effects."""
    case, effect, size = job
    return case, answer(case, effect, size)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--profiles", nargs="+", choices=PROFILES, default=list(PROFILES))
    parser.add_argument("--effects", nargs="+", choices=EFFECTS, default=list(EFFECTS))
    given = parser.parse_args()
    work, said = [], {}
    for profile in given.profiles:
        for one in outlook(profile).effects:
            if one.name in given.effects and one.found:
                said[profile, one.name] = one
                cases = [Case(profile, one.name, times, s) for times in (2.0, 0.5) for s in range(given.seeds)]
                work += [(case, one.effect, one.found_from * case.times) for case in cases]
    with ProcessPoolExecutor(given.jobs) as pool:
        found = list(pool.map(asked, work))
    print("| profile | effect | found from [deg/h] | found at 2 x | another named | at half | plan: confused with |")
    print("|---|---|---|---|---|---|---|")
    for (profile, kind), one in said.items():
        own = {t: [a for c, a in found if (c.profile, c.kind, c.times) == (profile, kind, t)] for t in (2.0, 0.5)}
        hits = {t: sum(kind in a or any(kind in v for v in a.values()) for a in answers) for t, answers in own.items()}
        others = ", ".join(sorted({str(set(a) | {n for v in a.values() for n in v}) for a in own[2.0]}))
        size = one.found_from * unit().unit.factor
        print(
            f"| {profile} | {kind} | {size:.2f} | {hits[2.0]}/{given.seeds} | {others} | {hits[0.5]}/{given.seeds} | "
            f"{', '.join(one.confused_with) or '-'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
