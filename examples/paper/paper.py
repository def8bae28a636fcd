"""The paper's experiment on a twin: its tables 5 to 12 beside ours, over many seeds. Nothing is tuned per table.

python examples/paper/paper.py [--seeds 20]
"""

from __future__ import annotations

import argparse
import json

import numpy as np
from numbers_of_the_paper import PAPER
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rich.text import Text
from twin import OUT, filter_config, fit, source

from driftlab.evaluation.comparison import Comparison, compare
from driftlab.storage.json import plain

console = Console(soft_wrap=True, width=120)


def rows_of(found: Comparison) -> list[np.ndarray]:
    """Return our values of the rows of PAPER, in its order."""
    return [
        found.reference_residual,
        found.nominal.first,
        found.nominal.whole,
        found.offset.first,
        found.offset.whole,
        np.mean(found.nominal.segments, axis=0),
        np.mean(found.offset.segments, axis=0),
        found.offset.convergence,
    ]


def main() -> None:
    """Make the twin, fit the network, run both filters over the seeds, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="how many ramps (default: 20)")
    seeds = parser.parse_args().seeds
    console.print("1. the twin's soak (15 plateaus of 2.5 h, 136,000 samples) and a network of 2 x 2 neurons an axis")
    fitted = fit()
    console.print(f"   domain {fitted.domain[0]:.2f} to {fitted.domain[1]:.2f} °C")
    console.print(f"2. the ramp (27.28 to 34.08 degC at 2 K/min, up and down, 26 min at 100 Hz), {seeds} seeds")
    values: dict[str, list[list[np.ndarray]]] = {"standard": [], "tczupt": []}
    for seed in track(range(1, seeds + 1), description="   both filters, 12 runs each", console=console):
        recording = source(seed, ramp=True)
        found = compare({name: filter_config(name, recording) for name in values})
        for name, comparison in found.items():
            values[name].append(rows_of(comparison))
    stacked = {name: np.array(rows) for name, rows in values.items()}  # (seeds, rows, 3)
    console.print(_table(stacked, seeds))
    times = {name: rows[:, -1, :] for name, rows in stacked.items()}
    ratio = times["standard"] / np.maximum(times["tczupt"], 0.1)
    console.print("TCZUPT converges first, share of the seeds: " + _axes(np.nanmean(ratio > 1, axis=0), ".2f"))
    console.print("standard / TCZUPT convergence time, median:  " + _axes(np.nanmedian(ratio, axis=0), ".1f"))
    content = {**stacked, "rows": list(PAPER), "paper": PAPER}
    (OUT / "paper.json").write_text(json.dumps(plain(content), indent=1) + "\n")
    console.print(f"written to {OUT.name}/: map.onnx, paper.json")


def _table(stacked: dict[str, np.ndarray], seeds: int) -> Table:
    table = Table(title=f"urad/s, times in s; ours: mean and deviation over {seeds} seeds", title_justify="left")
    table.add_column("", no_wrap=True)
    table.add_column("axis")
    for heading in ("standard\npaper", "standard\nours", "TCZUPT\npaper", "TCZUPT\nours"):
        table.add_column(Text(heading), justify="right", no_wrap=True)
    for k, (label, numbers) in enumerate(PAPER.items()):
        scale = 1.0 if "in s" in label else 1e6
        for axis in range(3):
            cells = []
            for paper, ours in zip(numbers, stacked.values(), strict=True):
                column = ours[:, k, axis] * scale
                cells += [f"{paper[axis] * scale:.4g}", f"{np.nanmean(column):.3g} ± {np.nanstd(column):.2g}"]
            table.add_row(label if axis == 0 else "", "xyz"[axis], *cells, end_section=axis == 2)
    return table


def _axes(values: np.ndarray, spec: str) -> str:
    return ", ".join(f"{axis} {value:{spec}}" for axis, value in zip("xyz", values, strict=True))


if __name__ == "__main__":
    main()
