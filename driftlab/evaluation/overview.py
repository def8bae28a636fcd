"""The overview of a run for its summary and its report, from its estimates block by block, and its limits.

Memory does not grow with the recording: sums for the scores and tests, and a few thousand rows for the figures. How
many rows there will be need not be known: whenever there are too many, every second row of a curve is left out, and two
and two stretches become one. So an overview is made while the run goes by, and nothing is read back.

The errors are drawn with every spike of them, in a few points. Rows that are picked evenly from a long run miss what
lasts shorter than their distance. So each stretch of a run gives its smallest and its largest error, at the time of its
middle: a line through them reaches as far as the errors do. N rows, d axes, K stretches.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.config import Config
from driftlab.evaluation.limits import LimitResult, Measured, check_limits
from driftlab.evaluation.measurements import Averages, of_coast, of_map
from driftlab.evaluation.scores import (
    CELL,
    HORIZONS,
    LONGEST_FIRST,
    WINDOW,
    ScoreAccumulator,
    Scores,
    errors_of,
    moving_average,
)
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from driftlab.filtering.setup import noise_doubts
from driftlab.recordings.prefetch import prefetch
from driftlab.units import BiasUnit, unit_of
from fusion_core.chunk import Array, Flags, read_only
from fusion_core.consistency import NisTest, VarianceRatio, Whiteness, nis_test_of
from fusion_core.contracts import Alignment, FittedMap, MeasurementModel, Sensor, ThermalBias
from fusion_core.fast import compiled
from fusion_core.faults import DOUBT

ROWS = 32_768  # of a block
POINTS = 2000  # rows kept for the figures at most, and half of them at least where there are as many
STRETCHES = 400  # of which the figures show errors, two points each, and mean nis; up to twice as many
SMOOTHED = "smoothed/bias"  # where `run --smooth` writes it
NAMES = (
    "t", "tau", "used", "still", "rate", "bias", "bias_sigma", "coast", "coast_sigma", "nis", "white", "temperature",
    "temperature_raw", SMOOTHED,
)  # fmt: skip
DRAWN = (
    "t", "still", "bias", "bias_sigma", "coast", "coast_sigma", "temperature", "temperature_raw", "reference", SMOOTHED,
)  # fmt: skip
Columns = dict[str, Array]


@dataclass(frozen=True)
class Overview:
    """A run at a glance."""

    count: int  # updates
    used: int  # those whose measurement was used
    start: float  # time of the first update, s
    end: float  # time of the last one, s
    first_row: float  # time of the recording's first row, s; of the first update where it is not known
    bias: Array  # (d,) at the end, SI
    sigma: Array  # (d,) its deviation
    deviations: tuple[Array, Array]  # (d,) least and root mean square of the bias's, of the updates that NIS is of
    yardsticks: Scores  # scores of the run
    nis: NisTest  # of the used updates after the first alignment
    whiteness_p: Array  # (m,) of the same
    slow: VarianceRatio  # of the same
    # at most POINTS rows of the estimates, evenly spread, and the last, with the `reference` of the scores
    curves: Columns
    errors: Columns  # `t`, and the error of `bias` and `coast`, with every spike of it
    nis_curve: Array  # (K, 3) time in s, mean nis and number of updates of up to 2 STRETCHES stretches
    nis_highest: float  # largest nis of one update among them
    swing: float  # of the temperature, K; 0 where there is none


class OverviewAccumulator:
    """The sums and rows behind an overview, taken while a run goes by: any split of it gives the same.

    The alignment is the run's first; `averages` are given every block, which is gathered up to so many rows. Where the
    rows have no innovations, made white, `whiteness` has them.
    """

    def __init__(
        self, model: MeasurementModel, alignment: Alignment, averages: Averages | None = None, rows: int = ROWS,
        whiteness: Whiteness | None = None,
    ) -> None:  # fmt: skip
        self.model, self.alignment, self.rows, d = model, alignment, rows, len(model.tracked.axes)
        self.averages, self.names = averages, NAMES if averages is None else (*NAMES, "calibration")
        self.count = self.used = self._pending = 0
        self.start, self._coldest, self._warmest = np.nan, np.inf, -np.inf
        self._scores, self._envelope = ScoreAccumulator(d), Envelope(d)
        self._whiteness = whiteness or Whiteness(model.m)
        self._curves, self._last = _Thinned(), Columns()
        self._parts: list[Mapping[str, Array]] = []  # of the next block
        self._waiting: list[Columns] = []  # blocks whose reference is not known yet
        self._before: list[Columns] = []  # the half window before those

    def add(self, columns: Mapping[str, Array]) -> None:
        """Take the next rows of a run."""
        self._parts.append(columns)
        self._pending += len(columns["t"])
        if self._pending >= self.rows:
            self._gather()

    def read(self, columns: Mapping[str, Array]) -> OverviewAccumulator:
        """Take all rows of a run that is there as a whole, or of the file of one; return itself."""
        for block in prefetch(_blocks(columns, self.rows, self.names)):
            self.add(block)
        return self

    def _gather(self) -> None:
        """Look at the block that has come together, and at those that waited for it."""
        names = [name for name in self.names if self._parts and name in self._parts[0]]
        joined = _joined(self._parts, names).items()
        block = {n: read_only(rows.astype(np.float64, copy=False)) for n, rows in joined}  # compiled once: of one kind
        self._parts, self._pending = [], 0
        if block:
            self._waiting.append(block)
        while self._waiting and (not block or block["t"][-1] > self._waiting[0]["t"][-1] + WINDOW / 2):
            first, *after = self._waiting
            self._look({**first, "reference": _reference(self._before, first, after)})
            self._before = _half_window([*self._before, self._waiting.pop(0)])

    def _look(self, block: Columns) -> None:
        used, after = block["used"].astype(bool), counted(block, self.alignment)
        self.start = self.start if self.count else float(block["t"][0])
        self.count, self.used = self.count + len(used), self.used + int(np.count_nonzero(used))
        if "temperature" in block:
            self._coldest = min(self._coldest, float(np.min(block["temperature"])))
            self._warmest = max(self._warmest, float(np.max(block["temperature"])))
        self._last = _rows(block, len(used) - 1, None)
        errors = errors_of(block, block["reference"])
        self._scores.add(block, errors)
        if "white" in block:
            self._whiteness.add(block["white"][after])
        self._envelope.add(block, errors, after)
        self._curves.add(block)
        if self.averages is not None:
            self.averages.add(block)

    def overview(self, first_row: float | None = None) -> Overview:
        """Return the overview of all rows; `first_row` is the time of the recording's first row, s, where known."""
        if self._parts:
            self._gather()
        self._gather()  # what still waits has nothing after it
        model, found = self.model, self._envelope
        up = self.alignment.up if model.tracked.integral else None
        return Overview(
            count=self.count,
            used=self.used,
            start=self.start,
            end=float(self._last["t"][-1]),
            first_row=self.start if first_row is None else first_row,
            bias=self._last["bias"][-1],
            sigma=self._last["bias_sigma"][-1],
            deviations=(found.least, np.sqrt(found.squares / max(np.sum(found.sums[:, 0]), 1))),
            yardsticks=self._scores.yardsticks(up, model.tracked.axes, model.align),
            nis=nis_test_of(found.nis_total, int(np.sum(found.sums[:, 0])), model.m),
            whiteness_p=self._whiteness.p(),
            slow=self._whiteness.slow(),
            curves=self._curves.curves(self._last),
            errors=found.curves(),
            nis_curve=found.nis_curve(),
            nis_highest=found.nis_highest,
            swing=max(self._warmest - self._coldest, 0.0),
        )


