"""Run rules: patterns of units in a row that a line in control hardly shows.

Of deviations z from the centre, in sigmas. Each rule alarms at the unit that completes its pattern. Western Electric,
Statistical Quality Control Handbook (1956), four rules; Nelson, Journal of Quality Technology 16 (1984), 237 to 239,
eight. Together they alarm far more often than three sigma alone, of a line in control the four once in 92 units of a
chart in place of 370 (Champ and Woodall, Technometrics 29 (1987), 393 to 399). n units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from fusion_core.chunk import Array

Alarms = NDArray[np.bool_]


def _in_a_row(happened: Alarms, count: int) -> Alarms:
    """Return True where something `happened` (..., n) to `count` units in a row."""
    before = np.zeros((*happened.shape[:-1], count - 1), dtype=bool)
    return np.asarray(sliding_window_view(np.concatenate([before, happened], axis=-1), count, axis=-1).all(axis=-1))


def _some_beyond(z: Array, some: int, of: int, sigmas: float) -> Alarms:
    """Return True where a unit is the last of `some` of `of` units beyond so many sigmas on one side."""
    alarms = np.zeros(z.shape, dtype=bool)
    for side in (z > sigmas, z < -sigmas):
        before = np.zeros((*z.shape[:-1], of - 1), dtype=bool)
        count = sliding_window_view(np.concatenate([before, side], axis=-1), of, axis=-1).sum(axis=-1)
        alarms |= side & (count >= some)
    return alarms


def _one_side(z: Array, count: int) -> Alarms:
    return _in_a_row(z > 0, count) | _in_a_row(z < 0, count)


def _steadily(z: Array, count: int) -> Alarms:
    """Return True at the last of `count` units that all rise, or all fall."""
    steps = np.diff(z, axis=-1, prepend=z[..., :1])
    return _in_a_row(steps > 0, count - 1) | _in_a_row(steps < 0, count - 1)


def _alternating(z: Array, count: int) -> Alarms:
    """Return True at the last of `count` units that rise and fall in turns."""
    steps = np.diff(z, axis=-1, prepend=z[..., :1])
    turns = np.zeros(z.shape, dtype=bool)
    turns[..., 1:] = steps[..., 1:] * steps[..., :-1] < 0
    return _in_a_row(turns, count - 2)


BEYOND: Mapping[str, Callable[[Array], Alarms]] = {
    "2 of 3 units beyond 2 sigma on one side": lambda z: _some_beyond(z, 2, 3, 2.0),
    "4 of 5 units beyond 1 sigma on one side": lambda z: _some_beyond(z, 4, 5, 1.0),
}
RULES: Mapping[str, Mapping[str, Callable[[Array], Alarms]]] = {
    "western-electric": {**BEYOND, "8 units in a row on one side": lambda z: _one_side(z, 8)},
    "nelson": {
        "9 units in a row on one side": lambda z: _one_side(z, 9),
        "6 units in a row rise, or fall": lambda z: _steadily(z, 6),
        "14 units in a row rise and fall in turns": lambda z: _alternating(z, 14),
        **BEYOND,
        "15 units in a row within 1 sigma": lambda z: _in_a_row(np.abs(z) < 1, 15),
        "8 units in a row beyond 1 sigma": lambda z: _in_a_row(np.abs(z) > 1, 8),
    },
}
"""By name, the rules beside the one of each chart, a unit beyond three sigma."""
