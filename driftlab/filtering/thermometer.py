"""Error of the thermometer: in the temperature that the map sees, and in a bias that follows it.

Of steps q and noise before them, a mean reading has a sawtooth over temperature and the rest is white
(`fusion_core.thermal.thermometer`). The smoothing of the temperature, over w s, passes of both::

    sawtooth: |H|^2 of each harmonic,  H(s) = (1 + s w) / (1 + s w / 2)^2,  one period in the time p of a step
    white:    1.25 dt / (w / 2)                                             Brown's double smoothing

A temperature whose rate changes is followed late: what readings are off the smoothed temperature, over another w / 2,
beyond a quarter of the sawtooth and 0.15 of the white part (3 / 16 of their density over w / 2) is a lag, and its
square a part of the white variance.

Each is an error e of variance v that is forgotten by rho a step: as the temperature goes through the steps, and as
the window moves on. A sawtooth turns with the temperature: its rho is complex, its angle 2 pi a step. Readings stand
while the temperature goes on, as quickly as through the last step; where the next one is late it may stand as well.
The error moves a bias that follows the map of slope b' by y = b' e, and the filter, of gain g, takes
out what lasts: y - l with l = l + g (y - l). So its part of the estimate's variance is bounded::

    c = Cov(l, e) / sqrt(v):    c = (1 - g) rho c + g b' sqrt(v),    of which the real part counts
    h = Var(l):                 h = (1 - g)^2 h + 2 g (1 - g) rho c b' sqrt(v) + g^2 b'^2 v
    Var(y - l) = b'^2 v - 2 b' sqrt(v) c + h

A prediction is the same with g = 0 from its departure on. N epochs, d axes.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array, Chunk, Integers, extremes
from fusion_core.fast import compiled
from fusion_core.thermal.thermometer import READINGS, Steps, noise_before, readings, sawtooth, started

HARMONICS = 5
LEFT = 1.4  # rho = exp(-1.4 x + 2 pi i x) of a sawtooth x of a step further on: -1/2 at a half, as its own is
OFF = 0.25, 0.15  # of the variances of sawtooth and white part: what readings are off the smoothed temperature by them
LATE = 0.5  # rho = exp(-0.5 x) where no next step is seen, x the time over that without one: it may stand, or go on
QUICK = 0.01  # K/s: without a step so far, it may go as quickly
NOTHING = 1e-12  # K^2
SAME = 1e-3  # of a step
TURN = 2 * np.pi


class ReadingError(NamedTuple):
    """Variances (N, 2) of sawtooth and white part of the error in K^2, and what is left of the epoch before (N, 3).

    That is of the sawtooth, of the white part, and the imaginary part of the sawtooth's.
    """

    variance: Array
    left: Array


class ThermometerError:
    """Estimate of a thermometer's error from its own readings, epoch by epoch.

    Parameters
    ----------
    known : Steps
        What is known beforehand: of the soak that the map was fitted on.
    window : float
        Over which the temperature is averaged before the map sees it, s.
    """

    def __init__(self, known: Steps, window: float) -> None:
        self.known, self.window = known, window
        self.rows = started()  # of the epochs' means, where the samples are not known
        # what comes before: two readings, how many there were, their variance, the temperature at which the last step
        # ended, the time since, what that step took, and what readings were off the smoothed temperature
        self.memory = np.array([np.nan, np.nan, 0.0, 0.0, np.nan, 0.0, 0.0, 0.0])

    def snapshot(self) -> tuple[Array, Array]:
        """Return the state so far."""
        return self.rows.copy(), self.memory.copy()

    def restore(self, snapshot: tuple[Array, Array]) -> None:
        """Go on from a snapshot."""
        self.rows, self.memory = copied(snapshot, self.snapshot())

    def look(self, chunk: Chunk) -> ReadingError:
        """Return the error of the temperature over N epochs."""
        T, windows = chunk["temperature"], chunk.channels.get("temperature_window")
        raw = chunk.channels.get("temperature_raw", T)
        known = READINGS[0] in chunk.channels
        step, variance = [chunk[name] for name in READINGS] if known else readings(raw, self.rows)
        steps = np.maximum(step, self.known.size)
        table, which = self._sawteeth(steps, variance)
        error = ReadingError(np.empty((len(T), 2)), np.empty((len(T), 3)))
        windows = np.full(T.shape, self.window) if windows is None else windows
        _look(T, raw, chunk.each_dt, steps, table, which, windows, self.memory, *error)
        return error

    def _sawteeth(self, steps: Array, variance: Array) -> tuple[Array, Integers]:
        """Return the sawteeth (M, HARMONICS) that steps (N,) and the readings' variance (N,) make, and which (N,)."""
        # a quarter of an octave is near enough; the least and the largest mostly say it of all
        (finest, coarsest), (least, most) = extremes(steps), extremes(variance)
        if coarsest == 0:
            return np.zeros((1, HARMONICS)), np.zeros(len(steps), dtype=np.int64)
        quarters = float(np.rint(4 * np.log2(max(least, NOTHING))))
        if finest == coarsest and (least == most or quarters == np.rint(4 * np.log2(max(most, NOTHING)))):
            return _sawtooth(finest, quarters, self.known)[None], np.zeros(len(steps), dtype=np.int64)
        rounded = np.rint(4 * np.log2(np.maximum(variance, NOTHING)))
        new = np.concatenate([[True], (steps[1:] != steps[:-1]) | (rounded[1:] != rounded[:-1])])
        table = [_sawtooth(float(steps[k]), float(rounded[k]), self.known) for k in np.flatnonzero(new)]
        return np.stack(table), np.cumsum(new) - 1


