"""A ripple of a bias over temperature that is narrower than what a curve can follow.

What the curve leaves is averaged over narrow cells of temperature, of each pass up or down by itself: between two
passes a bias walks. Of three neighbouring cells, u is how far the middle one is off the mean of the others on the ways
up, in the mean of those that went through all three, v on the ways down::

    E(u v) = 1.5 r^2,    r the rms of what repeats from cell to cell

since noise and walk of two ways are independent, and what differs between up and down is smooth. Without a ripple the
sign of u v is as good as tossed, triple by triple, so that z = sum(u v) / sqrt(sum((u v)^2)) exceeds x with a
probability of exp(-x^2 / 2) at most (W. Hoeffding, J. Am. Stat. Assoc. 58 (1963) 13). A dip at one temperature is one
product of many: it is seen where u and v are both, and to the same side, beyond NARROW of their robust deviations.
N samples, d axes.
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
NARROW = 5.0  # deviations of u and of v: more is a dip
HELD = 2.0  # times the usual deviation of white noise, or its inverse: at a temperature that is held, a bias walks
POINTS = 4000  # of the temperature, of which its ways are found


class Ripple(NamedTuple):
    """A ripple of one axis: its rms and the deviation that chance gives to it, in the unit of the bias.

    Of a `dip`, which is at one temperature, its depth below the cells beside it.
    """

    rms: float
    chance: float
    T: float  # where it shows most
    width: float  # of the cells that show it
    dip: bool = False


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
        ways, noise, at = _ways_apart(((T - T.min()) / cell).astype(np.int64), way, left)
        where, third = float(T.min()) + (at + 0.5) * cell, at % 3 == 1  # of cells that no other three have
        inner = (where > T.min() + width) & (where < T.max() - width)  # about a turn, both ways are of one moment
        products = ways[0, third] * ways[1, third]
        if len(products) < TRIPLES:
            continue
        total, scatter = products.sum(axis=0), np.sqrt(np.sum(products**2, axis=0))
        for axis, dip in enumerate(_dips(ways[:, inner], noise[:, inner], where[inner], cell)):
            seen = None
            if total[axis] > least * scatter[axis]:
                rms, chance = np.sqrt(np.array([total[axis], scatter[axis]]) / len(products) / GAIN)
                most = float(where[third][int(np.argmax(products[:, axis]))])
                seen = Ripple(float(rms), float(chance), most, cell)
            # what repeats from cell to cell is everywhere, and a dip is not
            found[axis] = max((one for one in (found[axis], dip, seen) if one is not None), default=None,
                              key=lambda one: (not one.dip, one.rms))  # fmt: skip
    return found


def _ways_apart(cell: Integers, way: Integers, left: Array) -> tuple[Array, Array, Integers]:
    """Return u and v (2, M, d) of each three neighbouring cells that both ways have gone through.

    And their deviations (2, M) for white noise of 1 a sample, and the middle cells (M,).
    """
    count = int(cell.max()) + 1
    run = np.cumsum(np.diff(way, prepend=way[:1]) != 0)
    apart, noise, there = [], [], np.ones(max(count - 2, 0), dtype=np.bool_)
    for sign in (1, -1):
        own = way == sign
        _, passes = np.unique(run[own], return_inverse=True)
        place, shape = passes * count + cell[own], (int(passes.max(initial=-1)) + 1, count)
        n = np.bincount(place, minlength=shape[0] * count).reshape(shape).astype(np.float64)
        with np.errstate(divide="ignore"):
            weight = 1 / (1 / n[:, 1:-1] + (1 / n[:, :-2] + 1 / n[:, 2:]) / 4)  # none where one of the three is empty
        total = weight.sum(axis=0)
        there &= total > 0
        u = []
        for column in left[own].T:
            means = np.bincount(place, column, shape[0] * count).reshape(shape) / np.maximum(n, 1)
            u.append(np.sum(weight * (means[:, 1:-1] - (means[:, :-2] + means[:, 2:]) / 2), axis=0))
        total = np.where(total > 0, total, 1.0)
        apart.append(np.stack(u, axis=1) / total[:, None])
        noise.append(1 / np.sqrt(total))
    return np.stack(apart)[:, there], np.stack(noise)[:, there], np.flatnonzero(there).astype(np.int64) + 1


def _dips(ways: Array, noise: Array, where: Array, cell: float) -> list[Ripple | None]:
    """Return the dip that u and v (2, M, d) of each axis show at temperatures (M,); None where there is none."""
    found: list[Ripple | None] = [None] * ways.shape[2]
    if len(where) < TRIPLES:
        return found
    passed = np.all(np.abs(np.log(noise / np.median(noise))) < np.log(HELD), axis=0)
    if np.sum(passed) < TRIPLES:
        return found
    ways, noise, where = ways[:, passed], noise[:, passed], where[passed]
    noise = np.maximum(noise, np.median(noise) ** 2 / noise)  # white noise falls with the time in a cell, a walk grows
    z = np.abs(ways) / noise[:, :, None]
    usual = 1.4826 * np.median(z, axis=1)
    beyond = np.min(z / np.maximum(usual, np.finfo(float).tiny)[:, None], axis=0) * (ways[0] * ways[1] > 0)
    for axis, k in enumerate(np.argmax(beyond, axis=0)):
        if beyond[k, axis] > NARROW:
            chance = float(np.sqrt(np.mean((usual[:, axis] * noise[:, k]) ** 2) / 2))
            found[axis] = Ripple(abs(float(np.mean(ways[:, k, axis]))), chance, float(where[k]), cell, dip=True)
    return found


def ripple_modes(ripple: Ripple, grid: Array) -> Array:
    """Return two modes (G, 2) on a grid (G,): a wave of the ripple's rms and of any phase, as narrow as the grid.

    Of a dip one (G, 1), where it is.
    """
    if ripple.dip:
        wide = max(ripple.width, float(grid[1] - grid[0]))
        return np.asarray(ripple.rms * np.exp(-(((grid - ripple.T) / wide) ** 2) / 2)[:, None])
    phase = 2 * np.pi * grid / max(3 * ripple.width, 8 * float(grid[1] - grid[0]))
    return np.asarray(ripple.rms * np.stack([np.cos(phase), np.sin(phase)], axis=1))
