"""Memories in one soak, judged on soaks that share no code with the judgement: power, false alarms, sizes, X.

    python benchmarks/memory_in_one_soak.py --nulls 600 --planted 600 --settling 200 --seed 0 --out soaks.jsonl
    python benchmarks/memory_in_one_soak.py --nulls 0 --planted 0 --tones 200 --beside 200 --seed 0
    python benchmarks/memory_in_one_soak.py --table soaks.jsonl ...

Soaks are drawn at random from the whole design of `foreign_soaks`: memories, profiles, 2 to 12 h, three slow noises,
sizes of 4 to 48 deg/h. Others have no memory, and settle with the time since they were switched on, in shapes that no
effect has, or have a tone in time: steady, square, fading, or of a frequency that wanders by 10 %, of 2 min to a third
of the soak; and some have a memory beside such a tone. Counts stand with 95 % limits of Clopper and Pearson, Biometrika
26 (1934) 404.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import foreign_soaks as foreign
import numpy as np
from scipy.stats import beta

from driftlab.maps.hysteresis.memory import memory_of
from driftlab.soak.blocks import brief

HOURS = (2.0, 4.0, 6.0, 8.0, 12.0)
SLOW = ("walk", "flicker", "gauss_markov")
TOLD = 15.0  # nats of the likelihood that knows the truth
ROWS = 5.0  # s
TONES = ("steady", "square", "fading", "wandering")
SETTLING: tuple[Callable[[np.ndarray], np.ndarray], ...] = (  # of the hours
    lambda h: 1 - np.log1p(h / 0.05) / np.log1p(h[-1] / 0.05),
    lambda h: 1 / (1 + h / 0.3),
    lambda h: 1 - np.sqrt(h / h[-1]),
    lambda h: (np.exp(-h / 0.1) + np.exp(-h / 0.8)) / 2,
)


def tone(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a tone (N, 3) of an amplitude of 1 at t (N,) s, each axis of its own phase."""
    period, form = np.exp(rng.uniform(*np.log([120.0, t[-1] / 3]))), rng.choice(TONES)
    wander = np.cumsum(rng.normal(size=len(t))) / np.sqrt(len(t)) * (0.1 if form == "wandering" else 0.0)
    wave = np.sin(2 * np.pi * np.cumsum((1 + wander) * t[1] / period)[:, None] + rng.uniform(0, 2 * np.pi, 3))
    wave = np.sign(wave) if form == "square" else wave
    return np.asarray(wave * np.exp(-3 * t / t[-1])[:, None] if form == "fading" else wave)


def one(seed: int, what: str) -> dict[str, Any] | None:
    """Draw one soak of a kind that `main` counts, and judge it; None where its profile does not tell this memory."""
    rng, planted = np.random.default_rng([seed, 99]), what in ("planted", "beside")
    memory = str(rng.choice(foreign.MEMORIES)) if planted else "none"
    profile, hours, slow = str(rng.choice(foreign.PROFILES)), float(rng.choice(HOURS)), str(rng.choice(SLOW))
    size = float(np.exp(rng.uniform(*np.log([4.0, 48.0])))) * foreign.DEG_H
    try:
        soak = foreign.draw(seed, profile, hours, slow, memory, size if planted else 0.0, interval=ROWS)
    except ValueError:
        return None
    told, fitted = (foreign.truth_gain(soak), foreign.truth_gain(soak, fitted=True)) if planted else (0.0, 0.0)
    bias = soak.bias
    if what == "settling":
        settled = SETTLING[rng.integers(len(SETTLING))](np.arange(len(soak.T)) * soak.interval / 3600)
        bias, memory = bias + np.outer(settled, size * rng.uniform(-1, 1, size=bias.shape[1])), what
    if what in ("tones", "beside"):
        strength = np.exp(rng.uniform(*np.log([1.0, 24.0]))) * foreign.DEG_H
        bias = bias + strength * tone(np.arange(len(soak.T)) * soak.interval, rng)
        memory = f"{memory} beside a tone" if planted else "tone"
    found = memory_of(brief(soak.T, bias, [0], soak.interval))
    names = ("size", "sigma", "none_larger_than")
    numbers = {name: (getattr(found, name) / foreign.DEG_H).tolist() for name in names}
    about = {"seed": seed, "memory": memory, "profile": profile, "hours": hours, "slow": slow}
    truth = {"true": (soak.size / foreign.DEG_H).tolist(), "told": told, "fitted": fitted}
    return {**about, **truth, "answer": found.answer, "kinds": found.kinds, "evidence": found.evidence, **numbers}


