"""Rows of a soak: means of ROW seconds of samples at rest, with the other channels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from driftlab.family.basis import STEP
from driftlab.family.unit_information import SoakRows, UnitInformation
from driftlab.family.unit_noise import Densities, densities_of, walk_from_repeated_sweeps
from fusion_core.chunk import Array, Chunk

if TYPE_CHECKING:
    from driftlab.maps.fit import GatheredSoak

ROW = 10.0  # s
MAX_ROWS = 8640  # of a recording: of one that lasts longer than a day, they are longer
LEFT_OUT = ("temperature", "tau", "dt")  # of the channels: the rows have them already, or need them no more


def rows_of(soak: GatheredSoak, channel: str) -> tuple[SoakRows, ...]:
    """Return the rows of samples that were gathered with their epochs, of each recording or placement.

    Parameters
    ----------
    soak : GatheredSoak
        With its windows.
    channel : str
        Of the sensor whose bias it is.
    """
    rows, at = [], 0
    ends = np.cumsum([len(window) for window in soak.windows])
    for start, stop in pairwise([*soak.starts, len(soak.T)]):
        windows = soak.windows[
            int(np.searchsorted(ends, start, "right")) : int(np.searchsorted(ends, stop, "left")) + 1
        ]
        rows.append(_rows(windows, soak.T[start:stop], soak.bias[start:stop], channel))
        at = stop
    assert at == len(soak.T) == ends[-1], "windows and samples are the same epochs"
    return tuple(rows)


def soaked_of(
    unit: str, axes: tuple[str, ...], rows: tuple[SoakRows, ...], step: float = STEP
) -> tuple[UnitInformation, Densities]:
    """Return the information of rows on a unit under its own noise, and the densities of that.

    The walk is the likely one, or the larger one that repeated sweeps need.
    """
    noise = densities_of(rows, step)
    walk = walk_from_repeated_sweeps(rows, noise.white, noise.likely, step)
    return UnitInformation.of(unit, axes, rows, noise.white, walk, step), noise


def _rows(windows: Sequence[Chunk], T: Array, bias: Array, channel: str) -> SoakRows:
    t = np.concatenate([window.t for window in windows])
    tau = np.concatenate([window["tau"] for window in windows])
    length = max(ROW, float(t[-1] - t[0]) / MAX_ROWS)
    number = np.floor((t - t[0]) / length + 1e-6)
    starts = np.flatnonzero(np.diff(number, prepend=-1.0))
    span = np.add.reduceat(tau, starts)

    def means(values: Array) -> Array:
        weights = tau.reshape(-1, *[1] * (values.ndim - 1))
        total = np.add.reduceat(values * weights, starts, axis=0)
        return np.asarray(total / span.reshape(-1, *[1] * (values.ndim - 1)))

    names = [name for name in windows[0].channels if name not in (*LEFT_OUT, channel)]
    channels = {name: means(np.concatenate([window[name] for window in windows])) for name in names}
    return SoakRows(means(t - tau / 2), means(T), means(bias), span, channels)
