"""Noise inflated by what innovations measured, against the folklore of ten and twenty, on the measured recording.

Factors come from a run over placement 1; judged is placement 3, which that run has not seen, by a filter of each set of
numbers on the raw gyro: one walk and one noise for three axes, as Kalibr and OpenVINS take them.

    python examples/01_cats/inflation.py
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from demo import DEG_H, HERE, PLACEMENTS, recording
from rich.console import Console
from rich.table import Table
from rich.text import Text

from driftlab.commands.export import inflations
from driftlab.commands.run import run
from driftlab.config import load_config
from fusion_core.contracts import Inflation

AHEAD = 600  # s


def measured(placement: str, folder: Path) -> tuple[np.ndarray, Inflation]:
    """Return the raw gyro (N, 3) of a placement at 1 Hz, and what the innovations of its run say."""
    config = load_config(HERE / "base.yaml", f"{recording()}{placement}")
    result = run(config, out=folder)
    return np.asarray(result["rate"]), inflations(folder)["gyro"]["raw"]


def judged(rate: np.ndarray, noise: float, walk: float) -> tuple[float, float, float]:
    """Return the mean NIS, and the rms of the error ten minutes ahead: in deg/h, and in what is said of it."""
    P, x, nis, errors = noise**2, rate[0].copy(), [], []
    for k in range(1, len(rate)):
        P += walk**2
        S, y = P + noise**2, rate[k] - x
        nis.append(y**2 / S)
        x, P = x + P / S * y, P - P * P / S
        if k % AHEAD == 0 and k > AHEAD and k + AHEAD <= len(rate):
            said = np.sqrt(P + walk**2 * (AHEAD - 30) + noise**2 / 60)  # the mean of the last minute
            error = np.mean(rate[k + AHEAD - 60 : k + AHEAD], axis=0) - x
            errors.append((error / DEG_H, error / said))
    far, normed = (np.sqrt(np.mean(np.square(part))) for part in zip(*errors, strict=True))
    return float(np.mean(nis)), float(far), float(normed)


def main() -> None:
    """Print one table."""
    with TemporaryDirectory() as folder:
        _, found = measured(PLACEMENTS[0], Path(folder) / "first")
        rate, _ = measured(PLACEMENTS[2], Path(folder) / "third")
    declared = float(np.max(found.noise)), float(np.max(found.walk))
    exported = float(np.max(found.noise * found.of_noise.value)), float(np.max(found.walk * found.of_walk_up_to(600.0)))
    rows = {"declared": declared, "exported, from placement 1": exported}
    rows |= {f"{factor} times": (factor * declared[0], factor * declared[1]) for factor in (10, 20)}
    table = Table(title="CATS placement 3", title_justify="left")
    headings = ("noise and walk", "deg/h/sqrt(Hz)", "deg/h/sqrt(s)", "NIS", "10 min ahead, deg/h", "over its sigma")
    for heading in headings:
        table.add_column(Text(heading), justify="left" if heading == "noise and walk" else "right")
    for name, numbers in rows.items():
        nis, far, normed = judged(rate, *numbers)
        cells = [f"{numbers[0] / DEG_H:.0f}", f"{numbers[1] / DEG_H:.2f}", f"{nis:.3f}", f"{far:.0f}", f"{normed:.2f}"]
        table.add_row(name, *cells)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
