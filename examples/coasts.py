"""The errors that a user feels, open loop before and after, from the `prediction.h5` of `driftlab explain`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from driftlab.evaluation.scores import over_axes

DEG_H = np.pi / 180 / 3600  # rad/s
Coast = tuple[NDArray[np.float64], NDArray[np.float64]]  # rms (d,), and the same with the mean of each axis removed


def coasts(folder: Path) -> dict[str, Coast]:
    """Return the error to the end of the holdout of the predictions `before` and `after`, in SI."""
    found = {}
    with h5py.File(folder / "prediction.h5") as file:
        (group,) = file.values()  # one holdout
        for name in ("before", "after"):
            error = group[name][()] - group["reference"][()]
            error = error[np.isfinite(error).all(axis=1)]
            found[name] = np.sqrt(np.mean(error**2, axis=0)), np.std(error, axis=0)
    return found


def table(title: str, rows: Iterable[tuple[str, Mapping[str, Coast]]], axes: Sequence[str], scale: float) -> Table:
    """Return rows of errors before and after, in units of `scale` (SI); several axes also as their rms."""
    made = Table(title=title, title_justify="left")
    for heading in ("prediction, to the end", "", *axes, *(["rms"] if len(axes) > 1 else [])):
        made.add_column(Text(heading), justify="left" if heading in ("prediction, to the end", "") else "right")
    for label, found in rows:
        for which, what in enumerate(("rmse", "constant removed")):
            for name in ("before", "after"):
                error = found[name][which] / scale
                values = [*error, over_axes(error)] if len(axes) > 1 else [*error]
                digits = 0 if max(values) >= 100 else 3
                cells = [f"{value:.{digits}f}" for value in values]
                made.add_row(f"{label}, {what}" if name == "before" else "", name, *cells, end_section=name == "after")
    return made
