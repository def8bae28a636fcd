"""Records of a log as arrays, and its streams on one time base.

A log keeps each sensor under its own time stamps, a filter wants rows.

::

    a stream about as fast as the rows, or faster:   the sample that is nearest in time   (its noise stays what it is)
    a slower one (a thermometer):                    a straight line between its samples

Where no sample is near enough a row has NaN, so that it is left out and counted like any other that lacks a value.
"""

from __future__ import annotations

import mmap
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.errors import UnreadableFile

SLOWER = 2.0  # times the rows' interval: from there on a stream is drawn through, not picked from
NEAR = 1.5  # intervals of the slower of the two: farther away is no sample of that row
HOLE = 10.0  # intervals of a slow stream without a sample: no line is drawn across


ROWS, FEW = 1 << 16, 100  # places read at once, and for which no memory is given back
PATH = re.compile(r"(\w+?)(?:\[(\d+)\])?\.(.+)")


class FieldPath(NamedTuple):
    """A path `NAME.FIELD`, or `NAME[2].FIELD` of one of several sensors, taken apart."""

    name: str
    number: int | None
    field: str


def taken_apart(path: str) -> FieldPath | None:
    """Return the parts of a path, None where it is none."""
    match = PATH.fullmatch(path)
    return None if match is None else FieldPath(match[1], None if match[2] is None else int(match[2]), match[3])


def mapped(path: Path) -> NDArray[np.uint8]:
    """Return the bytes of a log, read when they are asked for; raises UnreadableFile where they cannot be mapped."""
    try:
        return np.asarray(np.memmap(path, np.uint8, "r"))
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); free memory, or copy it again") from None


def release(data: NDArray[np.uint8] | bytes) -> None:
    """Let the system have the memory back in which it holds what was read of a mapped file; it reads it again."""
    base: Any = data
    while base is not None and not isinstance(base, mmap.mmap):
        base = getattr(base, "base", None)
    if base is not None and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def joined(t: Array, sampled: Array, values: Array, step: float | None = None) -> Array:
    """Return the values of a stream at the times of other rows.

    Parameters
    ----------
    t : (N,) array
        Times of the rows, s, rising.
    sampled : (M,) array
        Times of the stream's samples, s, rising.
    values : (M,) or (M, d) array
        The samples.
    step : float, optional
        The rows' interval, s, where these are a few of many; that of `t` by default.

    Returns
    -------
    (N,) or (N, d) array
        NaN where the stream has no sample near enough.
    """
    result = np.full((len(t), *values.shape[1:]), np.nan)
    if len(sampled) == 0 or len(t) == 0:
        return result
    step, spacing = interval(t) if step is None else step, interval(sampled)
    after = np.clip(np.searchsorted(sampled, t), 1, max(len(sampled) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(sampled) - 1)
    nearest = np.where(t - sampled[before] <= sampled[after] - t, before, after)
    near = np.abs(sampled[nearest] - t) <= NEAR * max(step, spacing)
    if not spacing > SLOWER * step or len(sampled) == 1:
        result[near] = values[nearest[near]]
        return result
    width = sampled[after] - sampled[before]
    share = np.clip((t - sampled[before]) / np.where(width > 0, width, 1.0), 0.0, 1.0)  # the end's value beyond it
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    good = np.where((t < sampled[0]) | (t > sampled[-1]), near, (width <= HOLE * spacing) | near)
    result[good] = ((1 - share) * values[before] + share * values[after])[good]
    return result


def interval(t: Array) -> float:
    """Return the usual time between samples, s; 0 where there is one."""
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0


def records(data: NDArray[np.uint8] | bytes, at: NDArray[np.int64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the values (N,), of arrays (N, k), that begin at places `at` (N,) of the bytes.

    What of a mapped file is held in memory for it is given back, piece by piece: a log is larger than what it takes.
    """
    size = dtype.itemsize
    # every place in the data where one could begin, without a copy
    windows = np.ndarray((max(len(data) - size + 1, 0),), f"V{size}", data, strides=(1,))
    values = np.empty(len(at), windows.dtype)
    for start in range(0, len(at), ROWS):
        values[start : start + ROWS] = windows[at[start : start + ROWS]]
        if len(at) > FEW:
            release(data)
    return values.view(dtype.base).reshape(len(at), *dtype.shape)
