"""Hysteresis of a gyro from one soak, and a unit without any: `python examples/09_hysteresis/run.py`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent.parent))
from pictures import BLUE, RED, picture, save

import driftlab
from driftlab.commands.fit_map import FitMapResult
from driftlab.commands.simulate import SimulateResult

CONFIG = yaml.safe_load((Path(__file__).parent / "unit.yaml").read_text())
OUT = Path(__file__).parents[2] / "demo_out" / "hysteresis"
DEG_H = np.pi / 180 / 3600
PLANTED = {"width": "4 K", "gain": "6 deg/h/K"}  # warming and cooling differ by 24 deg/h


def soaked(hysteresis: dict[str, str] | None, seed: int) -> tuple[SimulateResult, FitMapResult]:
    """Return a simulated soak, and the map that is fitted on it."""
    gyro = {**CONFIG["source"]["gyro"], "hysteresis": hysteresis}
    config = {**CONFIG, "source": {**CONFIG["source"], "gyro": gyro}}
    soak = driftlab.simulate(config, seed=seed)
    return soak, driftlab.fit_map(config, soak)


def main(out: Path) -> dict[str, FitMapResult]:
    """Fit both units, print what is said of a memory, and draw what each map leaves."""
    units = {"with a hysteresis": soaked(PLANTED, 1), "without": soaked(None, 2)}
    for name, (_, fitted) in units.items():
        print(f"unit {name}:", *fitted.lines(), sep="\n   ")
    draw(units, out / "hysteresis.png")
    return {name: fitted for name, (_, fitted) in units.items()}


def draw(units: dict[str, tuple[SimulateResult, FitMapResult]], path: Path) -> None:
    """Draw means of ten minutes less the map, while the unit warms and while it cools."""
    memory, other = (fitted.summary["judged"]["memory"] for _, fitted in units.values())
    size, sigma = (abs(memory[key][0]) / DEG_H for key in ("size", "sigma"))
    title = f"One soak: up and down differ by {size:.0f} ± {sigma:.1f} deg/h (24 planted); control: {other['answer']}"
    figure, panels = picture(title, height=3.4, sharey=True)
    for panel, (name, (soak, fitted)) in zip(panels, units.items(), strict=True):
        rows = len(soak["time"]) // 600 * 600
        T, x = (soak[key][:rows].reshape(-1, 600, *soak[key].shape[1:]).mean(axis=1) for key in ("temperature", "gyro"))
        left = (x - fitted.map.bias(np.clip(T, *fitted.map.domain)))[:, 0] / DEG_H
        warms = np.arange(len(T)) < np.argmax(T)
        for which, colour, label in ((warms, RED, "warming"), (~warms, BLUE, "cooling")):
            panel.plot(T[which], left[which] - np.mean(left), "o-", ms=3, lw=1, color=colour, label=label)
        panel.set(title=f"unit {name}", xlabel="temperature [°C]", ylabel="bias x less the map [deg/h]")
        panel.legend(frameon=False, fontsize=9)
    save(figure, path)


if __name__ == "__main__":
    main(OUT)
