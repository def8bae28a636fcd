"""The stretches at rest of a recording: temperature, and what the tracked sensor shows beside its known input.

Each stretch is aligned anew, which takes an Earth rate off a gyro. Where only the length of the input is known, as
that of gravity in the axes of a unit that lies somehow, the direction is that of the first stretch of a placement:
aligned anew, a bias that has moved meanwhile would be taken for tilt. N epochs, d axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from driftlab.config import Config
from driftlab.filtering.needs import check_channels, corrected, other_calibrations
from driftlab.filtering.plan import TURNED
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import Alignment, MeasurementModel
from fusion_core.faults import Faults

TOUCHED = 5.0  # deviations of the difference of two means, across motion: more is another placement


class Rest(NamedTuple):
    """A stretch at rest: last time, temperature (N,), reading less input (N, d), input (d,) or (N, d), placement.

    `window` are its epochs, with all that was recorded.
    """

    t: float
    T: Array
    bias: Array
    known: Array | float
    placement: int
    window: Chunk


def at_rest(config: Config, stream: Iterable[Chunk], faults: Faults) -> Iterator[Rest]:
    """Yield each stretch of epochs at rest; placements are counted from 0."""
    model = config.filter
    if model is None:
        for window in _windows(stream, 60.0):
            yield Rest(float(window.t[-1]), window["temperature"], window["gyro"], 0.0, 0, window)
        return
    channel = model.tracked.channel
    others = other_calibrations(model)
    placing = _Placing(model) if model.length_of_input(config.site) else None
    still, moved = False, False
    for window in _windows(stream, model.align):
        check_channels(model, window)
        # too few epochs to judge (the last ones) are as the window before
        still = _still(window, model, faults) if len(window) > 2 else still
        if not still:
            moved = True
            continue
        model.check(window, config.site)
        alignment = model.aligned(corrected(window, others), config.site)
        if placing is not None:
            alignment = placing.of(window, alignment, moved=moved)
        moved = False
        known = model.known(window, alignment)
        number = 0 if placing is None else placing.number
        yield Rest(float(window.t[-1]), window["temperature"], window[channel] - known, known, number, window)


class _Placing:
    """Tells the placements of a unit apart, and keeps the alignment of the present one."""

    def __init__(self, model: MeasurementModel) -> None:
        self.model, self.number = model, -1
        self._before: tuple[float, Array, float] | None = None  # last time, mean and length of the last stretch
        self._alignment: Alignment | None = None

    def of(self, window: Chunk, alignment: Alignment, *, moved: bool) -> Alignment:
        """Return the alignment of the placement that a stretch belongs to; `alignment` is its own."""
        sensor = self.model.tracked
        mean, tau = np.mean(window[sensor.channel], axis=0), float(np.sum(window["tau"]))
        if self._alignment is None or self._elsewhere(window, mean, tau, alignment, moved=moved):
            self.number, self._alignment = self.number + 1, alignment
        self._before = float(window.t[-1]), mean, tau
        return self._alignment

    def _elsewhere(self, window: Chunk, mean: Array, tau: float, alignment: Alignment, *, moved: bool) -> bool:
        assert self._before is not None, "there was a stretch before"
        t, before, length = self._before
        if moved or window.t[0] - t > self.model.align:
            sensor = self.model.tracked
            noise = sensor.noise * np.maximum(alignment.noise_ratio[sensor.channel], 1.0)
            return bool(np.any(np.abs(mean - before) > TOUCHED * noise * np.sqrt(1 / tau + 1 / length)))
        return float(np.linalg.norm(mean - before)) > TURNED * float(np.linalg.norm(mean))


def _still(window: Chunk, model: MeasurementModel, faults: Faults) -> bool:
    still = model.still(window)
    if not still:
        faults.add("epochs in stretches with motion, left out", len(window), f"at {faults.when(window.t[0])}")
    return still


def _windows(stream: Iterable[Chunk], length: float) -> Iterable[Chunk]:
    """Yield consecutive windows of `length` s of epochs, whatever the chunks are."""
    waiting: Chunk | None = None
    t_0: float | None = None
    for chunk in stream:
        waiting = chunk if waiting is None else concatenate([waiting, chunk])
        t_0 = float(waiting.t[0]) if t_0 is None else t_0
        index = np.floor((waiting.t - t_0) / length + 1e-9)
        cuts = [0, *(np.flatnonzero(np.diff(index)) + 1)]
        for start, stop in pairwise(cuts):
            yield waiting.part(int(start), int(stop))
        waiting = waiting.part(int(cuts[-1]), len(waiting))
    if waiting is not None:
        yield waiting
