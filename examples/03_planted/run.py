"""Plant an effect of a supply voltage in a measured recording, and ask what the model lacks.

The noise, the temperatures and the map's error are measured. The voltage and what it does to the gyro are planted, that
is made up, so the answer is known: this is a test of `explain`, and says nothing about the logger.

    python examples/03_planted/run.py [--holdout 1|2|3]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import h5py
import numpy as np
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "01_cats"))
from coasts import DEG_H, coasts, table
from demo import PLACEMENTS, recording

from driftlab.commands.explain import explain
from driftlab.config import load_config
from driftlab.evaluation.scores import over_axes

HERE = Path(__file__).parent
OUT = HERE.parent.parent / "demo_out" / "planted"
SIZE = 250 * DEG_H  # rms, before the factors
FACTORS = np.array([1.0, -0.7, 1.3])  # of x, y, z
SHORTEST, LONGEST = 1200.0, 14_400.0  # s: how long the voltage stays at a level
VOLT = 0.1  # V: deviation of the levels about 5 V
NOISE = 0.003  # V: of the voltmeter


def levels(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a signal (N,) that steps from level to level, of mean 0 and mean square 1."""
    edges = [t[0]]
    while edges[-1] < t[-1]:
        edges.append(edges[-1] + float(np.exp(rng.uniform(np.log(SHORTEST), np.log(LONGEST)))))
    x = rng.normal(size=len(edges) + 1)[np.searchsorted(edges, t)]
    return (x - x.mean()) / x.std()


def write(folder: Path, *, planted: bool, seed: int = 0) -> list[str]:
    """Write the three placements with a voltage, and with what it does if `planted`; return their names."""
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(recording()) as file:
        names = ("timestamp_utc", "angular_velocity", "acceleration", "temperature")
        t, rate, f, T = (file[name][()].astype(float) for name in names)
    rng = np.random.default_rng(seed)
    x = levels(t, rng)
    voltage = np.round(5 + VOLT * x + NOISE * rng.normal(size=len(t)), 3)
    gyro = rate * 1e-3 + planted * SIZE * x[:, None] * FACTORS
    path = folder / "cats_with_voltage.h5"
    with h5py.File(path, "w") as file:
        for name, values in (("time", t), ("gyro", gyro), ("accel", f), ("temperature", T), ("voltage", voltage)):
            file.create_dataset(name, data=values)
    return [f"{path}{part}" for part in PLACEMENTS]


def main(holdout: int) -> None:
    """Explain the recording with the voltage's effect, and the same without: the bed."""
    console = Console(soft_wrap=True)
    console.print("What follows is planted: a voltage that does not exist acts on a measured gyro.", style="bold")
    rows = []
    for name, planted in (("planted", True), ("bed", False)):
        folder = OUT / ("planted" if planted else "bed")
        parts = write(folder, planted=planted)
        judged = parts.pop(holdout - 1)
        closed = explain(load_config(HERE / "declared.yaml"), parts, parts, [judged], out=folder / "explained").closed
        rows.append((name, coasts(folder / "explained")))
        heading = name if planted else "the bed: the same, nothing planted"
        console.print(f"{heading}: {closed.verdict.word.replace('_', ' ')}", style="bold")
        for line in closed.lines:
            console.print(f"   {line}", highlight=False)
        for effect in closed.content["effects"]:
            found = [f"{v / DEG_H:.0f}" for v in effect["coefficients"].values()]
            console.print(f"   {effect['kind']} of {effect['channel']}: {', '.join(found)} deg/h/V", highlight=False)
        if planted:
            told = ", ".join(f"{v:.0f}" for v in SIZE / VOLT * FACTORS / DEG_H)
            console.print(f"   planted: {told} deg/h/V", highlight=False)
    console.print(table(f"error on placement {holdout}, deg/h", rows, ("x", "y", "z"), DEG_H))
    after, bed = over_axes(rows[0][1]["after"][1]), over_axes(rows[1][1]["before"][1])
    console.print(
        f"constant removed: what is left is {after / bed:.2f} times the bed; 1 is all that one can hope for",
        highlight=False,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--holdout", type=int, choices=(1, 2, 3), default=3, help="the placement that is judged on")
    main(parser.parse_args().holdout)