def counted(columns: Mapping[str, NDArray[Any]], alignment: Alignment) -> Flags:
    """Return the updates (N,) that NIS and whiteness are tested on: those used after the first alignment."""
    return columns["used"].astype(np.bool_) & (columns["t"] > alignment.t)


class _Thinned:
    """At most POINTS rows, evenly spread, and the last one; how many rows there are in all need not be known."""

    def __init__(self) -> None:
        self.at, self.stride = 0, 1
        self.parts: list[Columns] = []

    def add(self, block: Columns) -> None:
        """Take those of the next block."""
        N = len(block["t"])
        while (self.at + N) // self.stride >= POINTS - 1:
            self.stride *= 2
            self.parts = [_every(_joined(self.parts, self.parts[0]), 0, 2)] if self.parts else []
        kept = _every({name: block[name] for name in DRAWN if name in block}, -self.at % self.stride, self.stride)
        self.parts.append(kept)
        self.at += N

    def curves(self, last: Columns) -> Columns:
        """Return the rows by name; `last` is the last of all."""
        if (self.at - 1) % self.stride:
            self.parts.append({name: last[name] for name in self.parts[0]})
        return _joined(self.parts, self.parts[0])


def thin(N: int) -> Array:
    """Return the indices of at most POINTS samples of N, evenly spread."""
    return np.unique(np.linspace(0, N - 1, min(N, POINTS)).astype(int))


