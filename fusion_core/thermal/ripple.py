"""A ripple of a bias over temperature that is narrower than what a curve can follow.

What the curve leaves is averaged over narrow cells of temperature, of each pass up or down by itself: between two
passes a bias walks. Of three neighbouring cells, u is how far the middle one is off the mean of the others on the ways
up, in the mean of those that went through all three, v on the ways down::

    E(u v) = 1.5 r^2,    r the rms of what repeats from cell to cell

since noise and walk of two ways are independent, and what differs between up and down is smooth. Without a ripple the
sign of u v is as good as tossed, triple by triple, so that z = sum(u v) / sqrt(sum((u v)^2)) exceeds x with a
probability of exp(-x^2 / 2) at most (W. Hoeffding, J. Am. Stat. Assoc. 58 (1963) 13). A dip at one temperature is one
product of many: it is seen where u and v are both, and to the same side, beyond NARROW of their robust deviations,
where these grow with the white noise of neighbouring samples at that temperature. N samples, d axes.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    louder = _louder(T, left, width)
    least = np.sqrt(2 * np.log(HALVINGS / CHANCE))
    cells = _cells_of(((T - T.min()) / (width / 2**HALVINGS)).astype(np.int64), way, left)
    for halving in range(1, HALVINGS + 1):
        cell = width / 2**halving
        ways, noise, at = _ways_apart(cells, HALVINGS - halving)
        where, third = float(T.min()) + (at + 0.5) * cell, at % 3 == 1  # of cells that no other three have
        beside = louder[np.minimum(((where - T.min()) / width).astype(np.int64), len(louder) - 1)]
        inner = (where > T.min() + width) & (where < T.max() - width)  # about a turn, both ways are of one moment
        products = ways[0, third] * ways[1, third]
        if len(products) < TRIPLES:
            continue
        total, scatter = products.sum(axis=0), np.linalg.norm(products, axis=0)
        for axis, dip in enumerate(_dips(ways[:, inner], noise[:, inner], beside[inner], where[inner], cell)):
            seen = None
            if total[axis] > least * scatter[axis]:
                rms, chance = np.sqrt(np.array([total[axis], scatter[axis]]) / len(products) / GAIN)
                most = float(where[third][int(np.argmax(products[:, axis]))])
                seen = Ripple(float(rms), float(chance), most, cell)
            # what repeats from cell to cell is everywhere, and a dip is not
            found[axis] = max((one for one in (found[axis], dip, seen) if one is not None), default=None,
                              key=lambda one: (not one.dip, one.rms))  # fmt: skip
    return found


class _Cells(NamedTuple):
    """Sums of the K cells that passes of one way go through, in order of the passes, then of the temperature."""

    run: Integers  # (K,): number of the pass
    at: Integers  # (K,): number of the cell
    n: Array  # (K,): samples
    sums: Array  # (K, d)


def _cells_of(cell: Integers, way: Integers, left: Array) -> tuple[_Cells, _Cells]:
    """Return the cells of the ways up and of the ways down, of samples in `cell` (N,)."""
    count, run = int(cell.max()) + 1, np.cumsum(np.diff(way, prepend=way[:1]) != 0)
    both = []
    for sign in (1, -1):
        own = way == sign
        key, of = np.unique(run[own] * count + cell[own], return_inverse=True)
        sums: Array = np.stack([np.bincount(of, column, len(key)) for column in left[own].T], axis=1)
        both.append(_Cells(key // count, key % count, np.bincount(of, minlength=len(key)).astype(np.float64), sums))
    return both[0], both[1]


def _ways_apart(cells: Sequence[_Cells], shift: int) -> tuple[Array, Array, Integers]:
    """Return u and v (2, M, d) of each three neighbouring cells that both ways have gone through.

    And their deviations (2, M) for white noise of 1 a sample, and the middle cells (M,). 2^`shift` cells are one.
    """
    count = max(int(one.at.max(initial=0) >> shift) for one in cells) + 1
    apart, noise, there = [], [], np.ones(count, dtype=np.bool_)
    for run, at, n, sums in cells:
        at = at >> shift
        first = np.flatnonzero((np.diff(at, prepend=-1) != 0) | (np.diff(run, prepend=-1) != 0))
        run, at, n = run[first], at[first], np.add.reduceat(n, first)
        means = np.add.reduceat(sums, first) / n[:, None]
        k = np.flatnonzero((run[2:] == run[:-2]) & (at[2:] - at[:-2] == 2)) + 1
        weight = 1 / (1 / n[k] + (1 / n[k - 1] + 1 / n[k + 1]) / 4)
        total = np.bincount(at[k], weight, count)
        there &= total > 0
        total = np.where(total > 0, total, 1.0)
        off = weight[:, None] * (means[k] - (means[k - 1] + means[k + 1]) / 2)
        apart.append(np.stack([np.bincount(at[k], column, count) / total for column in off.T], axis=1))
        noise.append(1 / np.sqrt(total))
    return np.stack(apart)[:, there], np.stack(noise)[:, there], np.flatnonzero(there).astype(np.int64)


def _louder(T: Array, left: Array, width: float) -> Array:
    """Return the white noise (B, d) of neighbouring samples in each `width` of temperature, in its median or more."""
    at, squares = ((T[1:] - T.min()) / width).astype(np.int64), np.diff(left, axis=0) ** 2
    sums, n = np.stack([np.bincount(at, column) for column in squares.T]), np.maximum(np.bincount(at), 1)
    usual = np.maximum(np.median(sums / n, axis=1), np.finfo(float).tiny)
    return np.sqrt(np.maximum((sums / n).T / usual, 1.0))


def _dips(ways: Array, noise: Array, louder: Array, where: Array, cell: float) -> list[Ripple | None]:
    """Return the dip that u and v (2, M, d) of each axis show at temperatures (M,); None where there is none.

    Their noise is `louder` (M, d) than elsewhere.
    """
    found: list[Ripple | None] = [None] * ways.shape[2]
    if len(where) < TRIPLES:
        return found
    passed = np.all(np.abs(np.log(noise / np.median(noise))) < np.log(HELD), axis=0)
    if np.sum(passed) < TRIPLES:
        return found
    ways, noise, where = ways[:, passed], noise[:, passed], where[passed]
    # white noise falls with the time in a cell, a walk grows
    noise = np.maximum(noise, np.median(noise) ** 2 / noise)[:, :, None] * louder[passed]
    z = np.abs(ways) / noise
    usual = 1.4826 * np.median(z, axis=1)
    beyond = np.min(z / np.maximum(usual, np.finfo(float).tiny)[:, None], axis=0) * (ways[0] * ways[1] > 0)
    for axis, k in enumerate(np.argmax(beyond, axis=0)):
        if beyond[k, axis] > NARROW:
            chance = float(np.sqrt(np.mean((usual[:, axis] * noise[:, k, axis]) ** 2) / 2))
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
