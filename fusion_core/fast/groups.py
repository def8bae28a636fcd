"""Groups of states that have nothing to do with one another: six filters of two states are one of twelve, exactly.

Two states are coupled where F, Q, P or a row of H (R made diagonal) has both. What the coupling never reaches stays
zero in every product of the filter, so it is left out. Groups of different size are filled up with states that are
zero and stay so, and with measurements of nothing: all groups then have the same shape, known when the loops are
compiled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array, Flags, Integers
from fusion_core.fast import compiled

Size = tuple[float, ...]
Lanes = tuple[float, ...]  # a number of each of several groups


@dataclass(frozen=True)
class IndependentGroups:
    """Independent groups of s states and c measured components.

    Attributes
    ----------
    states : (G, s) array of int
        States of each group; n where a place is filled up.
    rows : (G, c) array of int
        Measured components of each group; m where a place is filled up.
    n, m : int
        States and components of the model.
    """

    states: Integers
    rows: Integers
    n: int
    m: int

    @cached_property
    def size(self) -> tuple[Size, Size]:
        """Zeros, as many as a group has states, and components: sizes the compiler knows."""
        return (0.0,) * self.states.shape[1], (0.0,) * self.rows.shape[1]

    def side_by_side(self, most: int) -> tuple[Lanes, ...]:
        """Zeros for the states of several groups, as many as divide their number and have at most so many states."""
        G, s = self.states.shape
        widest = max(W for W in range(1, G + 1) if G % W == 0 and s * W <= max(most, s))
        return tuple([(0.0,) * widest] * s)

    @cached_property
    def ordered(self) -> bool:
        """True if the model has state i of every group, then state i + 1, and components so too: lanes as they are."""
        lists = (self.states, self.n), (self.rows, self.m)
        return all(np.array_equal(places.T.ravel(), np.arange(size)) for places, size in lists)

    @cached_property
    def even(self) -> bool:
        """True if all groups have as many states, and as many components: no place is filled up."""
        return self.states.size == self.n and self.rows.size == self.m

    def blocks(self, matrix: Array, rows: Integers, columns: Integers) -> Array:
        """Return the groups' blocks (G, i, j) of a matrix, by their places in its rows (G, i) and columns (G, j)."""
        wide = matrix if self.even else np.pad(matrix, ((0, 1), (0, 1)))
        return wide[rows[:, :, None], columns[:, None, :]]

    def whole(self, blocks: Array) -> Array:
        """Return the matrices (..., n, n) over all states from the blocks (..., G, s, s) of the groups."""
        n = self.n if self.even else self.n + 1
        wide = np.zeros((*blocks.shape[:-3], n, n))
        wide[..., self.states[:, :, None], self.states[:, None, :]] = blocks
        return wide[..., : self.n, : self.n]

    def lanes(self, array: Array, places: Integers) -> Array:
        """Return an array (N, n) or (N, m) as lanes (N, s, G) or (N, c, G); a copy only if need be."""
        if not self.ordered:
            array = np.take(array if self.even else np.pad(array, ((0, 0), (0, 1))), places.T.ravel(), axis=1)
        return array.reshape(len(array), *places.T.shape)

    def from_lanes(self, lanes: Array, places: Integers, size: int) -> Array:
        """Return lanes (N, s, G) or (N, c, G) in the model's order, which has `size` of them."""
        flat = lanes.reshape(len(lanes), -1)
        return flat if self.ordered else np.take(flat, np.argsort(places.T.ravel(), kind="stable")[:size], axis=1)


def find_groups(F: Array, Q: Array, H: Array, P: Array) -> IndependentGroups:
    """Return the groups of a model: F, Q (K, n, n), H (K, m, n) with R diagonal, and P (n, n) at the start."""
    measured = _nonzero(H)
    return _groups((_nonzero(F) | _nonzero(Q) | (P != 0)).tobytes(), measured.tobytes(), measured.shape)


@lru_cache(maxsize=64)  # a recording comes in many stretches, nearly all of them coupled alike
def _groups(coupling: bytes, measuring: bytes, shape: tuple[int, int]) -> IndependentGroups:
    """Return the groups from which states are coupled (n, n), and which components see which (m, n)."""
    n = shape[1]
    measured = np.frombuffer(measuring, dtype=np.bool_).reshape(shape)
    coupled = np.frombuffer(coupling, dtype=np.bool_).reshape(n, n) | (measured.T @ measured)
    coupled = coupled | coupled.T | np.eye(n, dtype=np.bool_)
    for _ in range(n.bit_length()):
        coupled = coupled @ coupled
    first = np.argmax(coupled, axis=1)  # of the states that each one reaches
    leaders = np.unique(first)
    states = [np.flatnonzero(first == leader) for leader in leaders]
    rows = [np.flatnonzero(np.any(measured[:, group], axis=1)) for group in states]
    blind = np.flatnonzero(~np.any(measured, axis=1))  # a component that sees no state is anyone's
    rows[0] = np.sort(np.concatenate([rows[0], blind]))
    return IndependentGroups(_filled(states, n), _filled(rows, len(measured)), n, len(measured))


def _filled(lists: list[Integers], filling: int) -> Integers:
    width = max(len(entry) for entry in lists)
    return np.array([np.pad(entry, (0, width - len(entry)), constant_values=filling) for entry in lists])


def _nonzero(matrices: Array) -> Flags:
    """Return the flags of entries (i, j) that are not zero in all matrices (K, i, j), by their bits less the sign."""
    if len(matrices) == 1:
        return np.asarray(matrices[0] != 0)
    rows, columns = matrices.shape[1:]
    flat = np.ascontiguousarray(matrices).reshape(len(matrices), rows * columns).view(np.uint64)
    return np.asarray((_bits(flat) << np.uint64(1)).reshape(matrices.shape[1:]) != 0)


@compiled
def _bits(rows: NDArray[np.uint64]) -> NDArray[np.uint64]:
    bits = np.zeros(rows.shape[1], dtype=np.uint64)
    for k in range(len(rows)):
        for i in range(len(bits)):
            bits[i] |= rows[k, i]
    return bits