def share(count: int, of: int) -> str:
    """Return a share with its 95 % limits."""
    if not of:
        return "-"
    low = beta.ppf(0.025, count, of - count + 1) if count else 0.0
    high = beta.ppf(0.975, count + 1, of - count) if count < of else 1.0
    return f"{count}/{of} = {100 * count / of:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def table(rows: list[dict[str, Any]]) -> None:
    """Print power, false alarms, coverage of sizes, and whether X holds."""
    nulls, settling, tones = ([row for row in rows if row["memory"] == name] for name in ("none", "settling", "tone"))
    beside = [row for row in rows if row["memory"].endswith("beside a tone")]
    planted = [row for row in rows if row["memory"] not in ("none", "settling", "tone") and row not in beside]
    strong = [row for row in planted if row["told"] >= TOLD]

    def answers(which: list[dict[str, Any]], answer: str) -> str:
        return share(sum(row["answer"] == answer for row in which), len(which))

    print("nothing planted: seen", answers(nulls, "seen"), "| undecided", answers(nulls, "undecided"))
    print("settling: seen", answers(settling, "seen"), "| undecided", answers(settling, "undecided"))
    print("tones: seen", answers(tones, "seen"), "| undecided", answers(tones, "undecided"))
    z, wrong = _z([row for row in beside if row["answer"] == "seen"]), sum(map(_denied_wrongly, beside))
    print("beside a tone: seen", answers(beside, "seen"), "| a limit below the true size", share(wrong, len(beside)))
    print(f"  sizes within 1.96 sigma {share(int(np.sum(z < 1.96)), len(z))}")
    print(f"told at least {TOLD:g} nats: seen", answers(strong, "seen"), "| denied", answers(strong, "none"))
    fair = [row for row in planted if row["fitted"] >= TOLD]
    print(f"  the same, its noise and law fitted: seen {answers(fair, 'seen')} | denied {answers(fair, 'none')}")
    for low, high in ((5, 15), (15, 20), (20, 30), (30, 60), (60, np.inf)):
        some = [row for row in planted if low <= row["told"] < high]
        print(f"  told {low} to {high} nats: seen", answers(some, "seen"), "| denied", answers(some, "none"))
        both = [row for row in planted if low <= row["fitted"] < high]
        print(f"    the same, its noise fitted: seen {answers(both, 'seen')}")
    key: Callable[[dict[str, Any]], str]
    for key in (lambda r: r["profile"], lambda r: r["memory"], lambda r: r["slow"], lambda r: f"{r['hours']:g} h"):
        for name in sorted({key(row) for row in rows}):
            some, without = ([row for row in which if key(row) == name] for which in (strong, nulls))
            z = _z([row for row in some if row["answer"] == "seen"])
            within = f"1 sigma {share(int(np.sum(z < 1)), len(z))}, 1.96 {share(int(np.sum(z < 1.96)), len(z))}"
            print(f"{name:18} seen {answers(some, 'seen')} | sizes {within} | false {answers(without, 'seen')}")
    z = _z([row for row in planted if row["answer"] == "seen"])
    print(
        "sizes of all seen: 1 sigma", share(int(np.sum(z < 1)), len(z)), "| 1.96", share(int(np.sum(z < 1.96)), len(z))
    )
    larger = [row for row in planted if np.any(np.array(row["true"]) > np.array(row["none_larger_than"]))]
    if nulls:
        print("nothing planted: largest log evidence", f"{max(row['evidence'] for row in nulls):.2f}")
    print("larger than X: denied", answers(larger, "none"), "| seen", answers(larger, "seen"))


def _denied_wrongly(row: dict[str, Any]) -> bool:
    """Return True if a memory is denied that is larger, on an axis, than what is said of it."""
    return bool(row["answer"] == "none" and np.any(np.array(row["true"]) > np.array(row["none_larger_than"])))


def _z(rows: list[dict[str, Any]]) -> np.ndarray:
    """Return the errors of the sizes of the axes that have one, in their sigmas."""
    off = [
        abs(abs(size) - true) / sigma
        for row in rows
        for size, true, sigma in zip(row["size"], row["true"], row["sigma"], strict=True)
        if true > 0
    ]
    return np.array(off)


def main() -> None:
    """Draw, judge, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nulls", type=int, default=200)
    parser.add_argument("--planted", type=int, default=200)
    parser.add_argument("--settling", type=int, default=0)
    parser.add_argument("--tones", type=int, default=0)
    parser.add_argument("--beside", type=int, default=0, help="a memory beside a tone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", type=Path, nargs="*", help="print the table of files that are there")
    asked = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if asked.table:
        rows = [json.loads(line) for path in asked.table for line in path.read_text().splitlines()]
    else:
        counts = {what: getattr(asked, what) for what in ("nulls", "planted", "settling", "tones", "beside")}
        first = {"nulls": 0, "planted": 500_000, "settling": 900_000, "tones": 700_000, "beside": 800_000}
        jobs = [(asked.seed * 1_000_000 + first[what] + k, what) for what in counts for k in range(counts[what])]
        for k in np.random.default_rng(asked.seed).permutation(len(jobs)):
            row = one(*jobs[k])
            if row is not None:
                rows.append(row)
                if asked.out:
                    with asked.out.open("a") as file:
                        file.write(json.dumps(row) + "\n")
    table(rows)


if __name__ == "__main__":
    main()
