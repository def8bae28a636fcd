"""Compiled loops with gains that are known before the data: the groups are lanes, side by side.

Arrays over states are (N, s, G) here, and over components (N, c, G): state i of every group, then state i + 1. A model
whose triads stand one after the other is in that order as it is. The numbers s, c and G come as lengths of tuples, for
the compiler to put several groups into one instruction: half the time of groups that are gathered by lists of places.
"""

from __future__ import annotations

from typing import NamedTuple

from numba import njit
from numba.cpython.unsafe.tuple import tuple_setitem

from fusion_core.chunk import Array

Size = tuple[float, ...]


class Sizes(NamedTuple):
    """How many states and components a group has, and how many groups there are, as lengths."""

    s: Size
    c: Size
    G: Size


class Known(NamedTuple):
    """The groups' model, and the gains of their kinds; K is N, or 1 for those that stay."""

    F: Array  # (G, s, s)
    H: Array  # (G, c, s)
    kind: tuple[int, ...]  # (G,) values, which no store into an array can change
    K: Array  # (K, D, c, s)
    root: Array  # (K, D, c)


class Lanes(NamedTuple):
    """What is written down for each sample."""

    x: Array  # (N, s, G)
    y: Array  # (N, c, G)
    white: Array  # (N, c, G)
    nis: Array  # (N,)


# tuples in place of small arrays: what a group's step needs then stays in registers, 19 ns a step and not 27
@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def steady(size: Sizes, x: Array, known: Known, u: Array, z: Array, out: Lanes) -> None:
    """Run the filter over N samples: x (s, G) is changed in place; u (N or 1, s, G), z (N, c, G)."""
    s, c, G = size
    F, H, kind, K, root = known
    for k in range(len(z)):
        k_u, k_K = min(k, len(u) - 1), min(k, len(K) - 1)
        nis = 0.0
        for g in range(len(G)):
            before = s
            for i in range(len(s)):
                total = u[k_u, i, g]
                for j in range(len(s)):
                    total += F[g, i, j] * x[j, g]
                before = tuple_setitem(before, i, total)
            after = before
            for i in range(len(c)):
                innovation = y = z[k, i, g]
                for j in range(len(s)):
                    innovation -= H[g, i, j] * before[j]
                    y -= H[g, i, j] * after[j]
                white = y * root[k_K, kind[g], i]
                out.y[k, i, g], out.white[k, i, g] = innovation, white
                nis += white * white
                for j in range(len(s)):
                    after = tuple_setitem(after, j, after[j] + K[k_K, kind[g], i, j] * y)
            for i in range(len(s)):
                x[i, g] = after[i]
                out.x[k, i, g] = after[i]
        out.nis[k] = nis
