"""From samples to filter updates: the samples of an update interval are integrated.

A sample stands for the time since the one before it. Over an epoch of samples i::

    tau = sum dt_i,    sensor = sum z_i dt_i / tau    (`Chunk.sensors`);    other channels: their mean

A gap is no sample's time: the epoch's `dt` (since the last epoch) then exceeds `tau` (what was integrated). What the
single readings of a thermometer show of its steps is looked at before they are averaged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, islice

import numpy as np

from fusion_core.chunk import Array, Chunk, Integers, concatenate, locked, made, read_only
from fusion_core.fast import compiled
from fusion_core.thermal.thermometer import READINGS, readings, started

GAP = 1.5  # a step longer than this many usual ones is a gap
TURN = 10  # steps in a row that make another pace
HEAD = 101  # samples that show what a usual step is
EDGE = 1e-4  # of an interval: a stamp this little late still belongs to it (stamps since 1970 are rounded to 0.2 us)


def epochs(chunks: Iterable[Chunk], interval: float) -> Iterator[Chunk]:
    """Yield epochs of `interval` s (or of one sample each, where samples are rarer), as chunks.

    Channels are those of the samples, and `tau` (N,), the time that was integrated, in s. Beside a `temperature` there
    are `temperature_step` and `temperature_variance` (N,), what its samples so far show
    (`fusion_core.thermal.thermometer.readings`).
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
    carry: Chunk | None = None  # the rows of the epoch that is not over
    last, thermometer = -np.inf, started()  # its number, and what the thermometer's samples so far show
    for chunk in chain([first], stream):
        starts = np.empty(len(chunk), dtype=np.int64)
        count, last = _starts(chunk.t, t_0, interval, last, starts)
        starts = starts[:count]
        if count == 0:
            carry = chunk if carry is None else concatenate([carry, chunk])
            continue
        # the epoch begun earlier is put together; all others are integrated where they are, not copied
        begun = [] if carry is None else [carry]
        if starts[0] > 0:
            begun.append(chunk.part(0, starts[0]))
        pieces = [(concatenate(begun), np.zeros(1, dtype=np.int64))] if begun else []
        if count > 1:
            pieces.append((chunk.part(starts[0], starts[-1]), starts[:-1] - starts[0]))
        carry = chunk.part(starts[-1], len(chunk))
        done: list[Chunk] = []
        for rows, begins in pieces:
            part = _integrate(rows, begins, pace, thermometer, done[-1].last() if done else previous)
            if len(part):
                done.append(part)
        if done:
            yield (whole := concatenate(done))
            previous = whole.last()
    if carry is not None:
        part = _integrate(carry, np.zeros(1, dtype=np.int64), pace, thermometer, previous)
        if len(part):
            yield part


# what compiled functions return takes ten times as long to hand over as what they are given to write to


@compiled
def _owned(t: Array, before: float, pace: Array, owned: Array) -> None:
    """Write the steps to times t (N,) without the gaps, which are no one's time; `pace` (usual step, streaks) follows.

    A recording may change its rate: after TURN long (or short) steps in a row, they are the usual ones.
    """
    for k in range(len(t)):
        dt = t[k] - (t[k - 1] if k else before)
        gap, quick = dt > GAP * pace[0], dt < pace[0] / GAP
        pace[1] = pace[1] + 1 if gap else 0
        pace[2] = pace[2] + 1 if quick else 0
        if max(pace[1], pace[2]) >= TURN:
            pace[0], pace[1], pace[2] = dt, 0, 0
            gap = False
        owned[k] = dt if dt > 0 and not gap else 0.0


@compiled
def _starts(t: Array, t_0: float, interval: float, last: float, starts: Integers) -> tuple[int, float]:
    """Write the first row of each epoch that begins here, and return their count and the last one's number.

    `last` is that of before.
    """
    count = 0
    for k in range(len(t)):
        number = np.ceil((t[k] - t_0) / interval - EDGE)
        if number != last:
            starts[count] = k
            count += 1
            last = number
    return count, last


@compiled
def _means(values: Array, weights: Array, starts: Integers, total: Array, means: Array) -> None:
    """Write the weighted means (K, d) of values (N, d) over the K epochs that begin at `starts`."""
    N, d = values.shape
    for k in range(len(starts)):  # of an index without a sign no one asks whether it counts from the end
        first, stop = np.uint64(starts[k]), np.uint64(starts[k + 1] if k + 1 < len(starts) else N)
        for j in range(d):
            sum = 0.0 + values[first, j] * weights[first]
            for i in range(first + np.uint64(1), stop):
                sum += values[i, j] * weights[i]
            means[k, j] = sum / total[k]


def _integrate(rows: Chunk, starts: Integers, pace: Array, thermometer: Array, previous: Chunk | None) -> Chunk:
    N, K = len(rows), len(starts)
    if N == 0:
        return rows
    before = rows.t[0] if rows.previous is None else rows.previous.t[-1]
    dt = np.empty(N)
    _owned(rows.t, before, pace, dt)
    tau, t, last = dt, rows.t, None
    if K < N:
        tau, ends = np.add.reduceat(dt, starts), np.append(starts[1:], N)
        last, t = ends - 1, locked(t[ends - 1])
        by_number = np.ones(N), (ends - starts).astype(np.float64)
    lasting = np.count_nonzero(tau) == K
    by_time = dt, tau if lasting else np.where(tau > 0, tau, 1.0)
    channels = {"tau": tau}
    for name, values in rows.channels.items():
        lasts = name in rows.sensors
        if K == N and not lasts:
            channels[name] = read_only(np.ascontiguousarray(values, dtype=np.float64))
            continue
        weights, total = by_time if lasts else by_number
        means = np.empty((K, *values.shape[1:]))
        _means(np.ascontiguousarray(values).reshape(N, -1), weights, starts, total, means.reshape(K, -1))
        channels[name] = locked(means)
    if "temperature" in rows.channels:
        seen = readings(np.ascontiguousarray(rows["temperature"], dtype=np.float64), thermometer)
        channels |= {name: locked(a if last is None else a[last]) for name, a in zip(READINGS, seen, strict=True)}
    locked(tau)  # only now: of what is locked, compiled functions have a version of its own
    done = made(t, channels, previous, rows.sensors)
    done = done if lasting else done.where(tau > 0)
    if previous is not None or not len(done):
        return done
    # the step to the first epoch is as long as what it integrates
    first = {name: values[:1] for name, values in done.channels.items()}
    return done.following(Chunk(done.t[:1] - done["tau"][:1], first, sensors=done.sensors))
