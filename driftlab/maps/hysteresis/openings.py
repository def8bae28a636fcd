"""How far apart warming and cooling are: what shapes show on each sweep, and where two of them differ most.

The opening of a memory is the greatest difference between a sweep up and a sweep down at the same temperature. W
sweeps, G temperatures, J shapes, d axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from driftlab.soak.blocks import SoakSummary
from driftlab.soak.sweeps import Index
from fusion_core.chunk import Array

Mask = NDArray[np.bool_]

GRID = 121
OTHER = 0.5  # of an opening: almost as far


class Sweeps:
    """What shapes show on the sweeps of a soak.

    Attributes
    ----------
    T : (G,) array
        Temperatures, degC.
    up : (W,) array of bool
        Which sweeps go up.
    shown : (W, G, J, d) array
        What a coefficient of 1 adds there; NaN where the sweep is not.
    """

    def __init__(self, soak: SoakSummary, values: Array) -> None:
        """Take what shapes show on the slots, values (S, J, d)."""
        self.T = np.linspace(*soak.domain, GRID)
        key = soak.recording * 3 + soak.way
        cuts = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
        up, shown = [], []
        for start, stop in zip(cuts, [*cuts[1:], len(key)], strict=True):
            if soak.way[start] and stop - start > 1:
                up.append(soak.way[start] > 0)
                shown.append(_over(self.T, soak.T[start:stop], values[start:stop]))
        self.up = np.array(up, dtype=bool)
        self.shown = np.array(shown).reshape(len(up), GRID, *values.shape[1:])

    def openings(self) -> tuple[Array, Array]:
        """Return the opening of each shape (J, d), warming less cooling, and at which temperature it is (J, d)."""
        size, at = _widest(self.shown, self.up)
        return size, self.T[at]

    def both_ways(self) -> NDArray[np.bool_]:
        """Return which shapes (J, d) open almost as far the other way: of a curve that bends, neither is its sign."""
        most, least = (np.where(np.isfinite(one), one, 0.0) for one in _extremes(self.shown, self.up))
        sides = np.stack([np.max(most, axis=0), -np.min(least, axis=0)])
        return np.asarray(np.min(sides, axis=0) > OTHER * np.max(sides, axis=0))

    def opening_of(self, which: Index, coefficients: Array, axis: int) -> tuple[float, Array]:
        """Return the opening of some shapes (q,) together on an axis, and what each coefficient (q,) adds to it."""
        shown = self.shown[:, :, which, axis]
        above, below, g = self.widest(shown @ coefficients)
        gradient = shown[above, g] - shown[below, g]
        return float(gradient @ coefficients), gradient

    def widest(self, together: Array) -> tuple[int, int, int]:
        """Return between which sweeps, up and down, and where on T something shown (W, G) opens most."""
        most, least = _extremes(together, self.up)
        wide = np.where(np.isfinite(most), most, 0.0), np.where(np.isfinite(least), least, 0.0)
        sign = 1 if np.max(wide[0]) >= -np.min(wide[1]) else -1
        g = int(np.argmax(wide[0]) if sign > 0 else np.argmin(wide[1]))
        signed = np.where(np.isnan(together[:, g]), -np.inf, sign * together[:, g])
        above = int(np.argmax(np.where(self.up, signed, -np.inf)))
        signed = np.where(np.isnan(together[:, g]), np.inf, sign * together[:, g])
        return above, int(np.argmin(np.where(self.up, np.inf, signed))), g

    def mean_differences(self) -> Array:
        """Return warming less cooling in the mean over the sweeps (G, J, d); NaN where one of the two is missing."""
        up, down = (_mean(self.shown[self.up == way]) for way in (True, False))
        return up - down


def _over(grid: Array, T: Array, values: Array) -> Array:
    order = np.argsort(T, kind="stable")
    T, flat = T[order], values[order].reshape(len(T), -1)
    place = np.clip(np.searchsorted(T, grid) - 1, 0, len(T) - 2)
    width = T[place + 1] - T[place]
    share = np.clip(np.divide(grid - T[place], width, out=np.zeros_like(grid), where=width > 0), 0.0, 1.0)[:, None]
    found = flat[place] * (1 - share) + flat[place + 1] * share
    found[(grid < T[0]) | (grid > T[-1])] = np.nan
    return np.asarray(found.reshape(len(grid), *values.shape[1:]))


def _extremes(shown: Array, up: Mask) -> tuple[Array, Array]:
    """Return the greatest and the least of a sweep up less a sweep down; infinite where one of the two is missing."""
    low, high = np.where(np.isnan(shown), np.inf, shown), np.where(np.isnan(shown), -np.inf, shown)
    with np.errstate(invalid="ignore"):
        return high[up].max(axis=0) - low[~up].min(axis=0), low[up].min(axis=0) - high[~up].max(axis=0)


def _widest(shown: Array, up: Mask) -> tuple[Array, Array]:
    most, least = _extremes(shown, up)
    wide = np.where(np.abs(most) >= np.abs(least), most, least)
    size = np.where(np.isfinite(wide), np.abs(wide), 0.0)
    at = np.argmax(size, axis=0)
    chosen = np.take_along_axis(np.where(np.isfinite(wide), wide, 0.0), at[None], axis=0)[0]
    return chosen, at


def _mean(shown: Array) -> Array:
    some = ~np.isnan(shown)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(some, shown, 0.0).sum(axis=0) / some.sum(axis=0))
