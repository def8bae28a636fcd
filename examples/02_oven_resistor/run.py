"""Close the loop on a measured resistor that lags behind its oven's thermometer, and on a control that does not.

python examples/02_oven_resistor/run.py            # judged on ramp 3
python examples/02_oven_resistor/run.py --all      # judged on each ramp in turn
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

sys.path.insert(0, str(Path(__file__).parent.parent))
from coasts import Coast, coasts, table

from driftlab.commands.explain import explain
from driftlab.config import load_config

HERE = Path(__file__).parent
DATA = HERE.parent / "data" / "oven_resistors"
OUT = HERE.parent.parent / "demo_out" / "oven"
RAMPS = ("::0:9300", "::9300:18300", "::18300:")  # s; each 25 to 35 to 25 degC, cut at the 25 degC plateaus
CONFIGS = {"lagging": "declared.yaml", "control": "control.yaml"}
PPM = 1e-6


@dataclass(frozen=True)
class Answer:
    """The result of explain on one resistor, and the errors of the predictions before and after, in parts of one."""

    verdict: str
    lines: tuple[str, ...]
    effects: list[dict]
    errors: dict[str, Coast]
    same_map: bool


def ask(which: str, judged: int, out: Path) -> Answer:
    """Explain a resistor on the two other ramps, in the order of time, and judge on one (1 to 3)."""
    parts = [f"{DATA / which}.csv{ramp}" for ramp in RAMPS]
    holdout = parts.pop(judged - 1)
    closed = explain(load_config(HERE / CONFIGS[which]), [parts[0]], [parts[1]], [holdout], out=out).closed
    same = (out / "declared.json").read_bytes() == (out / "explained.json").read_bytes()
    return Answer(closed.verdict.word, closed.lines, closed.content["effects"], coasts(out), same)


def main(every: bool) -> None:
    """Print what is found, and the errors on what was not seen."""
    console = Console(soft_wrap=True)
    for judged in (1, 2, 3) if every else (3,):
        for which in CONFIGS:
            out = OUT / (f"{which}_{judged}" if every else which)
            answer = ask(which, judged, out)
            console.print(f"{which}, judged on ramp {judged}: {answer.verdict.replace('_', ' ')}", style="bold")
            for line in answer.lines:
                console.print(f"   {line}", highlight=False)
            if not answer.effects:
                kept = "the declared map stays, byte for byte" if answer.same_map else "the map is another: a defect"
                console.print(f"   nothing added; {kept}", highlight=False)
            console.print(table("error, ppm", [(f"ramp {judged}", answer.errors)], ("resistance",), PPM))
    console.print(f"written to {OUT.relative_to(OUT.parent.parent)}/: a folder each, with report.html")


if __name__ == "__main__":
    main("--all" in sys.argv[1:])
