"""Scores of a run: its errors where the true bias is not known.

The reference is the centred moving average of the gyro, Earth rate removed, over 30 s (Fontanella et al. 2018,
sec. 6). Two scores on it: the *filter error* of the running estimate (tables 6 to 11), and the *prediction error* of
what is predicted from the end of the alignment with no further measurement, which is what a user feels when the
vehicle drives off.

Every epoch counts at which the unit stood still by its sensors (`rest_detector`), whatever the filter made of it,
and each for as long as it lasted. Over a gap, and where the unit moved, the error is taken to go straight from the one
side to the other::

    rms^2 = integral of e^2 dt / T,    heading = integral of e . up dt

over the time T that is known so; the share of T in the interval that was measured at rest stands beside each score.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fusion_core.chunk import Array, Flags
from fusion_core.fast import compiled

WINDOW = 30.0  # s, of the moving average
MIN_AT_REST = 2.0  # s within the window that make a reference
FIRST, WHOLE = "first 30 s", "whole"
HORIZONS = {"1 min": 60.0, "5 min": 300.0, "10 min": 600.0, "to the end": np.inf}
LONGEST_FIRST = tuple(reversed(HORIZONS))  # as tables show them: what decides comes first
COVERED = 0.5  # of an interval, with the gaps that both sides tell of: with less there is no score
CELL = 10.0  # s, in which errors are added up for coasts that begin anywhere
MEASURED = 0.9  # of a coast that begins later than the run's own, at rest: with less it does not count


@dataclass(frozen=True)
class Scores:
    """Errors in the SI unit of the bias, one value an axis; NaN where the recording does not reach."""

    axes: tuple[str, ...]  # names of the d axes
    filter_first: Array  # (d,) rms of estimate less reference, over the first 30 s after the alignment
    filter_whole: Array  # (d,) the same over the whole interval
    coast: dict[str, Array]  # (d,) rms of prediction less reference, for each horizon
    coast_sigma: dict[str, Array]  # (d,) rms over the same epochs of the deviation that the prediction says it has
    # angle about the vertical that the prediction is wrong by at its end, rad; NaN of other sensors
    heading: dict[str, float]
    # part of each interval that was measured at rest: of `first 30 s`, `whole` and each horizon
    share: dict[str, float]
    moved: float  # part of the whole interval in which the unit moved
    # (J, d) rms of prediction less reference over each 10 minutes, as if aligned right before
    coasts: Array = field(default_factory=lambda: np.empty((0, 0)))
    starts: Array = field(default_factory=lambda: np.empty(0))  # (J,) of these, s from the alignment
    # (K, 1 + d) of each CELL at rest: time from the alignment, s, and mean of prediction less rate
    errors: Array = field(default_factory=lambda: np.empty((0, 0)))


def moving_average(t: Array, rate: Array, tau: Array, still: Flags, window: float = WINDOW) -> Array:
    """Return the centred moving average (N, d) of rates (N, d) that lasted tau (N,) each, in the rates' unit.

    Over what was measured at rest (still) in the window, MIN_AT_REST s at least; NaN elsewhere, and at epochs that
    were not at rest. At the ends of the recording the window is as much of it as there is.
    """
    weight = np.where(still, tau, 0.0)
    averages: Array = _average(t, np.ascontiguousarray(rate), weight, still, window, min(MIN_AT_REST, window / 2))
    return averages


@compiled
def _average(t: Array, rate: Array, weight: Array, still: Flags, window: float, least: float) -> Array:
    # sums from the first row of each window up to its last, which both only ever move on
    N, d = rate.shape
    out = np.full((N, d), np.nan)
    typical = np.zeros(d)  # taken out, so that the sums stay small
    for k in range(N):
        for j in range(d):
            typical[j] += rate[k, j] / N
    angle, time = np.zeros((N + 1, d)), np.zeros(N + 1)
    for k in range(N):
        time[k + 1] = time[k] + weight[k]
        for j in range(d):
            angle[k + 1, j] = angle[k, j] + (rate[k, j] - typical[j]) * weight[k]
    first = last = 0
    for k in range(N):
        while first < N and t[first] <= t[k] - window / 2 - 1e-9:
            first += 1
        while last < N and t[last] < t[k] + window / 2 + 1e-9:
            last += 1
        lasted = time[last] - time[first]
        if still[k] and lasted >= least - 1e-6:
            for j in range(d):
                out[k, j] = (angle[last, j] - angle[first, j]) / lasted + typical[j]
    return out


class ScoreAccumulator:
    """The sums behind the scores of a run, taken stretch by stretch."""

    def __init__(self, d: int) -> None:
        self.start = np.inf  # of the coast [s]
        self.end = -np.inf  # of the run [s]
        self.moved = 0.0  # s
        lengths = {FIRST: 30.0, **HORIZONS}  # of errors of estimate and coast, and of the coast's deviation
        self._integrals = {name: Integral(3 * d, length) for name, length in lengths.items()}
        self._cells = Cells(d)

    def add(self, estimates: Mapping[str, Array], errors: Array) -> None:
        """Count the next rows of the estimates, with their errors (N, 3 d) (`errors_of`) in SI, NaN where not known."""
        t, coast = estimates["t"], estimates["coast"]
        if len(t) == 0:
            return
        self.end = float(t[-1])
        first = int(np.argmax(np.isfinite(coast[:, 0])))  # no earlier row is coasting, and each later one
        if np.isnan(coast[first, 0]):
            return
        t, coast, errors, rate = t[first:], coast[first:], errors[first:], estimates["rate"][first:]
        tau = np.asarray(estimates["tau"][first:], dtype=np.float64)
        self.start = min(self.start, float(t[0] - tau[0]))
        self.moved += float(np.sum(tau[~estimates["still"][first:].astype(bool)]))
        known = np.isfinite(errors[:, 0])
        for integral in self._integrals.values():
            integral.add(t, tau, errors, known, self.start)
        self._cells.add(t - self.start, tau, known, errors, np.asarray(coast - rate, dtype=np.float64))

    def yardsticks(self, up: Array | None, axes: tuple[str, ...], align: float = 60.0) -> Scores:
        """Return the scores of the rows that were added; an alignment lasts `align` s."""
        length = self.end - self.start
        none = np.full(len(axes), np.nan)
        coast, sigma, heading, d = {}, {}, {}, len(axes)
        for name, horizon in HORIZONS.items():
            reached = np.isinf(horizon) or length >= horizon * (1 - 1e-9)
            rms = self._integrals[name].rms(length)
            coast[name], sigma[name] = (rms[d : 2 * d], rms[2 * d :]) if reached else (none, none)
            turned = self._integrals[name].total[d : 2 * d]
            angle = np.nan if up is None or d != 3 else float(abs(turned @ up))
            heading[name] = angle if np.all(np.isfinite(coast[name])) else np.nan
        share = {name: integral.share(length) for name, integral in self._integrals.items()}
        share = {FIRST: share.pop(FIRST), WHOLE: share["to the end"], **share}
        first, whole = (self._integrals[name].rms(length)[:d] for name in (FIRST, "to the end"))
        moved = self.moved / length if length > 0 else 0.0
        coasts = self._cells.coasts(HORIZONS["10 min"], align, coast["10 min"])
        return Scores(axes, first, whole, coast, sigma, heading, share, moved, *coasts, self._cells.errors())


class Cells:
    """Errors of a prediction in cells of CELL s, of which the error of a prediction that begins anywhere is made.

    The open-loop prediction c(t) less what is measured b(t) is off by e(t). Aligned at s over `align` it begins with
    what was measured there, so that its error is e(t) less the mean of e over the alignment.
    """

    def __init__(self, d: int) -> None:
        self.d = d
        self.size = 0.0  # cells so far, those without a row too
        # number, time at rest [s], integrals of error, of its square, and of c - rate, of each cell with rows at rest
        self._cells = [np.array([[-1.0] + [0.0] * (1 + 3 * d)])]

    def add(self, t: Array, tau: Array, known: Flags, errors: Array, raw: Array) -> None:
        """Take the next rows: ends t (N,) from the start, s, lengths tau (N,), errors (N, 3 d) where they are known.

        `raw` (N, d) is the prediction less the rate.
        """
        cells = np.zeros((min(len(t), int((t[-1] - t[0]) / CELL) + 2), 2 + 3 * self.d))
        count, last = _sum_cells(t, tau, known, errors, raw, cells)
        self.size, cells = last + 1.0, cells[:count]
        if count and self._cells[-1][-1, 0] == cells[0, 0]:
            self._cells[-1][-1, 1:] += cells[0, 1:]
            cells = cells[1:]
        if len(cells):
            self._cells.append(cells)

    def errors(self) -> Array:
        """Return time, s, and mean of prediction less rate (K, 1 + d) of the cells that were at rest."""
        cells = np.concatenate(self._cells)
        cells = cells[cells[:, 1] >= MEASURED * CELL]
        return np.column_stack([(cells[:, 0] + 0.5) * CELL, cells[:, 2 + 2 * self.d :] / cells[:, 1:2]])

    def coasts(self, length: float, align: float, first: Array) -> tuple[Array, Array]:
        """Return the rms (J, d) and starts (J,) s of predictions of `length` s in turn, the run's own first (d,)."""
        n, m, d = round(length / CELL), max(round(align / CELL), 1), self.d
        coasts, begun = ([first], [0.0]) if np.all(np.isfinite(first)) else ([], [])
        cells = np.concatenate(self._cells)
        starts = np.unique(cells[:, 0] // n) * n
        for start in starts[(starts >= n) & (starts + n <= self.size)]:
            before, begin, end = np.searchsorted(cells[:, 0], [start - m, start, start + n])
            aligned, coast = np.sum(cells[before:begin, 1:], axis=0), np.sum(cells[begin:end, 1:], axis=0)
            if min(aligned[0] / (m * CELL), coast[0] / (n * CELL)) >= MEASURED:
                level = aligned[1 + 2 * d :] / aligned[0]
                mean, square = coast[1 : 1 + d] / coast[0], coast[1 + d : 1 + 2 * d] / coast[0]
                coasts.append(np.sqrt(np.maximum(square - 2 * level * mean + level**2, 0.0)))
                begun.append(start * CELL)
        return np.array(coasts).reshape(-1, d), np.array(begun)


@compiled
def _sum_cells(t: Array, tau: Array, known: Flags, errors: Array, raw: Array, cells: Array) -> tuple[int, float]:
    """Fill a row of `cells` (K, 2 + 3 d) for each cell with rows at rest; return how many, and the last row's cell."""
    d, at, number = raw.shape[1], -1, 0.0
    for k in range(len(t)):
        number = max(np.floor((t[k] - tau[k] / 2) / CELL), 0.0)
        if not known[k] or tau[k] <= 0:
            continue
        if at < 0 or cells[at, 0] != number:
            at += 1
            cells[at, 0] = number
        cell = cells[at]
        cell[1] += tau[k]
        for j in range(d):
            error = errors[k, d + j]
            cell[2 + j] += tau[k] * error
            cell[2 + d + j] += tau[k] * error**2
            cell[2 + 2 * d + j] += tau[k] * raw[k, j]
    return at + 1, number


class Integral:
    """Integrals over time of an error (d,) and of its square, up to `length` s after the start."""

    def __init__(self, d: int, length: float = np.inf) -> None:
        self.length = length
        self.squares, self.total = np.zeros(d), np.zeros(d)
        self._last = np.full(d + 1, np.nan)  # time and error of the last epoch that was known
        self._times = np.zeros(2)  # known with the gaps between, and measured [s]

    def add(self, t: Array, tau: Array, error: Array, known: Flags, start: float) -> None:
        """Count epochs that end at t (N,) and lasted tau (N,), with errors (N, d) where they are known (N,)."""
        end = start + self.length
        if not self._last[0] >= end:  # the first epoch beyond it tells of a gap in which it ends
            _integrate(t, tau, error, known, start, end, self._last, self.squares, self.total, self._times)

    def rms(self, length: float) -> Array:
        """Return the rms (d,) over an interval of `length` s, or up to the integral's own end."""
        lasted, span = self._times[0], min(self.length, length)
        known = lasted > 0 and lasted >= COVERED * span
        return np.sqrt(self.squares / lasted) if known else np.full(len(self.total), np.nan)

    def share(self, length: float) -> float:
        """Return the part of the interval that was measured."""
        span = min(self.length, length)
        return float(min(self._times[1] / span, 1.0)) if span > 0 else 0.0


@compiled
def _integrate(
    t: Array, tau: Array, error: Array, known: Flags, start: float, end: float,
    last: Array, squares: Array, total: Array, times: Array,
) -> None:  # fmt: skip
    d, before = error.shape[1], -1
    for k in range(len(t)):
        if not known[k]:
            continue
        begin, then = max(t[k] - tau[k], start), last[0] if before < 0 else t[before]
        gap = begin - then  # NaN at the first
        if gap > 1e-9 and then < end:
            part = min(gap, end - then)
            times[0] += part
            for j in range(d):
                a = last[1 + j] if before < 0 else error[before, j]
                b = a + (error[k, j] - a) * part / gap
                squares[j] += part * (a * a + a * b + b * b) / 3
                total[j] += part * (a + b) / 2
        lasted, before = min(t[k], end) - begin, k
        if lasted > 0:
            times[0], times[1] = times[0] + lasted, times[1] + lasted
            for j in range(d):
                squares[j] += lasted * error[k, j] ** 2
                total[j] += lasted * error[k, j]
    if before >= 0:
        last[0] = t[before]
        for j in range(d):
            last[1 + j] = error[before, j]


def errors_of(estimates: Mapping[str, Array], reference: Array) -> Array:
    """Return errors (N, 3 d) of bias and prediction less the reference (N, d), and the prediction's deviation."""
    bias, coast, sigma = (np.asarray(estimates[n], dtype=np.float64) for n in ("bias", "coast", "coast_sigma"))
    return np.hstack([bias - reference, coast - reference, sigma])


def score(estimates: Mapping[str, Array], up: Array | None, axes: tuple[str, ...]) -> Scores:
    """Return the scores of a run by its estimates, all of them at once; the arguments are those of `yardsticks`."""
    tally = ScoreAccumulator(estimates["bias"].shape[1])
    still = estimates["still"].astype(bool)
    reference = moving_average(estimates["t"], estimates["rate"], estimates["tau"], still)
    tally.add(estimates, errors_of(estimates, reference))
    return tally.yardsticks(up, axes)


def rms_over_time(estimates: Mapping[str, Array], error: Array, start: float, length: float = np.inf) -> Array:
    """Return the rms (d,) of an error (N, d), NaN where it is not known, over `length` s from `start` on."""
    integral = Integral(error.shape[1], length)
    t, tau = (np.ascontiguousarray(estimates[name], dtype=np.float64) for name in ("t", "tau"))
    integral.add(t, tau, np.ascontiguousarray(error), np.all(np.isfinite(error), axis=1), start)
    return integral.rms(float(t[-1]) - start)


def over_axes(values: Array) -> float:
    """Return the rms over axes (d,) of rms errors or deviations."""
    return float(np.sqrt(np.mean(np.square(values))))
