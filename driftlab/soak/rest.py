"""Stretches at rest of a recording: temperature, and the tracked sensor's readings less their known input.

Each stretch is aligned anew, which takes an Earth rate off a gyro. Where only the length of the input is known, as
that of gravity in the axes of a unit that lies somehow, the direction is that of the first stretch of a placement:
aligned anew, a bias that has moved meanwhile would be taken for tilt. N epochs, d axes.

A window with motion is cut about it, by the epochs: what is before and after is at rest. What is refused is counted.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from driftlab.config import Config
from driftlab.filtering.segment import runs
from driftlab.filtering.setup import (
    OFF,
    TURNED,
    check_channels,
    corrected,
    noise_doubts,
    noise_remarks,
    other_calibrations,
)
from driftlab.recordings.plausibility import HELD, SINGLE
from driftlab.units import axis_name
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import Alignment, FittedMap, MeasurementModel, Sensor
from fusion_core.faults import Faults
from fusion_core.thermal.rate_estimators import with_rate

NOTED = 0.05  # of a soak, not used: more is the first line
SHORTEST = 10.0  # s of rest about a motion, at least
BEFORE = 30.0  # s before a window that show the level, at most
LATELY = 600.0  # s over which a rate of the temperature is forgotten
FAR = 2.0  # K: over more, a stretch may bend as no one curve of it does
LOUD, ENOUGH = 3.0, 20  # times the usual noise, over so many epochs at least: more than temperature makes
TOUCHED = 5.0  # deviations of the difference of two means, across motion: more is another placement


class RestStretch(NamedTuple):
    """A stretch at rest: last time, temperature (N,), reading less input (N, d), input (d,) or (N, d), placement.

    `window` are its epochs, with all that was recorded.
    """

    t: float
    T: Array
    bias: Array
    known: Array | float
    placement: int
    window: Chunk


@dataclass
class Used:
    """Count of the epochs of soaks that were at rest and used, and of those taken for motion.

    `low`, `high` are the temperatures of all epochs, degC, which lasted `seconds`, at most `most` of them in a window;
    `axes` are those that showed the motion, by epochs.
    """

    epochs: int = 0
    moving: int = 0
    seconds: float = 0.0
    most: int = 0
    first: str = ""
    low: float = np.inf
    high: float = -np.inf
    axes: Counter[str] = field(default_factory=Counter)
    rows: int = 0  # of the recordings
    usable: int = 0  # of these
    why: str = ""  # the others were left out

    @property
    def moved(self) -> float:
        """The share of the epochs that was taken for motion."""
        return self.moving / max(self.epochs + self.moving, 1)

    @property
    def unread(self) -> float:
        """The share of the rows that was left out before."""
        return 1 - self.usable / self.rows if self.rows else 0.0

    @property
    def share(self) -> float:
        """The share of the soak that is not used."""
        return 1 - (1 - self.moved) * (1 - self.unread)

    def sentence(self) -> str:
        """Return the share that is not used and why, where that is much; empty where it is not."""
        if self.share <= NOTED:
            return ""
        why = []
        if self.moved >= 0.005:
            by = ", ".join(name for name, count in self.axes.most_common() if 2 * count >= max(self.axes.values()))
            why.append(f"{self.moved:.0%} was taken for motion (first {self.first}{by and f', seen by {by}'})")
        if self.unread >= 0.005:
            why.append(f"{self.unread:.0%} of the rows were left out{self.why and f' ({self.why})'}")
        return f"{self.share:.0%} of the soak is not used: {'; '.join(why)}"

    def as_json(self) -> dict[str, float | int]:
        """Return the shares."""
        return {"share": self.share, "motion": self.moved, "rows_left_out": self.unread}

    def read(self, faults: Faults, before: Faults) -> None:
        """Take the rows of a recording, and why some were left out, beside the faults before it."""
        self.rows, self.usable = self.rows + faults.rows - before.rows, self.usable + faults.usable - before.usable
        left_out = [(f.count, what, f) for what, f in faults.found.items() if "rows" in what and "left out" in what]
        if left_out:
            _, what, fault = max(left_out)
            self.why = f"{what.replace(', left out', '')}, first {fault.first}"

    def note(self, window: Chunk) -> None:
        """Take the epochs of a window, whether they are used or not."""
        T = window["temperature"]
        self.low, self.high = min(self.low, float(T.min())), max(self.high, float(T.max()))
        self.seconds, self.most = self.seconds + float(np.sum(window["tau"])), max(self.most, len(window))


def at_rest(config: Config, stream: Iterable[Chunk], faults: Faults, used: Used | None = None) -> Iterator[RestStretch]:
    """Yield each stretch of epochs at rest; placements are counted from 0, and `used` counts the epochs."""
    model, used = config.filter, used or Used()
    if model is None:
        for window in _windows(stream, 60.0):
            used.epochs += len(window)
            yield RestStretch(float(window.t[-1]), window["temperature"], window["gyro"], 0.0, 0, window)
        return
    channel = model.tracked.channel
    noise: list[tuple[float, int, Array]] = []  # temperature, epochs, measured over declared noise of each stretch
    others = other_calibrations(model)
    placing = _Placing(model) if model.length_of_input(config.site) else None
    cutting = _Cutting(config, model, others, used)
    moved = False
    for window in _windows(stream, model.align):
        if not noise:  # a recording has the same channels from its beginning to its end
            check_channels(model, window)
        used.note(window)
        refused = len(window)
        for part in cutting.parts(window):
            refused -= len(part)
            model.check(part, config.site)
            alignment = model.aligned(corrected(part, others), config.site)
            for text in () if noise else alignment.off:
                faults.note(text)
            noise.append((float(np.mean(part["temperature"])), len(part), alignment.noise_ratio[channel]))
            if placing is not None:
                alignment = placing.of(part, alignment, moved=moved or part.t[0] > window.t[0])
            moved = False
            known, number = model.known(part, alignment), 0 if placing is None else placing.number
            used.epochs += len(part)
            yield RestStretch(float(part.t[-1]), part["temperature"], part[channel] - known, known, number, part)
        if refused:
            moved = True
            used.moving += refused
            used.first = used.first or f"at {faults.when(window.t[0])}"
            faults.add("epochs in stretches with motion, left out", refused, f"at {faults.when(window.t[0])}")
    if noise:
        T, count, ratios = (np.array(column) for column in zip(*noise, strict=True))
        _judge_noise(model.tracked, T, count, ratios, faults)


def _judge_noise(sensor: Sensor, T: Array, epochs: Array, ratios: Array, faults: Faults) -> None:
    """Note the noise of a sensor where it is not as declared, or not the same at all temperatures.

    Of K stretches: temperature T (K,) in degC, number of epochs (K,), measured over declared noise (K, d).
    """
    whole = np.sqrt(epochs @ ratios**2 / np.sum(epochs))
    for line in noise_remarks(sensor, whole, OFF):
        faults.note(line)
    for line in noise_doubts(sensor, whole):
        faults.doubt(line)
    usual = np.median(ratios, axis=0)
    over = np.max(np.divide(ratios, usual, out=np.zeros_like(ratios), where=usual > 0), axis=1)
    loud = (over > LOUD) & (epochs >= ENOUGH)
    # noise is then what comes when a hold ends, or of those readings
    of_readings = any((HELD in text or SINGLE in text) and text.startswith(sensor.channel) for text in faults.doubts)
    if np.sum(epochs[loud]) >= NOTED * np.sum(epochs) and not of_readings:
        faults.doubt(
            f"{sensor.channel}: noise is {np.median(over[loud]):.2g} times the usual between {np.min(T[loud]):.3g} and "
            f"{np.max(T[loud]):.3g} °C ({np.sum(epochs[loud]) / np.sum(epochs):.0%} of the rest), as of vibration, "
            "which moves the bias too; find what shakes the unit there, or leave that part out with PATH::START:STOP"
        )


class _Cutting:
    """Cuts motion out of windows, by the epochs at which the sensors leave the level of the last rest."""

    def __init__(self, config: Config, model: MeasurementModel, others: dict[str, FittedMap], used: Used) -> None:
        self.site, self.model, self.others, self.used = config.site, model, others, used
        self.still = False
        self._before: Chunk | None = None  # the last stretch at rest
        self._lately: deque[Chunk] = deque(maxlen=max(2, round(LATELY / model.align)))

    def parts(self, window: Chunk) -> list[Chunk]:
        """Return the parts of a window that are at rest."""
        # too few epochs to judge (the last ones) are as the window before
        if len(window) > 2:
            self._lately.append(window)
            self.still = self.model.still(window)
            if not self.still:
                return self._cut(window)
            self._before = window
        return [window] if self.still else []

    def _rated(self) -> tuple[Chunk, float]:
        """Return the last windows with the rate of their temperature in K/s, and the largest rate.

        A thermometer of coarse steps does not show the rate all the time, and a bias may go on behind.
        """
        lately = concatenate(self._lately)
        rate = with_rate(lately, self.model.temperature_rate, None)[0].channels.get("temperature_rate")
        if rate is None:
            return lately, 0.0
        return lately.having(temperature_rate=rate), float(np.max(np.abs(rate)))

    def _cut(self, window: Chunk) -> list[Chunk]:
        lately, rate = self._rated()
        start = len(lately) - len(window)
        fastest = lately if rate == 0 else lately.having(temperature_rate=np.full(len(lately), rate))
        if rate > 0 and self.model.still(fastest.part(start, len(lately))):
            self._before, self.still = window, True
            return [window]
        alignment = self.model.aligned(corrected(self._before or window, self.others), self.site)
        detector = self.model.detector(alignment)
        first = start if self._before is None else int(np.searchsorted(lately.t, self._before.t[-1] - BEFORE))
        still, out, _ = detector.look(lately.part(first, len(lately)), detector.start())
        still, out = still[start - first :], out[start - first :]
        for (channel, axis), count in zip(detector.axes, np.sum(out, axis=0), strict=True):
            if count:
                self.used.axes[axis_name(channel, axis)] += int(count)
        parts = [
            window.part(a - start, b - start)
            for c, d in runs(still)
            for a, b in self._at_rest(fastest, start + c, start + d, rate)
        ]
        if parts:
            self._before, self.still = parts[-1], bool(parts[-1].t[-1] == window.t[-1])
        return parts

    def _at_rest(self, epochs: Chunk, start: int, stop: int, rate: float) -> list[tuple[int, int]]:
        """Return the rest in epochs of which none stands out: in halves, where the temperature moves far."""
        length = float(np.sum(epochs["tau"][start:stop]))
        if stop - start < 3 or length < SHORTEST:
            return []
        if self.model.still(epochs.part(start, stop)):
            return [(start, stop)]
        if rate * length < FAR:
            return []
        middle = (start + stop) // 2
        return [*self._at_rest(epochs, start, middle, rate), *self._at_rest(epochs, middle, stop, rate)]


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
