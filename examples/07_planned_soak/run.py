"""A planned soak beside a staircase of the same hours, on a simulated gyro: `python run.py [UNITS]`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent.parent))
from pictures import BLUE, RED, picture, save

import driftlab
from driftlab.commands.plan import PlanResult

CONFIG = yaml.safe_load((Path(__file__).parent / "unit.yaml").read_text())
OUT = Path(__file__).parents[2] / "demo_out" / "planned_soak"
DEG_H, GRID = np.pi / 180 / 3600, np.linspace(-15, 45, 100)  # rad/s, degC
STAIRS = {"kind": "soak", "start": "-20 degC", "stop": "50 degC", "hold": "13.6 min"}  # of 5 K, 4 h


def errors(profile: dict[str, object], units: int) -> np.ndarray:
    """Return the errors (units, G) of maps on x, deg/h, their level removed: each alignment learns it anew."""
    config = {**CONFIG, "source": {**CONFIG["source"], "profile": profile}}
    T, soaks = GRID - 25, (driftlab.simulate(config, seed=seed) for seed in range(units))
    truth = 20 * T + 0.5 * T**2 - 0.02 * T**3  # the curve of unit.yaml
    found = np.array([driftlab.fit_map(config, soak).map.bias(GRID)[:, 0] / DEG_H - truth for soak in soaks])
    return found - np.mean(found, axis=1, keepdims=True)


def main(units: int, out: Path) -> dict[str, float]:
    """Plan, soak units both ways, and return the rms of their maps' errors, deg/h."""
    plan = driftlab.plan(CONFIG, hours=4, range="-20..50 degC")
    knots = {"time": [f"{t} s" for t in plan["time"]], "temperature": [f"{T} degC" for T in plan["set_point"]]}
    found = {"staircase": errors(STAIRS, units), "planned": errors({"kind": "table", **knots}, units)}
    rms = {name: float(np.sqrt(np.mean(error**2))) for name, error in found.items()}
    title = f"Four hours, planned: {rms['planned']:.1f} deg/h of map error; a staircase leaves {rms['staircase']:.1f}"
    print(plan.headline, title, sep="\n")
    draw(title, plan, found, out / "planned_soak.png")
    return rms


def draw(title: str, plan: PlanResult, found: dict[str, np.ndarray], path: Path) -> None:
    """Draw both chamber profiles, and the errors of the maps beside the sigma that was foretold."""
    figure, (left, right) = picture(title, height=3.4)
    hours = np.cumsum([0, *([13.6 / 60, 2.5 / 60] * 15)[:-1]])
    left.plot(hours, np.repeat(np.arange(-20, 51, 5.0), 2), color=RED)
    left.plot(plan["time"] / 3600, plan["set_point"], color=BLUE)
    left.set(xlabel="time [h]", ylabel="chamber [°C]")
    left.legend(["staircase of 5 K", "planned"], frameon=False, fontsize=9)
    for error, colour in zip(found.values(), (RED, BLUE), strict=True):
        right.plot(GRID, error.T, color=colour, lw=0.7, alpha=0.7)
    T, sigma = plan["temperature"], plan["sigma"][:, 0] / DEG_H
    right.fill_between(T, -2 * sigma, 2 * sigma, color=BLUE, alpha=0.15, lw=0, label="± 2 sigma of plan")
    right.set(xlabel="temperature [°C]", ylabel="map less truth, x [deg/h]", xlim=(GRID[0], GRID[-1]))
    right.legend(frameon=False, fontsize=9)
    save(figure, path)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 12, OUT)
