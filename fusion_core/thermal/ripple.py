"""A ripple of a bias over temperature that is narrower than what a curve can follow.

What the curve leaves is averaged over narrow cells of temperature, of the ways up and of the ways down each. Of three
neighbouring cells, u is how far the middle one is off the mean of the others on the ways up, v on the ways down::

    E(u v) = 1.5 r^2,    r the rms of what repeats from cell to cell

since noise and walk of two ways are independent, and what differs between up and down is smooth. Without a ripple the
sign of u v is as good as tossed, triple by triple, so that z = sum(u v) / sqrt(sum((u v)^2)) exceeds x with a
probability of exp(-x^2 / 2) at most (W. Hoeffding, J. Am. Stat. Assoc. 58 (1963) 13). N samples, d axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array, Integers
from fusion_core.thermal.sweeps import TURN, directions

CHANCE = 1e-3  # probability that noise alone is taken for a ripple, of an axis
HALVINGS = 6  # widths of cells: the widest is half of what the curve is looked at with
TRIPLES = 16  # of cells, at least
GAIN = 1.5  # of E(u v) over r^2
POINTS = 4000  # of the temperature, of which its ways are found


class Ripple(NamedTuple):
    """A ripple of one axis: its rms and the deviation that chance gives to it, in the unit of the bias."""

    rms: float
    chance: float
    T: float  # where it shows most
    width: float  # of the cells that show it


def ripples(T: Array, left: Array, width: float) -> list[Ripple | None]:
    """Return the ripple of each axis in what a curve leaves (N, d) at T (N,), in the order of time; None without one.

    Cells are narrower than `width`; of those that show it, it is as large as the largest. A temperature that goes one
    way shows none.
    """
    step = -(-len(T) // POINTS)
    means = np.add.reduceat(T, np.arange(0, len(T), step)) / np.diff([*range(0, len(T), step), len(T)])
    way = np.repeat(directions(means, TURN * float(np.ptp(T))), step)[: len(T)]
    found: list[Ripple | None] = [None] * left.shape[1]
    least = np.sqrt(2 * np.log(HALVINGS / CHANCE))
    for halving in range(1, HALVINGS + 1):
        cell = width / 2**halving
        products, at = _products(((T - T.min()) / cell).astype(np.int64), way, left)
        if len(products) < TRIPLES:
            continue
        total, scatter = products.sum(axis=0), np.sqrt(np.sum(products**2, axis=0))
        for axis in np.flatnonzero(total > least * scatter):
            rms, chance = np.sqrt(np.array([total[axis], scatter[axis]]) / len(products) / GAIN)
            where = float(T.min()) + (at[int(np.argmax(products[:, axis]))] + 0.5) * cell
            ripple, wider = Ripple(float(rms), float(chance), where, cell), found[axis]
            found[axis] = ripple if wider is None or ripple.rms > wider.rms else wider
    return found


def _products(cell: Integers, way: Integers, left: Array) -> tuple[Array, Integers]:
    """Return u v (M, d) of each three neighbouring cells that both ways have gone through, and the middle ones (M,)."""
    count = 3 * (int(cell.max()) // 3 + 1)
    apart, there = [], np.ones(count // 3, dtype=np.bool_)
    for sign in (1, -1):
        own = way == sign
        n = np.bincount(cell[own], minlength=count)
        there &= np.all(n.reshape(-1, 3) > 0, axis=1)
        sums = np.stack([np.bincount(cell[own], column, count) for column in left[own].T], axis=1)
        low, middle, high = np.moveaxis((sums / np.maximum(n, 1)[:, None]).reshape(-1, 3, left.shape[1]), 1, 0)
        apart.append(middle - (low + high) / 2)
    return (apart[0] * apart[1])[there], 3 * np.flatnonzero(there).astype(np.int64) + 1


def ripple_modes(ripple: Ripple, grid: Array) -> Array:
    """Return two modes (G, 2) on a grid (G,): a wave of the ripple's rms and of any phase, as narrow as the grid."""
    phase = 2 * np.pi * grid / max(3 * ripple.width, 8 * float(grid[1] - grid[0]))
    return np.asarray(ripple.rms * np.stack([np.cos(phase), np.sin(phase)], axis=1))
