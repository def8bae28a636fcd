"""Where the records of a DataFlash log are: one pass over its bytes, which finds its way back after damage.

::

    record:  A3 95 type  body        FMT (type 128, 89 bytes): type, length, name[4], format[16], labels[64]

A record counts where the next one begins at its end, or the file ends there: bytes that look like a header within
other data do not pass. One that is followed by something else may have lost its tail, and is in doubt
(`dataflash_doubt`). Behind a gap the search goes on byte by byte.
Where a type's length is not that of its fields, both are tried; a record that is shorter than its fields is not given.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion_core.budget import COUNT, Clock

PIECE = 1 << 26  # bytes between two looks at the clock
Into = tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]
State = tuple[int, int, int, int, int, int]
Bytes = NDArray[np.uint8]
Places = NDArray[np.int64]

SIZES = {"a": 64, "b": 1, "B": 1, "h": 2, "H": 2, "i": 4, "I": 4, "f": 4, "d": 8, "n": 4, "N": 16, "Z": 64, "c": 2,
         "C": 2, "e": 4, "E": 4, "L": 4, "M": 1, "q": 8, "Q": 8, "g": 2}  # fmt: skip
"""Bytes of a field by the letter of its format."""

HEAD, SECOND, FMT, FMT_LENGTH = 0xA3, 0x95, 128, 89
_LETTERS = np.zeros(256, dtype=np.int64)
for _letter, _size in SIZES.items():
    _LETTERS[ord(_letter)] = _size


class Scan(NamedTuple):
    """What a pass over a log has found.

    Attributes
    ----------
    at : (N,) array of int
        Where the records that were asked for begin, in the order of the file.
    types : (N,) array of uint8
        Their types.
    counts : (256,) array of int
        Records of each type.
    doubtful, doubtful_types : (D,) arrays
        Where records begin that nothing known follows, of any type, and their types; they are not in `at`.
    lost, first_lost : int
        Bytes before `end` that are no record, and where the first of them is; -1 where there is none.
    end : int
        Where the last record ends.
    """

    at: Places
    types: Bytes
    counts: Places
    doubtful: Places
    doubtful_types: Bytes
    lost: int
    first_lost: int
    end: int


def scan(data: Bytes, wanted: tuple[int, ...], most: int, clock: Clock) -> Scan:
    """Return where the records of the wanted types are, at most `most` of them; raises UnreadableFile out of time."""
    asked = np.zeros(256, dtype=np.bool_)
    asked[list(wanted)] = True
    at, types, counts = np.empty(most, np.int64), np.empty(most, np.uint8), np.zeros(256, np.int64)
    doubtful = np.empty(min(len(data) // 64, COUNT) + 1024, np.int64)
    lengths, state = np.zeros((3, 256), np.int64), (0, 0, 0, 0, -1, 0)
    lengths[:2, FMT], lengths[2] = FMT_LENGTH, _LETTERS
    while state[0] + 3 <= len(data):
        rows, stop = counts.sum(), state[0] + PIECE
        state = _walk(data, stop, asked, lengths, (at, types, counts, doubtful), state)
        clock.check(int(counts.sum() - rows))
    _, found, doubts, lost, first_lost, end = state
    doubtful = doubtful[:doubts].copy()
    return Scan(at[:found], types[:found], counts, doubtful, data[doubtful + 2], lost, first_lost, end)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _walk(data: Bytes, stop: int, asked: NDArray[np.bool_], lengths: Places, into: Into, state: State) -> State:
    """Fill `at`, `types` (M,), `counts` (256,), `doubtful` as far as `stop`; return how far it came.

    `lengths` (3, 256) are declared, as the letters of the formats add up, and of each letter; the state is where it
    goes on, how many were found, are in doubt, the bytes lost, the first of them, and the end of the last record.
    """
    n, (pos, found, doubts, lost, first_lost, end) = len(data), state
    at, types, counts, doubtful = into
    length, fields, letters = lengths
    while pos + 3 <= n and pos < stop:
        kind, step = data[pos + 2], 0
        if data[pos] == HEAD and data[pos + 1] == SECOND:
            longer, shorter = max(length[kind], fields[kind]), min(length[kind], fields[kind])
            if _follows(data, pos + longer, longer):
                step = longer
            elif _follows(data, pos + shorter, shorter):
                step = shorter
            elif kind != FMT and 3 < fields[kind] <= n - pos and doubts < len(doubtful):
                doubtful[doubts] = pos
                doubts += 1
        if step and kind == FMT:
            size = _format_size(data, pos, letters)
            if size == 0:
                step = 0
            else:
                length[data[pos + 3]], fields[data[pos + 3]] = max(3, data[pos + 4]), size
        if step == 0:
            pos += 1
            continue
        if pos > end:
            first_lost = end if lost == 0 else first_lost
            lost += pos - end
        if step >= fields[kind]:
            if asked[kind] and found < len(at):
                at[found], types[found] = pos, kind
                found += 1
            counts[kind] += 1
        pos += step
        end = pos
    return pos, found, doubts, lost, first_lost, end


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _follows(data: Bytes, end: int, length: int) -> bool:
    """Whether a record of `length` that ends at `end` is whole: the file ends there, or the next one begins."""
    n = len(data)
    if length < 3 or end > n:
        return False
    return (end == n or data[end] == HEAD) and (end + 1 >= n or data[end + 1] == SECOND)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _format_size(data: Bytes, pos: int, letters: Places) -> int:
    """Return the length of the records that an FMT at `pos` describes, by its letters; 0 where it is damaged.

    By what it declares, where a letter is none that is known.
    """
    for k in range(4):
        c = data[pos + 5 + k]
        if (k == 0 and c < 48) or c > 126:
            return 0
    size = 3
    for k in range(16):
        c = data[pos + 9 + k]
        if c == 0:
            break
        if c < 48 or c > 126:
            return 0
        if letters[c] == 0:
            return int(data[pos + 4])
        size += letters[c]
    return size


def field(data: Bytes, at: Places, offset: int, dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    """Return a field (N,) or (N, k) of the records that begin at `at` (N,), `offset` bytes after their beginning."""
    out = np.empty((len(at), dtype.itemsize), dtype=np.uint8)
    _gather(data, at, offset, out)
    values = out.view(dtype.base)
    return values[:, 0] if values.shape[1] == 1 else values


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _gather(data: Bytes, at: Places, offset: int, out: Bytes) -> None:
    for k in range(len(at)):
        begin = at[k] + offset
        for j in range(out.shape[1]):
            out[k, j] = data[begin + j]
