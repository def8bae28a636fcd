"""From samples to filter updates: the samples of an update interval are integrated.

A sample stands for the time since the one before it. Over an epoch of samples i::

    tau = sum dt_i,    gyro = sum omega_i dt_i / tau,    accel likewise;    other channels: their mean

A gap is no sample's time: the epoch's `dt` (since the last epoch) then exceeds `tau` (what was integrated).
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from fusion_core.chunk import Array, Chunk, concatenate

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

INTEGRATED = ("gyro", "accel")
GAP = 1.5  # a step longer than this many usual ones is a gap
TURN = 10  # steps in a row that make another pace
HEAD = 101  # samples that show what a usual step is
EDGE = 1e-4  # of an interval: a stamp this little late still belongs to it (stamps since 1970 are rounded to 0.2 us)


def epochs(chunks: Iterable[Chunk], interval: float) -> Iterator[Chunk]:
    """Yield epochs of `interval` s (or of one sample each, where samples are rarer), as chunks.

    Channels are those of the samples, and `tau` (N,), the time that was integrated, in s.
    """
    stream = iter(chunks)
    head = list(islice(stream, 1))
    if not head:
        return
    while sum(map(len, head)) < HEAD and (more := next(stream, None)) is not None:
        head.append(more)
    first = concatenate(head)
    t_0 = float(first.t[0])
    pace = np.array([float(np.median(np.diff(first.t[:HEAD]))) if len(first) > 1 else 0.0, 0.0, 0.0])
    previous: Chunk | None = None
    carry: Chunk | None = None
    for chunk in _chain(first, stream):
        rows = chunk if carry is None else concatenate([carry, chunk])
        index = np.ceil((rows.t - t_0) / interval - EDGE)
        whole = int(np.searchsorted(index, index[-1]))
        carry = rows.part(whole, len(rows))
        if whole:
            done = _integrate(rows.part(0, whole), index[:whole], pace, previous)
            if len(done):
                yield done
                previous = done.last()
    if carry is not None:
        done = _integrate(carry, np.zeros(len(carry)), pace, previous)
        if len(done):
            yield done


def _chain(first: Chunk, rest: Iterator[Chunk]) -> Iterator[Chunk]:
    yield first
    yield from rest


@njit(cache=True)  # type: ignore[untyped-decorator]
def _owned(dt: Array, pace: Array) -> Array:
    """Return the steps without the gaps, which are no one's time; `pace` (usual step, streaks) is kept up to date.

    A recording may change its rate: after TURN long (or short) steps in a row, they are the usual ones.
    """
    owned = np.zeros(len(dt))
    for k in range(len(dt)):
        gap, quick = dt[k] > GAP * pace[0], dt[k] < pace[0] / GAP
        pace[1] = pace[1] + 1 if gap else 0
        pace[2] = pace[2] + 1 if quick else 0
        if max(pace[1], pace[2]) >= TURN:
            pace[0], pace[1], pace[2] = dt[k], 0, 0
            gap = False
        if dt[k] > 0 and not gap:
            owned[k] = dt[k]
    return owned


def _integrate(rows: Chunk, index: Array, pace: Array, previous: Chunk | None) -> Chunk:
    before = rows.t[0] if rows.previous is None else rows.previous.t[-1]
    dt = _owned(np.diff(rows.t, prepend=before), pace)
    starts = np.flatnonzero(np.diff(index, prepend=-np.inf))
    tau = np.add.reduceat(dt, starts)
    count = np.diff(starts, append=len(dt))
    lasting = tau > 0
    channels = {"tau": tau[lasting]}
    for name, values in rows.channels.items():
        weights = dt if name in INTEGRATED else np.ones(len(dt))
        total = tau if name in INTEGRATED else count
        column = (slice(None),) + (None,) * (values.ndim - 1)
        sums = np.add.reduceat(values * weights[column], starts, axis=0)
        channels[name] = sums[lasting] / total[lasting][column]
    t = rows.t[starts + count - 1][lasting]
    if previous is None and len(t):
        # the step to the first epoch is as long as what it integrates
        previous = Chunk(t[:1] - channels["tau"][:1], {name: values[:1] for name, values in channels.items()})
    return Chunk(t, channels, previous)