def _blocks(columns: Mapping[str, Array], rows: int, names: Sequence[str]) -> Iterator[Columns]:
    data = {name: columns[name] for name in names if name in columns}
    for start in range(0, len(data["t"]), rows):
        yield {name: values[start : start + rows] for name, values in data.items()}


def _half_window(before: list[Columns]) -> list[Columns]:
    """Return the rows of the last half window, and at least one from before it."""
    begin = before[-1]["t"][-1] - WINDOW / 2
    while len(before) > 1 and before[1]["t"][0] <= begin:
        before = before[1:]
    return [_rows(before[0], int(np.searchsorted(before[0]["t"], begin)) - 2, None), *before[1:]]


def _reference(before: list[Columns], block: Columns, after: list[Columns]) -> Array:
    """Return the moving average (N, d) over a block between what comes before and after it."""
    end = block["t"][-1] + WINDOW / 2
    after = [_rows(part, 0, int(np.searchsorted(part["t"], end, side="right")) + 1) for part in after]
    window = _joined([*before, block, *after], ("t", "rate", "tau", "still"))
    start = sum(len(part["t"]) for part in before)
    averages = moving_average(window["t"], window["rate"], window["tau"], window["still"].astype(bool))
    return averages[start : start + len(block["t"])]


def _rows(block: Columns, start: int, stop: int | None) -> Columns:
    return {name: values[max(start, 0) : stop] for name, values in block.items()}


def _every(block: Columns, start: int, step: int) -> Columns:
    return {name: values[start::step].copy() for name, values in block.items()}


def _joined(parts: Sequence[Mapping[str, Array]], names: Iterable[str]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) if parts[1:] else parts[0][name] for name in names}


