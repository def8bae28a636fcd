"""The loop on all three rotations of the measured recording: temperature undeclared, then declared with a cubic map.

Fitted on two placements, judged on the third. That temperature matters is known: withholding it is a test with a known
answer. Nobody knows what is left once it is declared.

    python examples/01_cats/rotations.py
"""

from __future__ import annotations

import sys
from pathlib import Path

from demo import HERE, OUT, PLACEMENTS, recording
from rich.console import Console

sys.path.insert(0, str(HERE.parent))
from coasts import DEG_H, coasts, table

from driftlab.commands.explain import explain
from driftlab.config import load_config


def same_map(folder: Path) -> bool:
    """Return True if the explained map is the declared one, byte for byte."""
    return (folder / "declared.json").read_bytes() == (folder / "explained.json").read_bytes()


def main() -> None:
    """Print what is found in each rotation, and one table for each declared model."""
    console = Console(soft_wrap=True)
    for which in ("undeclared", "declared"):
        rows = []
        for holdout in (3, 2, 1):
            parts = [f"{recording()}{span}" for span in PLACEMENTS]
            judged = parts.pop(holdout - 1)
            out = OUT / "rotations" / f"{which}_{holdout}"
            closed = explain(load_config(HERE / f"{which}.yaml"), parts, parts, [judged], out=out).closed
            rows.append((f"placement {holdout}", coasts(out)))
            kept = "; the map stays byte for byte" if which == "declared" and same_map(out) else ""
            console.print(f"{which}, placement {holdout}: {closed.verdict.word}{kept}", style="bold")
            for line in closed.lines:
                console.print(f"   {line}", highlight=False)
        console.print(table(f"temperature {which}, error in deg/h", rows, ("x", "y", "z"), DEG_H))


if __name__ == "__main__":
    main()
