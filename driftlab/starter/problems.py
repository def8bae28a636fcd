"""Problems of a recording, found in its first rows before a config of it is vouched for.

A gyro at rest, averaged over 1 s, is still to some hundredths of a degree a second, whatever its noise in a sample: a
hand, a vehicle or a turntable is not. So rest is detected without the noise, for which motion would be taken.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from driftlab.config import Config
from driftlab.starter.reading import ROWS
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import Source
from fusion_core.errors import EmptyRecording
from fusion_core.faults import Faults, advice_backwards

LOST = 0.05  # of the rows, without a number: more is reported
WINDOW = 10  # s in which a unit has to be at rest once
DAY = 86_400.0  # s
MOVING = np.deg2rad(0.3)  # rad/s, deviation of means over 1 s: more is no unit at rest


def problems_of(config: Config) -> Iterator[str]:
    """Yield problems of a map of the first rows of a config's recording, a sentence each.

    Raises
    ------
    DataError
        If it cannot be read.
    """
    source, model = config.source, config.filter
    assert source is not None
    assert model is not None
    samples = _first(source)
    if "temperature" not in samples.channels:
        yield (
            "no column is known as a temperature, and a map is fitted over one: name it, as in "
            "--column temperature=NAME, or go on with `driftlab allan`"
        )
    for name in dict.fromkeys((model.tracked.channel, "temperature", *(s.channel for s in model.sensors))):
        if name in samples.channels:
            yield from _of_values(name, samples[name].reshape(len(samples), -1))
    t = samples.t[np.isfinite(samples.t)]
    lasts = float(np.ptp(t)) if len(t) else 0.0
    steps = np.diff(t)
    if len(steps) and (back := float(np.min(steps))) < 0:
        k = int(np.argmin(steps))
        at = float(t[k] - t[0])
        yield (
            f"time runs backwards by {-back:.6g} s, {at:.6g} s after the first row: {advice_backwards(steps, k)}, or "
            f"read a part, as in --input FILE::0:{np.floor(at * 1e3) / 1e3:.3f}"
        )
    if len(steps) and getattr(source, "dates", None) and (jump := float(np.max(steps))) > DAY / 2:
        yield f"the date jumps by {jump / DAY:.3g} days: day and month may be the other way round, say it with --dates"
    if len(samples) < ROWS and not lasts > model.align:
        yield f"it lasts {lasts:.3g} s, and {model.align:g} s at rest are needed to begin with: record a whole soak"
    if "gyro" in samples.channels and (least := _stillest(samples.t, samples["gyro"])) > MOVING:
        yield (
            f"the gyro is never at rest: its means over 1 s vary by {np.rad2deg(least):.2g} deg/s at the least; "
            "correct its unit, or record a unit that does not move"
        )


def _first(source: Source) -> Chunk:
    """Return the first rows."""
    parts: list[Chunk] = []
    for chunk in source.chunks(ROWS, Faults()):
        parts.append(chunk)
        if sum(map(len, parts)) >= ROWS:
            break
    if not parts:
        raise EmptyRecording(f"{source.name}: has no rows; record anew")
    return concatenate(parts)


def _of_values(name: str, values: Array) -> Iterator[str]:
    finite = np.all(np.isfinite(values), axis=1)
    if (lost := 1 - float(np.mean(finite))) > LOST:
        yield f"{name}: {lost:.0%} of the first {len(values):,} rows have no number, and are left out"
    elif len(values) < ROWS and np.any(np.ptp(values[finite], axis=0) == 0):
        yield f"{name} does not change: it shows {', '.join(f'{v:.6g}' for v in values[finite][0])} in every row"


def _stillest(t: Array, values: Array) -> float:
    """Return the least deviation of means over 1 s within windows; 0 where there are too few."""
    good = np.all(np.isfinite(values), axis=1) & np.isfinite(t)
    seconds = np.floor(t[good] - t[good][:1]).astype(np.int64)
    _, first = np.unique(seconds, return_index=True)
    if len(first) < WINDOW:
        return 0.0
    means = np.add.reduceat(values[good], first) / np.diff([*first, len(seconds)])[:, None]
    windows = means[: len(means) // WINDOW * WINDOW].reshape(-1, WINDOW, values.shape[1])
    return float(np.min(np.max(np.std(windows, axis=1), axis=1)))
