"""Walks of a bias that are declared too small: the error over its sigma, what the NIS says, and what the remark says.

Runs of 4 h at 1 Hz, drawn with NumPy alone: white noise of 3 deg/h/sqrt(Hz), a walk of 0.02 deg/h/sqrt(s).

    python benchmarks/declared_walks.py [--runs 12] [--seed 100]
"""

from __future__ import annotations

import argparse
import re

import numpy as np

import driftlab

DEG_H = np.deg2rad(1) / 3600
NOISE, WALK, ROWS = 3.0, 0.02, 14_400
TIMES = (1, 2, 3, 5)  # too small


def one(seed: int, times: float) -> tuple[float, bool, float]:
    """Return the rms of the bias's error in its sigmas, whether the NIS is consistent, and the factor that is said."""
    rng, t = np.random.default_rng(seed), np.arange(float(ROWS))
    bias = 10 + np.cumsum(WALK * rng.normal(size=(ROWS, 3)), axis=0)
    gyro = {
        "noise": f"{NOISE} deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": f"{WALK / times} deg/h/sqrt(s)"}
    }  # fmt: skip
    config = {"filter": {"accel": None, "update_interval": "1 s", "gyro": gyro}}
    run = driftlab.run(config, {"time": (t, "s"), "gyro": (bias + NOISE * rng.normal(size=bias.shape), "deg/h")})
    truth = np.stack([np.interp(run.t, t, column) for column in bias.T], axis=1) * DEG_H
    off = ((run.bias - truth) / run.bias_sigma)[run.t > 61]
    found = re.search(r"add up.* about ([\d.]+) times too small", " ".join(run.lines()))
    return float(np.sqrt(np.mean(off**2))), run.summary["nis"]["consistent"], float(found[1]) if found else np.nan


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=100)
    options = parser.parse_args()
    for times in TIMES:
        off, consistent, said = np.array([one(options.seed + k, times) for k in range(options.runs)], dtype=float).T
        some = said[np.isfinite(said)]
        factor = f", {np.median(some):.2g} times in the median" if len(some) else ""
        print(
            f"walk declared {times} times too small: error / sigma {np.sqrt(np.mean(off**2)):.2f}, NIS consistent in "
            f"{int(np.sum(consistent))} of {options.runs}, remark in {len(some)}{factor}",
            flush=True,
        )


if __name__ == "__main__":
    main()
