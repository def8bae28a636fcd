"""The temperature that a soak went through, from readings that round it to steps.

Of steps q and noise s before them, a reading r at the temperature T has the probability::

    P(r | T) = Phi((r + q/2 - T) / s) - Phi((r - q/2 - T) / s)

and the rate of T is a random walk of the density k, so that the likeliest temperatures are the least of a convex
function, which Newton's method finds with banded matrices. Of several k that of the largest evidence counts (Laplace's
approximation). Readings are taken in groups over which T hardly moves, and a mean counts as the two levels that it
lies between, each by its share. A map that is fitted on these temperatures leaves noise and walk, and no sawtooth.

Source: G. Kitagawa and W. Gersch, Smoothness Priors Analysis of Time Series, Springer (1996), chapters 2 and 6.
N readings, K groups.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftlab.soak.blocks import CELLS, scatter
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap
from fusion_core.thermal.thermometer import NO_STEPS, Steps, sawtooth, steps_of

WALKS = (5e-5, 2e-4, 1e-3, 5e-3)  # K/s/sqrt(s), of the rate
PASSAGES = 200  # of a soak: its temperature moves one way within most of them
HARDLY = 0.05  # of a step: a group's temperature moves by so much; and noise before the rounding, at least
GROUPS = 8, 8000  # at least and at most
NEWTON = 50  # steps, at most
NEAR = 1e-3  # of a step: no more is to be gained
ROUNDING = 1e-13  # of the largest second derivative: of a step's direction only
CLEAR = 3.29  # deviations: noise alone is beyond once in a thousand times
HALF_LOG_2_PI = 0.5 * float(np.log(2 * np.pi))


def soak_temperature(t: Array, T: Array, steps: Steps, each: int = 1) -> tuple[Array, Steps]:
    """Return the temperature (N,) in degC of readings T (N,) at times t (N,) in s, and the steps with their noise.

    T may be means of `each` readings. Where the thermometer has no `steps`
    (`fusion_core.thermal.thermometer.steps_of`), T stays as it is.
    """
    if steps.size == 0.0 or np.ptp(T) == 0:
        return T, steps
    grouped = _grouped(t, T, HARDLY * steps.size)
    if grouped is None:
        return T, steps
    at, means, count = grouped
    levels = _Levels(means, each * count, _offset(T, steps.size), steps)
    smooth = np.interp(t, at, _likeliest(levels, at, means))
    return smooth, Steps(steps.size, min(steps.noise, levels.noise(T - smooth, smooth)))


def without_noise(t: Array, T: Array) -> Array:
    """Return the temperature (N,) in degC of readings T (N,) at times t (N,) in s of a thermometer without steps.

    Where their noise reaches beyond the temperature by less than a cell of the soak, they stay as they are: a curve of
    readings that are wider is flat at its ends, where there is noise alone.
    """
    noise = scatter(T)
    beyond = noise * np.sqrt(2 * np.log(max(len(T), 2)))  # of the largest of N
    grouped = _grouped(t, T, HARDLY * noise) if beyond * CELLS > np.ptp(T) > 0 else None
    if grouped is None:
        return T
    at, means, count = grouped
    return np.interp(t, at, _likeliest(_Noisy(means, count, noise), at, means))


def _grouped(t: Array, T: Array, hardly: float) -> tuple[Array, Array, Array] | None:
    """Return means (K,) of times and readings (N,) over which T moves by so many K, and how many each is of."""
    moved = float(np.sum(np.abs(np.diff(T[:: max(1, len(T) // PASSAGES)])))) / len(T)
    starts = np.arange(0, len(T), max(1, int(hardly / moved), len(T) // GROUPS[1]))
    if len(starts) < GROUPS[0]:
        return None
    count = np.diff(starts, append=len(T)).astype(np.float64)
    at, means = (np.add.reduceat(values, starts) / count for values in (t, T))
    return at, means, count


def _likeliest(readings: _Readings, at: Array, first: Array) -> Array:
    """Return the path (K,) in degC at times `at` (K,) of the walk of its rate that has the largest evidence."""
    path, evidence = readings.likeliest(at, WALKS[0], first)
    for walk in WALKS[1:]:
        tried, its_evidence = readings.likeliest(at, walk, path)
        if its_evidence < evidence:
            break
        path, evidence = tried, its_evidence
    return path


def soak_temperatures(recordings: Sequence[tuple[Array, Array]]) -> tuple[list[Array], Steps]:
    """Return the temperatures of recordings by one thermometer, and its steps: the largest that one of them shows.

    Each is a pair of times (N,) in s and readings (N,) in degC.
    """
    steps = max((steps_of(T) for _, T in recordings), default=NO_STEPS)
    smoothed = [soak_temperature(t, T, steps) for t, T in recordings]
    return [T for T, _ in smoothed], max((own for _, own in smoothed), default=NO_STEPS)


def between_steps(t: Array, T: Array, readings: Array, steps: Steps) -> Array:
    """Return the density (N,) in K^2 s by which a temperature T (N,) at times t (N,) may be off between the steps.

    It is known where it passes from one level of the `readings` (N,) to the next. Between two such passages, L apart,
    its rate walks by the density k^2 = 3 D^2 / (h + h') that the passages before and after show, D the change of the
    rate and h, h' the times between them; so it is off by the variance k^2 L^3 / 192 in the middle, and by that of a
    step at most. All this while it is off by the same: a mean over a time tau has the variance of L / tau of it.

    Source: G. Wahba, Spline Models for Observational Data, SIAM (1990), section 1.5: an integrated walk between knots.
    """
    offset = _offset(readings, steps.size)
    level = np.floor((T - offset) / steps.size + 0.5)
    passed = np.flatnonzero(np.diff(level)) + 1
    cuts = np.concatenate([[0], passed, [len(T) - 1]])
    length = np.maximum(np.diff(t[cuts]), NEAR)
    rate = np.diff(T[cuts]) / length
    walk = 3 * np.diff(rate[1:-1]) ** 2 / (length[2:-1] + length[1:-2])
    either = np.full(len(length), np.inf)  # of the first and the last, which do not lie between two passages
    either[1:-1] = np.maximum(np.append(walk, 0.0), np.append(0.0, walk))
    stay = np.searchsorted(passed, np.arange(len(T)), side="right")
    within = T - offset - steps.size * level
    return np.asarray(np.minimum((either * length**3 / 192)[stay], steps.size**2 / 12 + within**2) * length[stay])


def of_thermometer(
    fitted: FittedMap, steps: Steps, T: Array | None = None, off: Array | None = None, interval: float = 1.0
) -> FittedMap:
    """Return the map with what the thermometer of its soak hides.

    Its two ends tell little: within a step of them no level is passed as a whole. Misfits stay that are more than the
    samples at T (N,) in degC, an `interval` in s apart, show where they are `off` (N,) as `between_steps` says.
    """
    fitted = fitted.noting(resolution=steps.size, dither=steps.noise)
    error = fitted.record.error
    if error is None or steps.size == 0.0:
        return fitted
    grid = np.asarray(error.T)
    sawteeth = fitted.slope(grid) * np.sqrt(np.sum(sawtooth(*steps)))
    depth = np.stack([grid[0] + steps.size - grid, grid - grid[-1] + steps.size]) / steps.size
    misfits = []
    for m in error.misfits:
        near = np.zeros(0) if T is None or off is None else off[np.abs(T - m.T) <= steps.size / 2]
        hidden = float(np.sum(near)) / (max(len(near), 1) ** 2 * interval)
        noise = float(np.hypot(m.noise, fitted.slope(np.array([m.T]))[0, m.axis] * np.sqrt(hidden)))
        if m.left > CLEAR * noise:
            misfits.append(m.model_copy(update={"noise": noise}))
    modes = np.maximum(depth, 0.0)[:, :, None] * sawteeth
    return fitted.noting(error=error.beside(modes, misfits=tuple(misfits)))


def _offset(T: Array, size: float) -> float:
    """Return one of the levels in degC that are `size` K apart, about which readings T (N,) are."""
    near = float(np.angle(np.mean(np.exp(2j * np.pi * T / size)))) * size / (2 * np.pi)
    return near + float(np.median((T - near + size / 2) % size)) - size / 2


class _Readings:
    """Readings of a temperature, and how likely they are; `size` in K is that of their steps, or of their noise."""

    size: float

    def likeliest(self, at: Array, walk: float, first: Array) -> tuple[Array, float]:
        """Return the path (K,) in degC at times `at` (K,) whose rate walks so much, and the logarithm of its evidence.

        `first` (K,) is where it begins.
        """
        from scipy.linalg import cho_solve_banded, cholesky_banded

        smoothness = _Smoothness(at, walk)
        T, (cost, slope, bend) = first, self._cost(first, smoothness)
        for _ in range(NEWTON):
            band = smoothness.band.copy()
            band[0] += bend + ROUNDING * float(band[0].max())
            root = cholesky_banded(band, lower=True)
            step, share = -cho_solve_banded((root, True), slope), 1.0
            while (tried := self._cost(T + share * step, smoothness))[0] > cost + 1e-4 * share * float(slope @ step):
                share /= 2
                if share < NEAR:
                    break
            else:
                T = T + share * step
                cost, slope, bend = tried
                if np.max(np.abs(share * step)) > NEAR * self.size:
                    continue
            break
        return T, smoothness.log_scale - cost - float(np.sum(np.log(root[0])))

    def _cost(self, T: Array, smoothness: _Smoothness) -> tuple[float, Array, Array]:
        """Return the logarithm of the posterior, negative, its gradient (K,), and the second derivatives (K,)."""
        roughness, pull = smoothness.of(T)
        value, first, second = self.of(T)
        return roughness + value, pull + first, second

    def of(self, T: Array) -> tuple[float, Array, Array]:
        """Return -log P of all readings at T (K,), with its first and second derivatives (K,)."""
        raise NotImplementedError


class _Noisy(_Readings):
    """Means (K,) in degC of so many readings, `count` (K,), of a thermometer with white noise of a deviation in K."""

    def __init__(self, means: Array, count: Array, noise: float) -> None:
        self.size, self.means, self.weights = noise, means, count / noise**2

    def of(self, T: Array) -> tuple[float, Array, Array]:
        """Return -log P of all readings at T (K,), with its first and second derivatives (K,)."""
        off = T - self.means
        return float(np.sum(self.weights * off**2)) / 2, self.weights * off, self.weights


class _Levels(_Readings):
    """The levels that readings show: how likely they are at a temperature.

    `means` (K,) in degC and `count` (K,) are of groups of readings, `offset` is one of the levels in degC.
    """

    def __init__(self, means: Array, count: Array, offset: float, steps: Steps) -> None:
        self.size, self.offset = steps.size, offset
        self.sharp = max(steps.noise, HARDLY * steps.size)
        place = np.round((means - self.offset) / steps.size, 9)  # equal readings lie on a level but for rounding
        below = np.floor(place)
        self.middle = self.offset + below * steps.size
        count = np.maximum(count * min(steps.noise / self.sharp, 1.0), 1.0)
        self.weights = np.stack([(below + 1 - place) * count, (place - below) * count])

    def of(self, T: Array) -> tuple[float, Array, Array]:
        """Return -log P of all readings at T (K,), with its first and second derivatives (K,)."""
        total, slope, bend = 0.0, np.zeros(len(T)), np.zeros(len(T))
        for k, weights in enumerate(self.weights):
            shown = np.flatnonzero(weights)  # most groups show one level alone
            weight = weights[shown]
            value, first, second = self._of_level(T[shown], self.middle[shown] + k * self.size)
            total += float(weight @ value)
            slope[shown] += weight * first
            bend[shown] += weight * second
        return total, slope, bend

    def _of_level(self, T: Array, middle: Array) -> tuple[Array, Array, Array]:
        """Return -log P of levels (K,) at T (K,), with first and second derivatives."""
        from scipy.special import log_ndtr

        upper, lower = (middle + self.size / 2 - T) / self.sharp, (middle - self.size / 2 - T) / self.sharp
        tail = upper + lower > 0  # by the tail that loses no digits
        more, less = log_ndtr(np.where(tail, -lower, upper)), log_ndtr(np.where(tail, -upper, lower))
        log_p = more + np.log1p(-np.exp(np.minimum(less - more, -1e-12)))
        at_upper, at_lower = (np.exp(-(x**2) / 2 - HALF_LOG_2_PI - log_p) for x in (upper, lower))
        first = (at_upper - at_lower) / self.sharp
        second = first**2 + (upper * at_upper - lower * at_lower) / self.sharp**2
        return -log_p, first, np.maximum(second, 0.0)

    def noise(self, away: Array, T: Array) -> float:
        """Return the noise before the rounding, by the sawtooth's first harmonic in T and what readings are away."""
        wave = -np.sin(2 * np.pi * (T - self.offset) / self.size)
        a = float(np.pi / self.size * (away @ wave) / (wave @ wave))
        return self.size * float(np.sqrt(abs(np.log(np.clip(a, 1e-4, 1.0))) / 2)) / np.pi


class _Smoothness:
    """Prior of a path whose rate walks: second differences over times `at` (K,), as a banded matrix (3, K)."""

    def __init__(self, at: Array, walk: float) -> None:
        h = np.diff(at)
        self.weight = 2 / (walk**2 * (h[1:] + h[:-1]))
        a, c = 1 / h[:-1], 1 / h[1:]
        self.pieces = a, -(a + c), c
        self.band = np.zeros((3, len(at)))
        for i in range(3):
            for j in range(i + 1):
                self.band[i - j, j : len(at) - 2 + j] += self.weight * self.pieces[i] * self.pieces[j]
        self.log_scale = -(len(at) - 2) * float(np.log(walk))

    def of(self, T: Array) -> tuple[float, Array]:
        """Return half the weighted sum of squares of the path's second differences, and its gradient (K,)."""
        a, b, c = self.pieces
        second = a * T[:-2] + b * T[1:-1] + c * T[2:]
        pull = np.zeros(len(T))
        for k, piece in enumerate(self.pieces):
            pull[k : len(T) - 2 + k] += self.weight * piece * second
        return 0.5 * float(self.weight @ second**2), pull
