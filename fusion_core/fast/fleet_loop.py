"""The compiled loop over many units of one model: units are the last axis and the innermost loop.

Several units go through one instruction, and a group's states stay in registers over a few steps: what is left is the
way of z from memory. The compiler does that as long as it sees that no array overlaps another: so the states and the
sums of a slab of units are flat, a row of them SLAB apart, and few arrays take part in the innermost loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.cpython.unsafe.tuple import tuple_setitem
from numpy.typing import NDArray

from fusion_core.chunk import Array

SLAB = 512  # units that one thread has in work at once: their states and sums stay near the processor
BLOCK = 16  # samples of one group before the next one's turn
Size = tuple[float, ...]
Counts = NDArray[np.int64]
Slab = tuple[int, int]

# a product with a sum is rounded once, not twice
compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
inlined = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)


class Sizes(NamedTuple):
    """Numbers that the compiler is to know, as lengths."""

    s: Size  # states of a group
    c: Size  # components of it
    steps: Size  # samples that go through the registers together
    F: Size  # s s
    H: Size  # c s
    K: Size  # steps c s
    root: Size  # steps c
    rows: tuple[int, ...]  # c
    states: tuple[int, ...]  # s
    own: Size  # of length 0 where no unit has drifts of its own: the compiler then leaves them out

    @classmethod
    def of(cls, s: Size, c: Size, steps: int, *, own: bool) -> Sizes:
        """Return the sizes for groups of s states and c components, `own` where units have drifts of their own."""
        F, H, K, root = (
            (0.0,) * size for size in (len(s) ** 2, len(c) * len(s), steps * len(c) * len(s), steps * len(c))
        )
        return cls(s, c, (0.0,) * steps, F, H, K, root, (0,) * len(c), (0,) * len(s), (0.0,) * own)


class Known(NamedTuple):
    """The groups' model and gains; K is N, or 1 for gains that stay."""

    F: Array  # (G, s, s)
    H: Array  # (G, c, s)
    u: Array  # (G, s) drift that all units share
    K: Array  # (K, G, c, s)
    root: Array  # (K, G, c)


class Data(NamedTuple):
    """What was measured of all units, and which rows of it are a group's."""

    z: Array  # (T, m, U)
    own: Array  # (T, n, U) drifts of each unit, or (0, n, U)
    rows: Counts  # (G, c)
    states: Counts  # (G, s)
    gate: float


class Found(NamedTuple):
    """What is written down: states after each `every`-th sample, and the first sample beyond the gate."""

    x: Array  # (T // every, n, U)
    refused: Counts  # (U,)
    every: int


@inlined  # type: ignore[untyped-decorator]
def gains(size: Sizes, g: int, known: Known, row: int) -> tuple[Size, Size]:
    """Return K and root of group g over some steps, which have the gains of `row`."""
    s, c, steps, _, _, K, root, _, _, _ = size
    for a in range(len(steps)):
        at = min(row + a, len(known.K) - 1)
        for i in range(len(c)):
            root = tuple_setitem(root, a * len(c) + i, known.root[at, g, i])
            for j in range(len(s)):
                K = tuple_setitem(K, (a * len(c) + i) * len(s) + j, known.K[at, g, i, j])
    return K, root


@compiled  # type: ignore[untyped-decorator]
def advance(size: Sizes, g: int, known: Known, data: Data, k: int, row: int, slab: Slab, x: Array, nis: Array) -> None:
    """Advance group g by some steps from sample k on, which has the gains of `row`; x and nis, flat, are changed."""
    s, c, steps, F, H, _, _, rows, states, own = size
    u, z = s, data.z
    for i in range(len(s)):
        states = tuple_setitem(states, i, data.states[g, i])
        u = tuple_setitem(u, i, known.u[g, i])
        for j in range(len(s)):
            F = tuple_setitem(F, i * len(s) + j, known.F[g, i, j])
    for i in range(len(c)):
        rows = tuple_setitem(rows, i, data.rows[g, i])
        for j in range(len(s)):
            H = tuple_setitem(H, i * len(s) + j, known.H[g, i, j])
    K, root = gains(size, g, known, row)
    first = np.uint64(slab[0])  # unsigned: no index counts from the end, and units stay neighbours
    for v in range(slab[1] - slab[0]):
        now = s
        for i in range(len(s)):
            now = tuple_setitem(now, i, x[i * SLAB + v])
        for a in range(len(steps)):
            after = s
            for i in range(len(s)):
                total = u[i]
                if len(own) > 0:
                    total += data.own[k + a, states[i], np.uint64(v) + first]
                for j in range(len(s)):
                    total += F[i * len(s) + j] * now[j]
                after = tuple_setitem(after, i, total)
            told = nis[a * SLAB + v]
            for i in range(len(c)):
                y = z[k + a, rows[i], np.uint64(v) + first]
                for j in range(len(s)):
                    y -= H[i * len(s) + j] * after[j]
                white = y * root[a * len(c) + i]
                told += white * white
                for j in range(len(s)):
                    after = tuple_setitem(after, j, after[j] + K[a * len(H) + i * len(s) + j] * y)
            nis[a * SLAB + v] = told
            now = after
        for i in range(len(s)):
            x[i * SLAB + v] = now[i]


@compiled  # type: ignore[untyped-decorator]
def fleet(
    several: Sizes, one: Sizes, known: Known, data: Data, start: int, stop: int, slab: Slab, x: Array,
    found: Found,
) -> None:  # fmt: skip
    """Run the filter of a slab of units, from the first to before the last of it, over samples start to stop.

    x (G, s SLAB) is changed in place; the gains are those from `start` on.
    """
    first, W, every = slab[0], slab[1] - slab[0], found.every
    refused, nis = found.refused[first : slab[1]], np.empty(BLOCK * SLAB)
    k = start
    while k < stop:
        end = min(k + BLOCK, stop, k + every - k % every)
        nis[: (end - k) * SLAB] = 0.0
        for g in range(len(known.F)):
            at = k
            while at + len(several.steps) <= end:
                advance(several, g, known, data, at, at - start, slab, x[g], nis[(at - k) * SLAB :])
                at += len(several.steps)
            while at < end:
                advance(one, g, known, data, at, at - start, slab, x[g], nis[(at - k) * SLAB :])
                at += 1
        for a in range(end - k):
            for v in range(W):
                if not nis[a * SLAB + v] <= data.gate:
                    refused[v] = min(refused[v], k + a)
        if end % every == 0:
            for g in range(len(known.F)):
                for i in range(data.states.shape[1]):
                    found.x[end // every - 1, data.states[g, i]][first : slab[1]] = x[g, i * SLAB : i * SLAB + W]
        k = end
