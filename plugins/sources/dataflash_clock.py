"""Which time stamps of a log cannot be right: a row may pass for whole and still hold damaged bytes.

::

    kept = the longest run of rows, others skipped, along which time does not go back

so the fewest rows are left out that time can be right without. Where more than `FEW` rows in a row would have to go,
nothing is damaged: the clock began anew, and they stay, for who reads them to see. At either end, where nothing
comes after to tell, a few rows that are farther from all others than these last altogether go as well.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion_core.chunk import Array

FEW = 8  # rows in a row: damage is a sector of 512 bytes, which holds so many
LEAST = 60.0  # s: a hole that is shorter is a hole


def plausible(t: Array) -> NDArray[np.bool_]:
    """Return which of the time stamps t (N,) in s, in the order of the file, are not damaged."""
    good = np.ones(len(t), dtype=np.bool_)
    if np.any(np.diff(t) < 0):
        good = _rising(t)
        edges = np.flatnonzero(np.diff(np.concatenate(([True], good, [True]))))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            good[begin:end] = end - begin > FEW
    kept = np.flatnonzero(good)
    good[kept[~_near(t[kept])]] = False
    return good


def _near(t: Array) -> NDArray[np.bool_]:
    """Return which rows are not a few beyond a hole, at either end, that is longer than all the rest."""
    good = np.ones(len(t), dtype=np.bool_)
    for part in (t, -t[::-1]):
        for k in range(1, min(FEW, len(t) - FEW - 1) + 1):  # the first k rows, and the last
            if part[k] - part[k - 1] > max(part[-1] - part[k], LEAST):
                (good if part is t else good[::-1])[:k] = False
    return good


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _rising(t: Array) -> NDArray[np.bool_]:
    """Return which samples of t (N,) are on the longest subsequence that does not fall (patience sorting)."""
    n = len(t)
    tops, before = np.empty(n, np.int64), np.empty(n, np.int64)
    piles = 0
    for k in range(n):
        low, high = 0, piles
        if piles and t[tops[piles - 1]] <= t[k]:  # as almost always
            low = piles
        while low < high:
            middle = (low + high) // 2
            if t[tops[middle]] <= t[k]:
                low = middle + 1
            else:
                high = middle
        tops[low] = k
        before[k] = tops[low - 1] if low else -1
        piles = max(piles, low + 1)
    good = np.zeros(n, np.bool_)
    k = tops[piles - 1] if n else -1
    while k >= 0:
        good[k] = True
        k = before[k]
    return good
