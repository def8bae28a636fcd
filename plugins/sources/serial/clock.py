"""Time stamps for the samples of a device, from its own counter or from the host's clock.

A sample has a number x: the device's counter without its wraps, or where there is none, how many came. With N for the
nominal duration of a count::

    device:  t = N x
    host:    t = N x + a + b (N x - N x_now),    a, b by least squares of (host time - N x) over the past

The host sees a sample late and unevenly; the straight line through the past, older arrivals counting less (weight
exp(-2 age / window)), is even, and knows nothing of the future. It is corrected once for each read of the port, and
never runs backwards: a step is at least half its nominal duration. It is late by the mean delay of the arrivals.

The host's clock tells how often the counter has wrapped across a gap. Where the two differ by more than
`TOLERANCE` the counter was set anew, and the host's clock says how long that took.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fusion_core.chunk import Array, Flags, Integers
from fusion_core.contracts.framing import Counter
from fusion_core.errors import seconds
from fusion_core.faults import LOST, RESTARTS, Faults

TOLERANCE = 0.25  # s between the two clocks over one read, and
DRIFT = 0.01  # of the time that has passed: more is no jitter
PULL = 1.0  # s^2: until arrivals are spread by about a second, the declared rate counts
OFF = 0.02  # of the declared rate: more is reported
LONG_ENOUGH = 5.0  # s before the measured rate counts
WINDOW = 2.5  # s over which the rate is measured that the declared one is compared with


class SampleClock:
    """The time of one stream of samples, from its first sample on.

    Parameters
    ----------
    interval : float
        Between samples, as declared, s.
    counter : Counter or None
        The device's.
    kind : {"device", "host"}
        Whose time it is.
    window : float
        Over which the host's clock is averaged, s.
    faults : Faults
        Where lost samples and the like are reported.
    """

    def __init__(
        self, interval: float, counter: Counter | None, kind: Literal["device", "host"], window: float, faults: Faults
    ) -> None:
        self.counter, self.kind, self.tau, self.faults = counter, kind, window / 2, faults
        self.nominal = interval if counter is None or counter.tick is None else counter.tick  # of a count [s]
        self.step = max(1, round(interval / self.nominal))  # counts from one sample to the next
        self.raw = self.x = 0
        self.began = self.at = np.nan  # host time of the first and of the last sample [s]
        self.t = -np.inf
        self.sums = np.array([0.0, 0.0, 0.0, 0.0, 0.0, PULL])  # w, wx, wy, wxx, wxy about the latest; the pull on b
        self.window = (np.nan, 0)  # where the present window of the rate begins: host time [s] and x
        self.off = False  # whether the rate of the window before was not as declared
        self.advice = ""

    @property
    def pace(self) -> float:
        """The measured duration of a count in s, once there is enough to measure it."""
        elapsed = self.at - self.began
        return elapsed / self.x if elapsed >= LONG_ENOUGH and self.x else self.nominal

    def stamp(self, N: int, count: Integers | None, at: float) -> Array:
        """Return the times (N,) in s of the next samples, the last of which had come at the host's time `at`."""
        if N == 0:
            return np.empty(0)
        first = np.isnan(self.at)
        if first:
            self.began = self.at = at - (N - 1) * self.step * self.nominal
            self.window = self.began, 0
        steps = self._by_count(count, at, first) if count is not None else self._by_number(N, at, first)
        x = self.x + np.cumsum(steps)
        before, self.x, self.at = self.x, int(x[-1]), at
        self._judge()
        t = x * self.nominal if self.kind == "device" else self._line(x, before, at)
        self.t = float(t[-1])
        return np.asarray(t, dtype=np.float64)

    def _by_number(self, N: int, at: float, first: bool) -> Integers:
        """Return the steps between samples that have no counter: a pause is as long as the host's clock says."""
        steps = np.ones(N, dtype=np.int64)
        steps[0] = 0 if first else 1
        missing = (at - self.at) / self.pace - N
        if not first and missing * self.pace > max(TOLERANCE, 2 * self.nominal):
            steps[0] += int(missing)
        return steps

    def _by_count(self, count: Integers, at: float, first: bool) -> Integers:
        """Return the steps of the counter, without its wraps."""
        assert self.counter is not None
        modulo = self.counter.modulo
        steps = np.diff(count, prepend=count[0] if first else self.raw) % modulo
        self.raw = int(count[-1])
        elapsed = at - self.at
        if not first:
            wraps = round((elapsed / self.pace - int(np.sum(steps))) / modulo)
            steps[0] += max(0, wraps) * modulo
        away = np.sum(steps) * self.pace - elapsed
        stuck = steps <= 0
        stuck[0] &= not first
        burst = away > 0 and np.max(steps) < 2 * self.step  # of samples that had waited: none is missing
        if (abs(away) > TOLERANCE + DRIFT * elapsed and not burst) or np.any(stuck):
            return self._restarted(steps, elapsed, stuck)
        lost = int(np.sum(np.maximum(np.rint(steps[int(first) :] / self.step) - 1, 0)))
        self._report(LOST, lost)
        return steps

    def _restarted(self, steps: Integers, elapsed: float, stuck: Flags) -> Integers:
        k = int(np.argmax(np.where(stuck, np.inf, np.abs(steps - self.step))))
        steps = np.where(stuck, self.step, steps)
        others = int(np.sum(steps) - steps[k])
        steps[k] = max(self.step, round(elapsed / self.pace) - others)
        self._report(RESTARTS, 1)
        return steps

    def _judge(self) -> None:
        """Say that the rate is not as declared while two windows in a row show it: a backlog at the start passes."""
        since, x = self.window
        if self.at - since < WINDOW or self.x == x:
            return
        pace, before = (self.at - since) / (self.x - x), self.off
        self.window, self.off = (self.at, self.x), abs(pace / self.nominal - 1) > OFF
        if not (before and self.off):
            self.faults.found.pop(self.advice, None)
            self.advice = ""
        elif not self.advice:
            measured = f"{self.step * pace * 1e3:.4g} ms and not {self.step * self.nominal * 1e3:.4g} ms"
            self.advice = (
                f"rate not as declared: samples are {measured} apart by the host's clock; correct source.interval"
            )
            self.faults.add(self.advice, 1, f"at {seconds(self.t)}")

    def _line(self, x: Integers, before: int, at: float) -> Array:
        """Return the host's time (N,) of samples x (N,), on the line through what has arrived."""
        w, wx, wy, wxx, wxy, pull = self.sums
        moved = (self.x - before) * self.nominal
        wxx += moved * (moved * w - 2 * wx)
        wxy -= moved * wy
        wx -= moved * w
        keep = np.exp(-moved / self.tau)
        y = (at - self.began) - self.x * self.nominal
        w, wx, wy, wxx, wxy, pull = keep * w + 1, keep * wx, keep * wy + y, keep * wxx, keep * wxy, keep * pull
        self.sums = np.array([w, wx, wy, wxx, wxy, pull])
        b = (wxy - wx * wy / w) / (wxx - wx * wx / w + pull)
        a = (wy - b * wx) / w
        nominal = x * self.nominal
        t = nominal + a + b * (nominal - nominal[-1])
        floor = self.t + 0.5 * (nominal - before * self.nominal) if np.isfinite(self.t) else t
        return np.asarray(np.maximum.accumulate(np.maximum(t, floor) - 0.5 * nominal) + 0.5 * nominal)

    def _report(self, what: str, count: int) -> None:
        self.faults.add(what, count, "at the start" if not np.isfinite(self.t) else f"after {seconds(self.t)}")
