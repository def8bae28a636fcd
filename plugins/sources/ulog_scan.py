"""Whole messages of a ULog file: what is cut or damaged is stepped over and counted.

::

    size (2 bytes, little endian), type (1 byte), size bytes        D: the first two of them are the subscription

A message counts where the one behind it can be one too; else the next place is looked for from which three
messages follow one another. ULog has no checksum: a flipped bit inside the numbers of a row is not seen.

Source: the ULog file format (docs.px4.io, Log File Format).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
from numba import njit
from numpy.typing import NDArray

IDS = 65536  # subscriptions that a file can have
BLOCK = 2 << 20  # bytes read at a time
LONGEST = 3 + 65535  # bytes of a message
AHEAD = 4 * LONGEST  # bytes that must be known behind a message before it is judged
STAMP = 8  # bytes of a time stamp, which every row has
SAMPLED = 1024  # of the rows of a subscription, where only some are wanted, each so many-th is taken

_SHORTEST = np.full(256, -1, np.int64)  # bytes of a message by type; -1: no type that is known
_LONGEST = np.full(256, 65535, np.int64)
for _kind, _size in {"F": 3, "D": 2, "I": 2, "M": 3, "P": 2, "Q": 3, "A": 4, "L": 9, "C": 11, "B": 40}.items():
    _SHORTEST[ord(_kind)] = _size
for _kind, _size in {"R": 2, "S": 8, "O": 2}.items():
    _SHORTEST[ord(_kind)] = _LONGEST[ord(_kind)] = _size
_KEPT = np.zeros(256, np.bool_)  # what a reader needs beside the rows; no text, no synchronisation
for _kind in "FIPQARO":
    _KEPT[ord(_kind)] = True
_LONGEST[[ord(_kind) for _kind in "FIPQAD"]] = 10_000  # what is longer, pyulog takes for damage
_A, _D = ord("A"), ord("D")

NO, WHOLE, CUT, FOREIGN = 0, 1, 2, 3


@dataclass
class Wanted:
    """Which rows to take.

    Attributes
    ----------
    shortest, longest : (65536,) arrays of int
        Bytes of a row by subscription; `shortest` is -1 where the file has none of that number, or none yet: those
        of which `longest` is known are entered where the file names them.
    step : (65536,) array of int
        0 for none, 1 for all, `SAMPLED` for some: the first, second, fourth and so on, and each so many-th.
    """

    shortest: NDArray[np.int64] = field(default_factory=lambda: np.full(IDS, -1, np.int64))
    longest: NDArray[np.int64] = field(default_factory=lambda: np.full(IDS, 65535, np.int64))
    step: NDArray[np.int64] = field(default_factory=lambda: np.full(IDS, SAMPLED, np.int64))


@dataclass
class Counted:
    """What was found.

    Attributes
    ----------
    rows : (65536,) array of int
        Of each subscription, whether taken or not.
    others, text : int
        Definitions, parameters, dropouts and the like that were taken, and their bytes.
    lost : int
        Bytes that belong to no message that is known.
    first_lost : int
        Where in the file the first of them is; -1 where there is none.
    """

    rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(IDS, np.int64))
    others: int = 0
    text: int = 0
    lost: int = 0
    first_lost: int = -1


def messages(file: BinaryIO, start: int, stop: int, wanted: Wanted, counted: Counted) -> Iterator[bytes]:
    """Yield the definitions and the wanted rows between two places of a file, as the file has them."""
    file.seek(start)
    held, at, final = b"", start, False
    while not final:
        more = file.read(min(BLOCK, stop - at - len(held)))
        data = np.frombuffer(held + more, np.uint8)
        final = not more or at + len(data) >= stop
        out = np.empty(len(data), np.uint8)
        done, taken, lost, first, others, text = _scan(
            data, final, wanted.shortest, wanted.longest, wanted.step, counted.rows, out, _SHORTEST, _LONGEST, _KEPT
        )
        counted.lost += lost
        counted.others += others
        counted.text += text
        if first >= 0 and counted.first_lost < 0:
            counted.first_lost = at + first
        yield out[:taken].tobytes()
        held, at = data[done:].tobytes(), at + done


def sampled(rows: int) -> NDArray[np.int64]:
    """Return which of a subscription's rows are taken where some are."""
    n: NDArray[np.int64] = np.arange(rows)
    found: NDArray[np.int64] = n[(n % SAMPLED == 0) | (n < SAMPLED) & (n & (n - 1) == 0)]
    return found


@njit(cache=True, nogil=True)
def _status(data, p, shortest, longest, least, most):  # type: ignore[no-untyped-def]
    """Return what the bytes at p can be: NO message, a WHOLE one, one that the end has CUT, one of a FOREIGN type."""
    if p + 3 > len(data):
        return CUT
    size, kind = data[p] + 256 * data[p + 1], data[p + 2]
    if least[kind] < 0:
        letter = 65 <= kind <= 90 or 97 <= kind <= 122
        return FOREIGN if letter and size > 0 and p + 3 + size <= len(data) else NO
    if size < least[kind] or size > most[kind]:
        return NO
    if kind == _D and p + 5 <= len(data):
        number = data[p + 3] + 256 * data[p + 4]
        if size - 2 < shortest[number] or size - 2 > longest[number]:
            return NO
    return WHOLE if p + 3 + size <= len(data) else CUT


@njit(cache=True, nogil=True)
def _followed(data, p, count, shortest, longest, least, most):  # type: ignore[no-untyped-def]
    """Return whether the message at p is whole, and what follows it can be `count` more."""
    if _status(data, p, shortest, longest, least, most) != WHOLE:
        return False
    for _ in range(count):
        p += 3 + data[p] + 256 * data[p + 1]
        status = _status(data, p, shortest, longest, least, most)
        if status == FOREIGN:  # a type that came later: its size must lead to one that is known
            after = p + 3 + data[p] + 256 * data[p + 1]
            status = _status(data, after, shortest, longest, least, most)
            return status in (WHOLE, CUT)
        if status != WHOLE:
            return status == CUT
    return True


@njit(cache=True, nogil=True)
def _scan(data, final, shortest, longest, step, rows, out, least, most, kept):  # type: ignore[no-untyped-def]
    """Copy what is wanted to `out`; return bytes read, written, lost, where first, and number and bytes of others."""
    p, q, lost, first, end, others, text = 0, 0, 0, -1, len(data), 0, 0
    while p < end and (final or p + AHEAD < end):
        if not _followed(data, p, 1, shortest, longest, least, most):
            if first < 0:
                first = p
            begin = p
            p += 1
            while p < end and (final or p + AHEAD < end):
                if _followed(data, p, 2, shortest, longest, least, most):
                    break
                p += 1
            lost += p - begin
            continue
        size, kind = data[p] + 256 * data[p + 1], data[p + 2]
        take = kept[kind]
        others += take
        text += take * size
        if kind == _A:
            number = data[p + 4] + 256 * data[p + 5]
            if shortest[number] < 0 and longest[number] > 0:
                shortest[number] = STAMP
        if kind == _D:
            number = data[p + 3] + 256 * data[p + 4]
            n, every = rows[number], step[number]
            rows[number] = n + 1
            some = n % every == 0 or (n < every and n & (n - 1) == 0) if every > 1 else every == 1
            take = some and shortest[number] >= 0  # pyulog loses its way in rows of what it does not know yet
        if take:
            out[q : q + 3 + size] = data[p : p + 3 + size]
            q += 3 + size
        p += 3 + size
    return p, q, lost, first, others, text
