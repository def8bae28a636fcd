"""Pictures of the examples: a title that says the result, units on every axis, small files."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

GREY, BLUE, RED, DARK = "#9a9a9a", "#0b6e99", "#c8553d", "#333333"


def picture(
    title: str, rows: int = 1, columns: int = 2, height: float = 3.6, **how: object
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a title, and its panels row by row."""
    figure = Figure(figsize=(8.4, height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold")
    panels = list(figure.subplots(rows, columns, squeeze=False, **how).flat)
    for panel in panels:
        panel.grid(alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def save(figure: Figure, path: Path) -> None:
    """Write a figure, and say where."""
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    Image.open(drawn).convert("RGB").quantize(128).save(path, optimize=True)
    print(f"drawn: {path}")