def copied(snapshot: tuple[Array, ...], own: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return copies of a snapshot's arrays; raises ValueError where they are not laid out as one's own."""
    if [values.shape for values in snapshot] != [values.shape for values in own]:
        raise ValueError("a memory is laid out otherwise")
    return tuple(values.copy() for values in snapshot)


@lru_cache(maxsize=1000)
def _sawtooth(step: float, variance: float, known: Steps) -> Array:
    """Return the harmonics of steps of readings whose variance has the logarithm `variance`, in quarters to base 2."""
    # a soak has seen all temperatures between two levels: at one of them readings flicker more, or less
    from_soak = known.noise > 0 and abs(step / known.size - 1) < SAME
    return sawtooth(step, known.noise if from_soak else noise_before(step, 2 ** (variance / 4)), HARMONICS)


@compiled
def _look(
    T: Array, raw: Array, dt: Array, steps: Array, table: Array, which: Integers, windows: Array, memory: Array,
    variance: Array, left: Array,
) -> None:  # fmt: skip
    one, two, count, noise, ended, since, took, off = memory
    period, passed, at, window, usual, white, forgotten = 0.0, 0.0, -1, -1.0, -1.0, 0.0, 0.0  # what was worked out last
    known, standing, rest, aside, whole = 0.0, True, 1.0, 0.0, 0.0
    for k in range(len(T)):
        if count == 0:
            ended = T[k]
        if count >= 2:
            noise += ((raw[k] - 2 * one + two) ** 2 / 6 - noise) / min(count - 1, 6000.0)
        one, two, count = raw[k], one, count + 1
        q, since, moved = steps[k], since + dt[k], 0.0
        if q > 0:
            if abs(T[k] - ended) >= q:
                took, since, ended = since * q / abs(T[k] - ended), 0.0, T[k]
            moved = dt[k] / max(since, q / QUICK if took == 0 else took, dt[k])
        late = since > took
        if windows[k] != window or dt[k] != usual:
            at, window, usual = -1, windows[k], dt[k]
            white, forgotten = min(1.0, 2.5 * usual / max(window, usual)), np.exp(-2 * usual / max(window, 0.1 * usual))
        # a temperature that has not crossed a step yet may stand still: nothing is averaged away
        crossed = max(since, took) if took > 0 else np.inf
        if which[k] != at or crossed != period:
            at, period, passed, whole = which[k], crossed, 0.0, 0.0
            for h in range(HARMONICS):
                x = (np.pi * (h + 1) * window / period) ** 2
                passed, whole = passed + table[at, h] * (1 + 4 * x) / (1 + x) ** 2, whole + table[at, h]
        if moved != known or late != standing:
            known, standing, rest, aside = moved, late, np.exp(-LATE * moved), 0.0
            if not late:
                kept = np.exp(-LEFT * moved)
                rest, aside = kept * np.cos(TURN * moved), kept * np.sin(TURN * moved)
        variance[k, 0], left[k, 0], left[k, 2] = passed, rest, aside
        off = forgotten * off + (1 - forgotten) * (raw[k] - T[k])
        lag = max(off * off - OFF[0] * whole - OFF[1] * noise * white, 0.0)
        variance[k, 1], left[k, 1] = noise * white + lag, forgotten
    for place, value in enumerate((one, two, count, noise, ended, since, took, off)):
        memory[place] = value
