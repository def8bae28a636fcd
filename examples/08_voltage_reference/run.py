"""Temperature curve of a measured voltage reference, in ppm: `python examples/08_voltage_reference/run.py`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import polars as pl

sys.path.insert(0, str(Path(__file__).parent.parent))
from pictures import BLUE, GREY, RED, picture, save

import driftlab
from driftlab.commands.fit_map import FitMapResult

HERE = Path(__file__).parent
DATA = HERE.parent / "data" / "voltage_reference" / "ltz1000_warming.csv.gz"
OUT = HERE.parent.parent / "demo_out" / "voltage_reference"
PPM = 1e-6


def main(out: Path) -> FitMapResult:
    """Fit the curve, print what is known of it, and draw it."""
    fitted = driftlab.fit_map(HERE / "reference.yaml", str(DATA))
    for line in fitted.lines():
        print(line)
    out.mkdir(parents=True, exist_ok=True)
    fitted.save(out / "map.json")
    draw(fitted, out / "voltage_reference.png")
    return fitted


def draw(fitted: FitMapResult, path: Path) -> None:
    """Draw means of half a minute with the curve, and what the curve leaves of them."""
    log = pl.read_csv(DATA).group_by(pl.col("time") // 30, maintain_order=True).mean()
    T, x = log["temp"].to_numpy(), log["x"].to_numpy()
    grid = np.linspace(*fitted.map.domain, 200)
    curve, sigma = fitted.map.bias(grid)[:, 0] / PPM, fitted.map.sigma(grid)[:, 0] / PPM
    left = x - fitted.map.bias(np.clip(T, *fitted.map.domain))[:, 0] / PPM
    slope = (curve[-1] - curve[0]) / (grid[-1] - grid[0])
    title = f"LTZ1000: {slope:+.2f} ppm/K, known to {np.sqrt(np.mean(sigma**2)):.1f} ppm after one warm-up of 10 h"
    figure, (upper, lower) = picture(title, height=3.4, columns=2)
    upper.plot(T, x, ".", ms=2, color=GREY, label="measured, means of 30 s")
    upper.plot(grid, curve, color=BLUE, lw=1.5, label="cubic map")
    upper.set_ylabel("voltage, less 6 V [ppm]")
    upper.legend(frameon=False, fontsize=9)
    lower.fill_between(grid, -2 * sigma, 2 * sigma, color=BLUE, alpha=0.15, lw=0, label="± 2 sigma of the map")
    lower.plot(T, left - np.mean(left), ".", ms=2, color=RED, label=f"left over: {np.std(left):.2f} ppm rms")
    lower.set_ylabel("measured less map [ppm]")
    lower.legend(frameon=False, fontsize=9)
    for panel in (upper, lower):
        panel.set_xlabel("temperature at the reference [°C]")
    save(figure, path)


if __name__ == "__main__":
    main(OUT)