class Envelope:
    """Smallest and largest error of estimate and prediction, and nis, of STRETCHES to twice as many stretches of rows.

    All are as long; with one more than that, two and two become one. Of all rows whose nis counts, `least` and
    `squares` (d,) are the least deviation of the bias and the sum of their squares.
    """

    def __init__(self, d: int) -> None:
        self.at, self.length, K = 0, 1, 2 * STRETCHES
        self.low, self.high = np.full((K, 1 + 2 * d), np.inf), np.full((K, 1 + 2 * d), -np.inf)  # of t and the errors
        self.sums = np.zeros((K, 3))  # of the updates that count: their number, sum of t, sum of nis
        self.nis_total, self.nis_highest, self.least, self.squares = 0.0, 0.0, np.full(d, np.inf), np.zeros(d)

    def add(self, block: Mapping[str, Array], errors: Array, counts: Flags) -> None:
        """Take the next block with its errors (N, 3 d), NaN where not known; `counts` says whose nis counts."""
        while self.at + len(counts) > len(self.sums) * self.length:
            self.length *= 2
            for table, merged, empty in (
                (self.low, np.minimum, np.inf), (self.high, np.maximum, -np.inf), (self.sums, np.add, 0.0),
            ):  # fmt: skip
                table[:STRETCHES], table[STRETCHES:] = merged(table[::2], table[1::2]), empty
        tables = self.at, self.length, self.low, self.high, self.sums, self.least, self.squares
        total, highest = _take(block["t"], errors, block["nis"], block["bias_sigma"], counts, *tables)
        self.nis_total, self.nis_highest = self.nis_total + total, max(self.nis_highest, highest)
        self.at += len(counts)

    def curves(self) -> Columns:
        """Return `t` (2 K,) in s and the errors `bias` and `coast` (2 K, d) in SI, smallest and largest in turn."""
        low, high = (table[: -(-self.at // self.length)] for table in (self.low, self.high))
        quarter, known = (high[:, 0] - low[:, 0]) / 4, low <= high
        error = _in_turn(np.where(known, low, np.nan), np.where(known, high, np.nan))
        bias, coast = np.split(error[:, 1:], 2, axis=1)
        return {"t": _in_turn(low[:, 0] + quarter, high[:, 0] - quarter), "bias": bias, "coast": coast}

    def nis_curve(self) -> Array:
        """Return mean time, mean nis and number of updates (K, 3) of the stretches in which any update counts."""
        number, t, nis = self.sums[self.sums[:, 0] > 0].T
        return np.column_stack([t / number, nis / number, number])


@compiled
def _take(
    t: Array, errors: Array, nis: Array, sigma: Array, counts: Flags, at: int, length: int, low: Array, high: Array,
    sums: Array, least: Array, squares: Array,
) -> tuple[float, float]:  # fmt: skip
    """Take rows into the tables of `Envelope`; return the sum and the largest of the nis that count."""
    total = highest = 0.0
    before, squares[:] = squares.copy(), 0.0
    for k in range(len(t)):
        row = (at + k) // length
        low[row, 0], high[row, 0] = min(low[row, 0], t[k]), max(high[row, 0], t[k])
        for j in range(1, low.shape[1]):
            error = errors[k, j - 1]  # NaN is neither
            if error < low[row, j]:
                low[row, j] = error
            if error > high[row, j]:
                high[row, j] = error
        if counts[k]:
            total, highest = total + nis[k], max(highest, nis[k])
            for j, value in enumerate((1.0, t[k], nis[k])):
                sums[row, j] += value
            for j in range(len(least)):
                least[j], squares[j] = min(least[j], sigma[k, j]), squares[j] + sigma[k, j] ** 2
    squares += before
    return total, highest


def _in_turn(first: Array, second: Array) -> Array:
    """Return rows of two arrays (K, ...) in turn, (2 K, ...)."""
    return np.stack([first, second], axis=1).reshape(2 * len(first), *first.shape[1:])


def map_of(config: Config) -> FittedMap | None:
    """Return the map of the config's tracked sensor, from memory or its file; None where it has none."""
    settings = next((settings for settings in config.tracked_maps() if settings.has_map), None)
    return None if settings is None else settings.load()


def averages_of(config: Config, alignment: Alignment) -> Averages | None:
    """Return the averages that the limits of a config need of a run; None where none of them does.

    They are of the calibrated rate, or of the rate less the map's bias.
    """
    limits = config.limits
    if config.filter is None or limits is None or (limits.bias_instability is None and limits.noise is None):
        return None
    sensor = config.filter.tracked
    if sensor.calibration is not None:
        return Averages(alignment.dt, sensor.axes, lambda block: block["calibration"])
    fitted = map_of(config) if isinstance(sensor.bias, ThermalBias) else None
    if fitted is None:
        return Averages(alignment.dt, sensor.axes)
    clamped = replace(fitted, outside="clamp")  # the run has refused already what is to be refused
    return Averages(alignment.dt, sensor.axes, lambda block: clamped.bias(block["temperature"]))


@dataclass(frozen=True)
class ScoredRun:
    """One recording through one config, at a glance: the figures and files of each command are made of it."""

    config: Config
    model: MeasurementModel
    journal: RunLog
    overview: Overview
    averages: Averages | None  # those of `averages_of`

    @property
    def yardsticks(self) -> Scores:
        """The scores of the filter and of its prediction."""
        return self.overview.yardsticks

    @property
    def alignment(self) -> Alignment:
        """The first alignment."""
        return self.journal.alignments[0]

    @property
    def sensor(self) -> Sensor:
        """The sensor whose bias is estimated."""
        return self.model.tracked

    @property
    def unit(self) -> BiasUnit:
        """The unit of its bias."""
        return unit_of(self.sensor)

    @property
    def span(self) -> float:
        """Time from the end of the alignment to the end, s."""
        return self.overview.end - self.alignment.t

    @cached_property
    def predictions(self) -> dict[str, tuple[Array, Array, Array]]:
        """Error, deviation and their ratio (d,) of each prediction by its name, rms, the longest first.

        All of 10 minutes, one after the other, are one more where there are several. In the ratio the white noise of
        the reference, a mean over WINDOW, counts too.
        """
        scores = self.yardsticks
        noise = self.sensor.noise * np.maximum(self.alignment.noise_ratio[self.sensor.channel], 1.0) / np.sqrt(WINDOW)
        first, *shorter = ((name, scores.coast[name], scores.coast_sigma[name]) for name in LONGEST_FIRST)
        if (J := len(scores.coasts)) > 1:
            shorter.insert(
                0, (f"all {J} of 10 min", np.sqrt(np.mean(scores.coasts**2, axis=0)), _sigma_of_coasts(self))
            )
        return {name: (error, sigma, error / np.hypot(sigma, noise)) for name, error, sigma in (first, *shorter)}

    @cached_property
    def measured(self) -> dict[str, Measured]:
        """Measurements of the quantities that a config may limit, by their names.

        The prediction is that of the run; noise and bias instability are of the averages, where a limit asks for them;
        residual, swing and hysteresis are of the map.
        """
        fitted, limits = map_of(self.config), self.config.limits
        measured = {"coast": of_coast(self.yardsticks, self.span, self.model.align)}
        if self.averages is not None and limits is not None:
            measured |= {} if limits.noise is None else {"noise": self.averages.noise()}
            measured |= {} if limits.bias_instability is None else {"bias_instability": self.averages.measured()}
        return measured if fitted is None else measured | of_map(fitted, self.unit)

    @cached_property
    def doubts(self) -> list[str]:
        """Sentences on why the recording may not be what its config says."""
        updates = self.model.align / self.alignment.dt
        noise = noise_doubts(self.sensor, self.alignment.noise_ratio[self.sensor.channel], updates)
        return [*self.journal.faults.doubts, *noise]

    @cached_property
    def judged(self) -> list[LimitResult]:
        """The limits of the config, each held against its measurement."""
        if self.config.limits is None:
            return []
        doubts = [*self.doubts]
        if (fitted := map_of(self.config)) is not None and (why := fitted.record.provenance.get(DOUBT)):
            doubts.append(f"the soak of its map: {why}")
        return check_limits(self.config.limits, self.measured, doubts)


def _sigma_of_coasts(run: ScoredRun) -> Array:
    """Return the rms deviation (d,) of all predictions of 10 minutes, each as if aligned right before it.

    The variance v of the run's own prediction has a part of the map, m(T, T_0) from T_0 on, and the rest r. That of
    a prediction from s on is m(T, T_s) and, of the rest, what r begins with, and the larger of what it grows by from s
    on and from the run's own start on. T is that of the overview's curves: of a run longer than a week their rows are
    further apart than a prediction lasts, and how T moves within one is not in m.
    """
    curves, fitted = run.overview.curves, map_of(run.config)
    known = np.isfinite(curves["coast_sigma"][:, 0])
    t, rest = curves["t"][known], curves["coast_sigma"][known] ** 2
    at = run.alignment.t + run.yardsticks.starts[:, None] + np.arange(0, HORIZONS["10 min"] + CELL, CELL)
    of_map: Array = np.zeros((*at.shape, rest.shape[1]))
    if fitted is not None and "temperature" in curves:
        T = curves["temperature"][known]
        rest = rest - fitted.sigma(T, T[0]) ** 2
        of_map = np.array([fitted.sigma(each, each[0]) ** 2 for each in np.interp(at, t, T)])
    own = at[0] - run.yardsticks.starts[0]
    first, later = (np.stack([np.interp(x, t, r) for r in rest.T], axis=-1) for x in (own, at))
    grown = np.maximum(later - later[:, :1], first - first[0])
    return np.asarray(np.sqrt(np.mean(first[0] + grown + of_map, axis=(0, 1))))


def accumulator_of(run: Run, whiteness: Whiteness | None = None) -> OverviewAccumulator:
    """Return the accumulator of a run's overview, and of the averages that the config's limits need."""
    first = run.journal.alignments[0]
    return OverviewAccumulator(run.model, first, averages_of(run.config, first), whiteness=whiteness)


def scored(run: Run, rows: OverviewAccumulator | Mapping[str, Array]) -> ScoredRun:
    """Return a run with its overview, from its columns or from the accumulator that has seen them all."""
    gathered = rows if isinstance(rows, OverviewAccumulator) else accumulator_of(run).read(rows)
    first = run.journal.faults.first_row
    return ScoredRun(run.config, run.model, run.journal, gathered.overview(first), gathered.averages)
