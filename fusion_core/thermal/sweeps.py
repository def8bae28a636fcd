"""Turns of a temperature: ways up and down, sweeps, and how far each goes.

A temperature has turned where it is back by `turn` from its highest since it began to rise, or from its lowest since it
began to fall. It turned at that extreme, at the last sample of it: a plateau belongs to the way that led there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fusion_core.chunk import Array, Integers

TURN = 0.1  # of the whole swing: a smaller way back is no turning point
ONE_WAY = 0.1  # of the way up (or down) that the other way must have at least


def turning_points(T: Array, turn: float) -> list[int]:
    """Return the places at which T (K,) begins to move, turns, and has its last extreme; none where it hardly moves."""
    points: list[int] = []
    low = high = way = 0  # the extremes since the last turn
    way_on = np.sign(np.diff(T))
    straight = np.zeros(len(T), dtype=bool)  # samples that go on as the one before did are no extremes
    straight[1:-1] = way_on[1:] * way_on[:-1] > 0
    for k in np.flatnonzero(~straight).tolist():
        value = T[k]
        low, high = (k if value <= T[low] else low), (k if value >= T[high] else high)
        if way <= 0 and value - T[low] >= turn > 0:
            points, way, high = [*points, low], 1, k
        elif way >= 0 and T[high] - value >= turn > 0:
            points, way, low = [*points, high], -1, k
    return [*points, high if way > 0 else low] if way else []


def directions(T: Array, turn: float) -> Integers:
    """Return +1 (up), -1 (down) or 0 (neither so far) for each of T (K,)."""
    ways_of_T = np.zeros(len(T), dtype=np.int64)
    for start, stop in pairwise(turning_points(T, turn)):
        ways_of_T[start:] = np.sign(T[stop] - T[start])
    return ways_of_T


def sweeps_of(T: Array, turn: float) -> Integers:
    """Return the number of the sweep of each of T (K,): a new one begins after each turn."""
    turns = turning_points(T, turn)[1:-1]
    return np.searchsorted(np.asarray(turns, dtype=np.int64), np.arange(len(T))).astype(np.int64)


def rise_and_fall(T: Array, turn: float) -> tuple[float, float]:
    """Return the total rise of T (K,) between its turns, and the total fall."""
    steps = np.diff(T[turning_points(T, turn)])
    return float(np.sum(steps[steps > 0])), float(-np.sum(steps[steps < 0]))


def ways(recordings: Sequence[Array]) -> tuple[float, float]:
    """Return the total rise of temperatures (N,) between their turning points, and the total fall."""
    least = TURN * (max(map(np.max, recordings)) - min(map(np.min, recordings)))
    each = [rise_and_fall(T, least) for T in recordings]
    return sum(up for up, _ in each), sum(down for _, down in each)


def one_way(recordings: Sequence[Array]) -> str:
    """Return the way of temperatures (N,) that hardly ever come back: `warms up` or `cools down`; else nothing."""
    up, down = ways(recordings)
    if min(up, down) >= ONE_WAY * max(up, down):
        return ""
    return "warms up" if up > down else "cools down"
