"""Fit a map on two placements of a measured recording, run both filters on the third, and ask what is missing."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parent.parent))
import cats
from cats import PLACEMENTS, ROOT
from coasts import DEG_H, coasts
from pictures import BLUE, DARK, GREY, RED, picture, save

from driftlab.commands.explain import explain
from driftlab.commands.run import RunResult, run
from driftlab.config import load_config
from driftlab.evaluation.scores import over_axes
from driftlab.identification.result import Identification
from driftlab.maps.fit import fit_map
from driftlab.reports.tables import yardstick_table
from fusion_core.faults import Faults

HERE = Path(__file__).parent
OUT = ROOT / "demo_out"

console = Console(soft_wrap=True)


def recording() -> Path:
    """Return the path of the recording, fetched once."""
    return cats.recording(console)


def ask(which: str, known: list[str], judged: str, out: Path) -> Identification:
    """Ask what a declared model lacks, and print the answer and the error before and after."""
    closed = explain(load_config(HERE / f"{which}.yaml"), known, known, [judged], out=out).closed
    console.print(f"   verdict: {closed.verdict.word.replace('_', ' ')}")
    for line in closed.lines:
        console.print(f"   {line}", highlight=False)
    errors = coasts(out)
    before, after = (over_axes(errors[name][0]) / DEG_H for name in ("before", "after"))
    console.print(
        f"   placement 3, which was not seen: coast to the end {before:.0f} -> {after:.0f} deg/h, rms over axes"
    )
    return closed


def draw(result: RunResult, ends: float, path: Path) -> None:
    """Draw the gyro, the estimate and the prediction from the first minute, in means of five minutes."""
    rows = len(result["t"]) // 300 * 300
    mean = {k: result[k][:rows].reshape(-1, 300, *result[k].shape[1:]).mean(axis=1) for k in result}
    t, sigma = mean["t"] / 3600, mean["coast_sigma"] / DEG_H
    bias, rate, coast = (mean[k] / DEG_H for k in ("bias", "rate", "coast"))
    held = np.mean(np.abs(bias - coast) < 2 * sigma)
    title = f"Bias of a measured gyro, predicted for 23 h from its first minute: {100 * held:.0f} % within ± 2 sigma"
    figure, panels = picture(title, rows=2, height=5.0, sharex=True)
    for k, panel in enumerate(panels[:3]):
        panel.fill_between(t, (coast - 2 * sigma)[:, k], (coast + 2 * sigma)[:, k], color=RED, alpha=0.15, lw=0)
        panel.plot(t, rate[:, k], color=GREY, lw=2.5, label="gyro, 5 min average")
        panel.plot(t, bias[:, k], color=BLUE, lw=1.2, label="estimate")
        panel.plot(t, coast[:, k], "--", color=RED, lw=1.5, label="prediction, ± 2 sigma")
        panel.set_ylabel(f"bias {'xyz'[k]} [deg/h]")
    panels[0].legend(frameon=False, fontsize=8, loc="lower right")
    panels[3].plot(t, mean["temperature"], color=DARK, lw=1.2)
    panels[3].axhline(ends, ls=":", color=RED)
    panels[3].annotate("map ends", (t[0], ends), (0, 4), textcoords="offset points", color=RED, fontsize=8)
    panels[3].set_ylabel("temperature [°C]")
    for panel in panels[2:]:
        panel.set_xlabel("time [h]")
    save(figure, path)


def main() -> None:
    """Run the demonstration."""
    first, second, third = (f"{recording()}{span}" for span in PLACEMENTS)
    OUT.mkdir(exist_ok=True)
    console.print("1. fit a cubic thermal map on placements 1 and 2")
    faults = Faults()
    fitted = fit_map(load_config(HERE / "tczupt.yaml"), [first, second], None, faults)
    fitted.save(OUT / "map.json")
    low, high = fitted.domain
    console.print(f"   {fitted.record.samples:,} samples from {low:.2f} to {high:.2f} °C")
    for line in faults.lines():
        console.print(f"   note: {line}", highlight=False, soft_wrap=True)

    results = {}
    for step, name in enumerate(("standard", "tczupt"), start=2):
        console.print(f"{step}. run the {name} filter on placement 3, which the map has not seen")
        config = load_config(HERE / f"{name}.yaml", third)
        results[name] = run(config, out=OUT / name)
        for line in results[name].lines():
            console.print(f"   note: {line}", highlight=False, soft_wrap=True)
    console.print()
    sensor = results["tczupt"].model.tracked
    console.print(
        yardstick_table({name: r.overview.yardsticks for name, r in results.items()}, "CATS placement 3", sensor)
    )
    draw(results["tczupt"], high, OUT / "demo.png")
    console.print(
        "Both filters use the same map and the same walk, so they differ by their arithmetic alone, and coast alike:"
    )
    console.print(
        "what a user loses on driving off is the map's error. docs/explanation/theory.md, section 3, says why."
    )
    console.print()
    console.print("4. withhold the temperature: nothing is declared of it, the thermometer is recorded all the same")
    ask("undeclared", [first, second], third, OUT / "undeclared")
    console.print("   That temperature matters is known: this is a test with a known answer, and no discovery.")
    console.print()
    console.print("5. declare it, with the cubic map of step 1, and ask what is still missing")
    out = OUT / "explained"
    closed = ask("declared", [first, second], third, out)
    if not closed.content["effects"]:
        same = (out / "declared.json").read_bytes() == (out / "explained.json").read_bytes()
        console.print(f"   nothing is added; the map is the declared one byte for byte: {'yes' if same else 'NO'}")
        console.print("   What is left follows time, temperature, depth and magnetic field in no form that predicts a")
        console.print("   placement that was left out. It is called unexplained, and that is what it is.")
    console.print("   All three rotations: examples/01_cats/rotations.py; the method: docs/explanation/the_loop.md")
    console.print()
    console.print("written to demo_out/: map.json, demo.png; in standard/ and tczupt/ estimates.h5, summary.json and")
    console.print("report.html; in undeclared/ and explained/ loop.json, explained.yaml, prediction.h5, report.html")


if __name__ == "__main__":
    main()
