"""What a soak has seen of the temperatures: where there are few samples or none, and how long each way took."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.maps.soak import CELLS, WAYS, Soak
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap

WIDTH = 1.0  # K, over which samples are counted
SPARSE = 0.2  # of the median: what is as dense as the rest is not few, however many there are
SHORT = 0.03  # of the range: fewer samples in less than that are not spoken of


@dataclass(frozen=True, eq=False)
class Thin:
    """A range of temperature with few samples.

    Attributes
    ----------
    start, stop : float
        degC.
    found, needed : float
        Samples a kelvin: the fewest there, and with how many white noise is no more than the curve's deviation.
    """

    start: float
    stop: float
    found: float
    needed: float


@dataclass(frozen=True, eq=False)
class Coverage:
    """How a soak's samples lie over its temperatures.

    Attributes
    ----------
    T, density : (CELLS,) arrays
        Middle of each cell, degC, and samples a kelvin about it.
    share : float
        Of the range, that has samples.
    holes : tuple of pairs
        Ranges without a sample, degC.
    thin : tuple of Thin
    hours : dict of str to float
        Warming, cooling, and neither.
    """

    T: Array
    density: Array
    share: float
    holes: tuple[tuple[float, float], ...]
    thin: tuple[Thin, ...]
    hours: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Return it for programs."""
        seen = self.density[self.density > 0]
        return {
            "share": self.share,
            "holes_degC": [list(hole) for hole in self.holes],
            "samples_per_K": {"least": float(seen.min()), "median": float(np.median(seen))},
            "thin": [vars(part) for part in self.thin],
            "hours": self.hours,
        }


def coverage_of(soak: Soak, fitted: FittedMap, good: Array | None) -> Coverage:
    """Return the coverage; `good` (d,) is what the curve is known to, where it is known."""
    count, edges = soak.count.sum(axis=0), soak.edges
    width = float(edges[1] - edges[0]) or 1.0
    reach = np.ones(max(1, 2 * round(WIDTH / width / 2) + 1))
    near = np.convolve(count, reach, "same") / (np.convolve(np.ones(CELLS), reach, "same") * width)
    error = fitted.record.error
    holes = error.holes if error is not None else tuple(_ranges(count == 0, edges, 0.05))
    hours = {name: soak.hours(way) for name, way in WAYS.items()} | {"neither": soak.hours(0)}
    thin = () if good is None else _thin(soak, near, count, good)
    return Coverage((edges[1:] + edges[:-1]) / 2, near, float(np.mean(count > 0)), holes, thin, hours)


def _thin(soak: Soak, near: Array, count: Array, good: Array) -> tuple[Thin, ...]:
    known = good > 0
    if not np.any(known):
        return ()
    needed = float(np.max((soak.white[known] / good[known]) ** 2))
    edges, found = soak.edges, []
    few = min(needed, SPARSE * float(np.median(near[count > 0])))
    for start, stop in _ranges((near < few) & (count > 0), edges, SHORT):
        inside = (edges[:-1] >= start) & (edges[1:] <= stop)
        found.append(Thin(start, stop, float(np.min(near[inside])), needed))
    return tuple(found)


def _ranges(where: NDArray[np.bool_], edges: Array, least: float) -> list[tuple[float, float]]:
    """Return the ranges in which cells are true, as far as they are wider than `least` of all."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(int)))
    pairs = zip(edges[change[::2]].tolist(), edges[change[1::2]].tolist(), strict=True)
    return [(a, b) for a, b in pairs if b - a > least * (edges[-1] - edges[0])]
