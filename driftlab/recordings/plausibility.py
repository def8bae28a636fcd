"""Readings that no sensor gives: an axis that copies another, or stays at the end of its range; thermometers that fail.

And those of a sensor that rounds to steps beside which its noise is small.

What is found is noted as a doubt (`Faults.doubt`): the rows stay, and no limit passes on them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from driftlab.units import axis_name
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Sensor
from fusion_core.faults import RANGES, Faults, all_within
from fusion_core.thermal.thermometer import noise_before

LIVELY = 100  # changes of a reading that show its habit
STUCK = 100  # times its longest repetition before: a thermometer that repeats a reading for longer is stuck
LASTING = 60.0  # s that it stands, at least
ENOUGH = 1000  # rows that are looked at together: a live source has one at a time
ALONE = "rows whose temperature stands alone between others"
JUMP, USUAL = 1.0, 10.0  # K, and times the usual step: more from row to row is a jump
ABOUT, FEW = 16, 7  # rows before and behind a reading, in which fewer changes are as large: of it, and of two more
MEDIAN = 0.6745  # of the sizes of normal numbers of variance 1
FASTEST = 1.0  # K/s: no body of a sensor warms faster
MOVED = 5.0  # K over which that is looked at
AT_END, STEEP = 0.005, 10.0  # of the rows at an end of the range, and times the rows next to it: at least
BLOCK, BLOCKS = 100, 50  # rows, and how many of them are looked at in a chunk: of steps
HELD = "is held by what writes it down"  # in the doubt about it
SINGLE = "single readings far off both neighbours"  # likewise
SEVERAL, OFTEN = 10, 1e-3  # of them, and of the rows, are a doubt: who moves a unit knocks it now and then
ENDS, CHANCE, SHARE = 10, 1e-6, 0.01  # ends of repetitions, chance of a longer one, share of the rows: of readings held
MANY, SOME = 20, 10  # chunks, after which one in SOME is looked at: of steps
EXACT = 0.01  # of a step: so far changes may be from multiples of it
MINUTE = 60.0  # s; a mean over it is to be off by no more than its noise
KELVIN = 200.0  # degC: in kelvin a soak is warmer than that throughout
SOAKS = (-100.0, 450.0)  # degC: colder and hotter no sensor is soaked
ZERO = RANGES["temperature"][0]  # degC; colder rows are left out


class Copies:
    """Axes of a sensor that have shown the very same values so far."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        self._same: dict[str, dict[tuple[int, int], int]] = {}  # pairs of axes, and how often both have changed

    def look(self, chunk: Chunk, name: str, sensor: Sensor | None) -> None:
        """Look at the next rows of a sensor (N, d)."""
        values = chunk[name]
        if name not in self._same:
            self._same[name] = dict.fromkeys(combinations(range(values.shape[1]), 2), 0)
        same = self._same[name]
        for i, j in list(same):
            if not np.array_equal(values[:100, i], values[:100, j]) or not np.array_equal(values[:, i], values[:, j]):
                del same[i, j]
                continue
            before, same[i, j] = same[i, j], same[i, j] + int(np.count_nonzero(np.diff(values[:, i])))
            if before < LIVELY <= same[i, j]:
                axes = axes_in(sensor, values.shape[1])
                one, other = (axis_name(name, axes[k]) for k in (i, j))
                self.faults.doubt(f"{other} shows what {one} shows, row by row; correct source.channels.{name}.path")


class Rails:
    """Count of the largest and the smallest readings of each axis: at the end of its range it shows the very same.

    `table` (2, d, 4) is largest reading, its count, the next one, its count, of the readings and with their sign
    reversed.
    """

    def __init__(self, name: str, sensor: Sensor | None, d: int) -> None:
        self.name, self.sensor = name, sensor
        self.table = np.tile([-np.inf, 0.0, -np.inf, 0.0], (2, d, 1))

    def judge(self, faults: Faults) -> None:
        """Note a doubt about each axis that was at an end of its range, where none is declared."""
        sensor, (high, low) = self.sensor, self.table
        if sensor is not None and sensor.range:
            return
        for which, side, sign in (("largest", high, 1), ("smallest", low, -1)):
            for axis, (value, count, _, below) in zip(axes_in(sensor, len(side)), side, strict=True):
                if count >= AT_END * faults.rows and count >= LIVELY and count > STEEP * below:
                    unit, section = ("in SI", "filter.gyro") if sensor is None else (sensor.unit, sensor.section)
                    lost = "as where zero stands for lost samples; name their flag as channel `valid`"
                    why = f"as at the end of its range; set {section}.range" if value != 0 else lost
                    faults.doubt(
                        f"{axis_name(self.name, axis)} shows exactly {sign * value:.6g} {unit}, its "
                        f"{which} reading, in {count:.0f} rows: {why}"
                    )


