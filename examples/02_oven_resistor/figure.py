"""Draw measured and predicted on ramp 3, after run.py: `python examples/02_oven_resistor/figure.py FILE.png`."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
from matplotlib.axes import Axes
from run import DATA, OUT, PPM

sys.path.insert(0, str(Path(__file__).parent.parent))
from pictures import picture, save

STYLE = {"before": ("#c8553d", "by the declared cubic"), "after": ("#0b6e99", "with what was added")}
EVERY = 3  # rows are drawn


def draw(upper: Axes, lower: Axes, which: str) -> None:
    """Draw measured and predicted value, and the error less its mean."""
    with h5py.File(OUT / which / "prediction.h5") as file:
        (group,) = file.values()
        t, measured = group["t"][::EVERY] / 3600, group["reference"][::EVERY, 0] / PPM
        upper.plot(t, measured, color="#9a9a9a", lw=2.6, label="measured, 30 s average")
        lower.axhline(0, color="#9a9a9a", lw=1)
        for name, (colour, label) in STYLE.items():
            predicted = group[name][::EVERY, 0] / PPM
            width = 2.4 if name == "before" else 1.2
            upper.plot(t, predicted, color=colour, lw=width, label=f"predicted {label}")
            error = predicted - measured
            shown = f"{name}, {np.nanstd(error):.2f} ppm rms"
            lower.plot(t, error - np.nanmean(error), color=colour, lw=width, label=shown)
    upper.set_title({"lagging": "lags behind its oven", "control": "control: nothing is added"}[which], fontsize=10)


def main(path: Path) -> None:
    """Draw both resistors side by side, with the oven's temperature."""
    title = "A lag behind the oven is found, and predicts the next ramp; nothing is added to the control"
    shape = {"sharex": True, "sharey": "row", "gridspec_kw": {"height_ratios": (3, 3, 1.4)}}
    figure, found = picture(title, rows=3, height=5.4, **shape)
    panels = np.array(found).reshape(3, 2)
    for column, which in enumerate(("lagging", "control")):
        draw(panels[0, column], panels[1, column], which)
        table = np.genfromtxt(DATA / f"{which}.csv", delimiter=",", names=True)
        ramp = table["time"] >= 18_300
        panels[2, column].plot(table["time"][ramp] / 3600, table["oven"][ramp], color="#333333", lw=1)
        panels[2, column].set_xlabel("time [h]")
        panels[1, column].legend(fontsize=7, loc="lower right", frameon=False)
    panels[0, 0].legend(fontsize=8, loc="upper right", frameon=False)
    for panel, label in zip(panels[:, 0], ("resistance [ppm]", "error, mean off [ppm]", "oven [°C]"), strict=True):
        panel.set_ylabel(label)
    save(figure, path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