class Rounding:
    """Steps that the axes of a sensor round to, beside its noise before them.

    The mean of many readings is off by a sine of the value, of an amplitude of q / pi exp(-2 pi^2 s^2 / q^2) for steps
    q and noise s (Widrow and Kollar): nothing where the noise is half a step, a tenth of the noise at a third.
    """

    def __init__(self, name: str, sensor: Sensor | None, d: int) -> None:
        self.name, self.sensor = name, sensor
        self.step = np.full(d, np.inf)  # of which all changes are multiples; 0: of none
        self.chunks = 0  # so far
        self.holds = Holds(name, sensor, d)
        self.squares: list[Array] = []  # (B, d): mean squares of the changes in each block
        self.dt: list[float] = []

    def look(self, chunk: Chunk) -> None:
        """Look at blocks of the next rows."""
        if len(chunk) < BLOCK:
            return
        self.chunks += 1
        if self.chunks > MANY and self.chunks % SOME:
            return
        starts = np.unique(np.linspace(0, len(chunk) - BLOCK, min(BLOCKS, len(chunk) // BLOCK)).astype(np.intp))
        rows = starts[:, None] + np.arange(BLOCK)
        changes = np.abs(np.diff(chunk[self.name][rows], axis=1))
        self.holds.look(changes)
        if self.sensor is None or not np.any(self.step):
            return
        self.squares.append(np.mean(changes**2, axis=1))
        self.dt.append(float(np.median(np.diff(chunk.t[rows], axis=1))))
        step = np.minimum(self.step, np.min(changes, axis=(0, 1), where=changes > 0, initial=np.inf))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # where there are no steps
            times = np.vstack([changes.reshape(-1, len(step)), np.where(np.isfinite(self.step), self.step, 0.0)]) / step
            odd = np.max(np.abs(times - np.rint(times)), axis=0, where=np.isfinite(times), initial=0.0)
        self.step = np.where(odd < EXACT, step, 0.0)

    def judge(self, faults: Faults) -> None:
        """Note a doubt about each axis whose means are off by more than the noise of a minute, or that is held."""
        self.holds.judge(faults)
        if self.sensor is None or not self.squares:
            return
        each = np.concatenate(self.squares) / 2
        at_rest = each <= np.maximum(4 * np.median(each, axis=0), self.step**2 / 3)  # or between two steps
        variances = np.mean(each, axis=0, where=at_rest)
        minute = np.maximum(np.sqrt(variances * float(np.median(self.dt))), self.sensor.noise) / np.sqrt(MINUTE)
        steps = zip(axes_in(self.sensor, len(self.step)), self.step, variances, minute, strict=True)
        for axis, q, variance, noise in steps:
            if not 0 < q < np.inf:
                continue
            s = noise_before(float(q), float(variance))
            off = q / np.pi * np.exp(-2 * (np.pi * s / q) ** 2)
            if off > np.sqrt(2) * noise:
                faults.doubt(
                    f"{axis_name(self.name, axis)} rounds to steps of {q:.3g} {self.sensor.unit}, and its noise before "
                    f"them is {s / q:.2g} of one: a mean is off by up to {off:.2g} {self.sensor.unit}, which no "
                    "averaging takes out; choose a smaller range of the sensor, or more digits of its file"
                )


class Holds:
    """Repetitions of the readings of a sensor, beside what its noise makes of its steps.

    Noise whose changes have the mean square m, in least changes, repeats a reading with a chance of

    ::

        p = 1 / sqrt(1 + 2 pi (m - 1)),

    which is 1 / sqrt(2 pi m) where it is many steps, and 1 where no reading is farther than a step from the one before.
    m is that of the changes that end a repetition: of a sensor that moves at times the others are larger.
    """

    def __init__(self, name: str, sensor: Sensor | None, d: int) -> None:
        self.name, self.axes = name, axes_in(sensor, d)
        self.rows = 0
        self.runs = np.zeros((d, BLOCK), dtype=np.int64)  # how often a reading came again so many times
        self.least = np.full(d, np.inf)  # of the changes
        self.ends: list[list[Array]] = [[] for _ in range(d)]  # changes behind a repetition

    def look(self, changes: Array) -> None:
        """Look at the sizes of changes from row to row in blocks (B, BLOCK - 1, d)."""
        self.rows += changes.shape[0] * BLOCK
        self.least = np.minimum(self.least, np.min(changes, axis=(0, 1), where=changes > 0, initial=np.inf))
        for axis, same in enumerate(np.moveaxis(changes == 0, -1, 0)):
            if not np.any(same):
                continue
            turns = np.diff(np.pad(same, ((0, 0), (1, 1))).astype(np.int8), axis=1)
            lengths = np.nonzero(turns < 0)[1] - np.nonzero(turns > 0)[1]
            self.runs[axis] += np.bincount(lengths, minlength=BLOCK)
            self.ends[axis].append(changes[:, 1:, axis][same[:, :-1] & ~same[:, 1:]])

    def judge(self, faults: Faults) -> None:
        """Note a doubt about each axis that repeats its reading for longer than its noise does, in many rows.

        Where all axes do, and evenly, the rows only come faster than the readings: that is a note.
        """
        times, found, usual, even = np.arange(BLOCK), dict[str, tuple[float, float, int]](), [], True
        for k, axis in enumerate(self.axes):
            behind, runs = np.concatenate([*self.ends[k], np.empty(0)]), self.runs[k]
            m = float(np.median(behind / self.least[k])) ** 2 if len(behind) >= ENDS else 1.0
            if m > 1:
                most = 2 * np.log(self.rows / CHANCE) / np.log1p(2 * np.pi * (m - 1))
                share = float((times * runs)[times > most].sum()) / self.rows
                if share >= SHARE:
                    half, most_rows = np.searchsorted(np.cumsum(times * runs) / (times @ runs), [0.5, 0.9])
                    even &= bool(most_rows <= 2 * half)
                    usual.append(half)
                    found[axis] = most, share, int(np.max(np.flatnonzero(runs)))
        if even and len(found) == len(self.axes):
            faults.note(
                f"{self.name} gives each reading about {1 + min(usual)} times: rows come faster than the sensor reads; "
                "record each reading once, or declare the noise of such rows"
            )
            return
        for axis, (most, share, longest) in found.items():
            faults.doubt(
                f"{axis_name(self.name, axis)} shows the very same reading up to {longest + 1} times in a row, in "
                f"{share:.0%} of the rows, where its noise would not {most + 1:.0f} times: it {HELD}, as over a "
                "link that loses samples; record each reading once, or correct the logger"
            )


def usual_change(values: Array) -> Array:
    """Return the median size (d,) of the changes from row to row of values (N, d); NaN where none changes."""
    changes = np.abs(np.diff(values, axis=0))
    return np.array([np.median(column[column > 0]) if np.any(column > 0) else np.nan for column in changes.T])


def alone(x: Array, usual: float) -> NDArray[np.intp]:
    """Return the rows of readings x (N,) that are far from both neighbours, which are close to each other.

    Far is more than USUAL usual changes from row to row, and half as many times nearly all changes in the rows about
    it: where all scatter more, as in motion, none stands alone.
    """
    steps = np.diff(x)
    sizes = np.abs(steps)
    least = np.minimum(sizes[:-1], sizes[1:])
    rows = np.flatnonzero((least > USUAL * usual) & (np.abs(steps[:-1] + steps[1:]) < least / 2)) + 1
    if not len(rows) or len(sizes) < 2 * ABOUT:
        return rows[:0]
    about = np.clip(rows - ABOUT, 0, len(sizes) - 2 * ABOUT)[:, None] + np.arange(2 * ABOUT)
    others = np.partition(sizes[about], -FEW, axis=1)[:, -FEW]
    return np.asarray(rows[least[rows - 1] > USUAL / 2 * others])  # of noise, twice the median


class Lone:
    """Readings of a sensor that stand alone between others: bits were lost on the way, or something knocked."""

    def __init__(self, name: str, sensor: Sensor | None, d: int) -> None:
        self.name, self.axes = name, axes_in(sensor, d)
        self.unit = "in SI" if sensor is None else sensor.unit
        self.rows, self.usual = 0, np.full(d, np.nan)
        self.counts, self.squares = np.zeros(d), np.zeros(d)  # of such readings, and of the changes to and from them
        self._t, self._last = np.empty(0), np.empty((0, d))  # some rows before; the last waits for what follows

    def look(self, chunk: Chunk, leaps: Array, limit: float, faults: Faults) -> None:
        """Look at the next rows, of which `leaps` (d,) are the largest changes of each axis; what saturates is none."""
        values = chunk[self.name]
        if len(values) >= BLOCK and not np.all(leaps <= USUAL * self.usual):
            self.usual = usual_change(values[: BLOCK * BLOCKS])
            self._count(np.append(self._t, chunk.t), np.concatenate([self._last, values]), limit, faults)
        self.rows, self._t, self._last = self.rows + len(values), chunk.t[-ABOUT:].copy(), values[-ABOUT:].copy()

    def _count(self, t: Array, values: Array, limit: float, faults: Faults) -> None:
        waited = len(self._t) - 1
        for k, axis in enumerate(self.axes):
            rows = alone(values[:, k], self.usual[k])
            rows = rows[(rows >= waited) & (np.abs(values[rows, k]) < limit)]
            if len(rows):
                self.counts[k] += len(rows)
                self.squares[k] += 2 * np.sum((values[rows, k] - values[rows - 1, k]) ** 2)
                first = f"{values[rows[0], k]:.6g} {self.unit} at {faults.when(t[rows[0]])}"
                faults.add(f"readings of {axis_name(self.name, axis)} alone between others far off", len(rows), first)

    def judge(self, faults: Faults) -> None:
        """Note a doubt about each axis of whose noise some such readings are more than all others."""
        shares = self.squares / self.rows / (self.usual / MEDIAN) ** 2
        for axis, count, share in zip(self.axes, self.counts, shares, strict=True):
            if count >= max(SEVERAL, OFTEN * self.rows) and share > 1:
                faults.doubt(
                    f"{axis_name(self.name, axis)}: most of its noise is {SINGLE}, as of lost bits or of knocks; leave "
                    "such rows out, by a channel `valid` that is zero there"
                )


def axes_in(sensor: Sensor | None, d: int) -> list[str]:
    """Return the names of d axes: those that the sensor declares, where it declares as many."""
    named = [] if sensor is None else list(sensor.axes)
    return named if len(named) == d else list("xyz".ljust(d, "?")[:d])


class Thermometer:
    """The habit of a thermometer: how long it repeats a reading, how far it moves from row to row."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        # times in s and readings that are not looked at yet, after one that was; their number, and with that one
        self._held, self._rows, self._stop = np.empty((2, ENOUGH)), 0, 0
        self.changes = self.longest = self.run = 0  # changes, rows of the longest repetition, and of the present one
        self.since = np.nan  # when that began, s
        self.first: tuple[float, float] | None = None  # time in s and temperature of the first row
        self.fast = self.odd = False  # whether it has moved faster than any, and shown what no soak has
        self.impossible: set[float] = set()  # readings below absolute zero: one or two of a logger that has none
        # the last two rows, and whether the first of them stands alone
        self._last: tuple[Array, Array, bool] = np.empty(0), np.empty(0), False

    def along(self, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
        """Pass the rows of a source on, and look for readings below absolute zero that change as readings do."""
        for chunk in chunks:
            T = chunk.channels.get("temperature")
            if T is not None and len(self.impossible) < LIVELY and not all_within(T, *RANGES["temperature"][:2]):
                self.impossible |= set(np.unique(T[T < ZERO]).tolist())
                if len(self.impossible) >= LIVELY:
                    self.faults.doubt(
                        "temperature changes below absolute zero; correct path or unit of source.channels.temperature"
                    )
            yield chunk

    def look(self, chunk: Chunk) -> None:
        """Take the next temperatures (N,), in degC, and look at them once there are enough."""
        t, T, begin = chunk.t, chunk.channels.get("temperature"), self._stop
        if T is None or T.ndim != 1:
            return
        since = self._held[0, 0] if begin else t[0]
        if self._rows + len(t) >= ENOUGH or t[-1] - since > LASTING:
            self._look(np.append(self._held[0, :begin], t), np.append(self._held[1, :begin], T), self._rows + len(t))
            return
        self._rows, self._stop = self._rows + len(t), begin + len(t)
        self._held[0, begin : self._stop], self._held[1, begin : self._stop] = t, T

    def flush(self) -> None:
        """Look at all that came."""
        if self._rows:
            self._look(self._held[0, : self._stop].copy(), self._held[1, : self._stop].copy(), self._rows)

    def _look(self, t: Array, T: Array, new: int) -> None:
        """Look at times and readings, of which the last `new` have not been looked at."""
        known, self._held[:, 0], self._rows, self._stop = len(t) - new, (t[-1], T[-1]), 0, 1
        self._repeats(t, T, np.flatnonzero(T[1:] != T[:-1]) + 1, known)
        self._jumps(t[known:], T[known:])
        self._range(t, T)

    def _repeats(self, t: Array, T: Array, changed: NDArray[np.intp], known: int) -> None:
        """Look for a repetition far beyond the habit; `changed` are rows with another reading than the one before."""
        edges = np.concatenate([[known - self.run], changed, [len(T)]])
        runs, since = np.diff(edges), t[0] if np.isnan(self.since) else self.since
        for k in np.flatnonzero(runs > STUCK * max(self.longest, 1)):  # seldom any
            begin, last = t[edges[k]] if k else since, edges[k + 1] - 1
            before = int(np.max(runs[:k], initial=self.longest))
            if self.changes + k >= LIVELY and runs[k] > STUCK * before and t[last] - begin >= LASTING:
                self.faults.doubt(
                    f"temperature shows exactly {T[last]:.6g} °C from {self.faults.when(begin)} on, and had never "
                    f"shown one reading in more than {before} rows: the thermometer is stuck; leave that part out with "
                    "PATH::START:STOP"
                )
                self.longest = int(runs[k])
                break
        self.changes, self.longest = self.changes + len(changed), int(np.max(runs[:-1], initial=self.longest))
        self.run, self.since = int(runs[-1]), float(t[changed[-1]] if len(changed) else since)

    def _jumps(self, t: Array, T: Array) -> None:
        """Look at new rows for jumps, and for readings that stand alone between others; the last row waits."""
        before, shown, alone_before = self._last
        t, T = np.concatenate([before, t]), np.concatenate([shown, T])
        steps, alone = np.abs(np.diff(T)), np.zeros(len(T), dtype=bool)
        if len(T) > 2 and np.max(steps) > JUMP:
            beyond = (steps > max(JUMP, USUAL * float(np.median(steps[steps > 0])))) & (steps > FASTEST * np.diff(t))
            alone[0], alone[1:-1] = alone_before, beyond[:-1] & beyond[1:] & (np.abs(T[2:] - T[:-2]) < JUMP)
            for k in np.flatnonzero(beyond[:-1] & ~alone[:-2] & ~alone[1:-1])[:1]:
                self.faults.doubt(
                    f"temperature jumps from {T[k]:.4g} to {T[k + 1]:.4g} °C within {t[k + 1] - t[k]:.3g} s at "
                    f"{self.faults.when(t[k + 1])}, as no body does; leave that part out, or correct the thermometer"
                )
            self._note_alone(t, T, np.flatnonzero(alone[1:-1]) + 1)
        self._last = t[-2:], T[-2:], bool(alone[-2]) if len(T) > 1 else False

    def _note_alone(self, t: Array, T: Array, rows: NDArray[np.intp]) -> None:
        """Note readings that stand alone: once as a doubt, and each in a count."""
        if not len(rows):
            return
        first = f"{T[rows[0]]:.6g} °C at {self.faults.when(t[rows[0]])}"
        if ALONE not in self.faults.found:
            self.faults.doubt(
                f"temperature is {first}, alone between readings far off it, as of a thermometer that has none; "
                "leave such rows out, by a channel `valid` that is zero there"
            )
        self.faults.add(ALONE, len(rows), first)

    def _range(self, t: Array, T: Array) -> None:
        if self.first is None:
            self.first = float(t[0]), float(T[0])
            if T.min() > KELVIN and T.max() < SOAKS[1]:
                self.faults.doubt(
                    f"temperature is {T[0]:.4g} °C in the first row: that looks like kelvin; set "
                    "source.channels.temperature.unit to K"
                )
        if not self.odd and (T.min() < SOAKS[0] or T.max() > SOAKS[1]):
            self.odd, k = True, int(np.argmax((SOAKS[0] > T) | (SOAKS[1] < T)))
            self.faults.doubt(
                f"temperature is {T[k]:.4g} °C at {self.faults.when(t[k])}: no sensor is soaked below {SOAKS[0]:g} or "
                f"above {SOAKS[1]:g} °C; correct path or unit of source.channels.temperature"
            )
        seconds, warmer = float(t[-1]) - self.first[0], abs(float(T[-1]) - self.first[1])
        if warmer > MOVED and warmer > FASTEST * seconds and not self.fast:
            self.fast = True
            self.faults.doubt(
                f"temperature moves by {warmer:.3g} K in {seconds:.3g} s: no body does; correct "
                "source.channels.time.unit, or source.interval"
            )
