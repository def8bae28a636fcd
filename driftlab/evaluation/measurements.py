"""Measurements of the quantities that a config limits: by a map, an Allan analysis and a run.

For the Allan deviation of a run less its map, the input of its filter is averaged over a second or more. An average
counts where half of it or more was measured at rest; all stretches of such averages are analysed, short gaps bridged
where the unit did not move. It takes 86,400 averages a day, whatever the rate. K averages, d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from driftlab.evaluation.limits import SIDE, Measured
from driftlab.evaluation.scores import CELL, HORIZONS, WINDOW, Scores
from driftlab.maps.fit import axes_of
from driftlab.noise.allan import curve
from driftlab.noise.allan_fit import Coefficients, fit
from driftlab.noise.allan_model import KEYS, WHITE, WHITE_ALIKE, alike
from driftlab.noise.recording import MIN_SAMPLES, MIN_STRETCH, Pieces, pieces
from driftlab.units import RATE, BiasUnit
from fusion_core.chunk import Array
from fusion_core.contracts import Alignment, FittedMap, Sensor, TriadMatrix
from fusion_core.wandering import bounds, contrasts_about_level, rows_of

COAST = "10 min"  # the horizon that a limit is about
MIN_SHARE = 0.9  # of it that must have been measured at rest
# what slow noise does to a curve or a memory is known from few squares of it, four or so: Student's t
FEW = 2.132 / SIDE
MAX_ROWS = 120  # of a run whose covariance is written down
POINTS = 1000  # temperatures at which a map's largest and smallest bias are looked for
TWO_SIDES = 1.96  # standard deviations of the limits of an Allan fit, of 95 % between both
NOT_SURE = "its kind of map does not say how sure the curve is; take one that does"
LONGER = "a longer stimulus would decide it, or larger rates"
WHOLE = "`driftlab allan` measures it over the whole of a recording"
SHORTEST = 1.0  # s, of an average
WALKS = 0.1  # what a walk adds to the correlation of neighbouring differences of white noise
FLOOR = KEYS.index("bias_instability")
Less = Callable[[Mapping[str, Array]], Array]


def of_map(fitted: FittedMap, unit: BiasUnit = RATE) -> dict[str, Measured]:
    """Return residual, swing and hysteresis of a fitted map, and its terms of M, from the map and its record.

    The residual is the rms of averages of the fit's samples about the curve, in which white noise hardly counts, and
    its limits are those of what another such soak has in the mean (`driftlab.maps.residual`). The swing is as sure as
    the curve's change between the two temperatures. A hysteresis is noted in `unit` where no limit is set for it.
    """
    record, axes = fitted.record, axes_of(fitted)
    low, high = record.domain
    where, lasted = f"{low:.4g} to {high:.4g} °C", record.lasted or np.nan
    T = np.linspace(low, high, POINTS)
    bias = fitted.bias(T)
    top, bottom = np.argmax(bias, axis=0), np.argmin(bias, axis=0)
    swing = Measured(np.ptp(bias, axis=0), axes, stands_on=f"the curve, {where}", otherwise=NOT_SURE)
    if record.error is not None:
        pairs = zip(top, bottom, strict=True)
        sigma = np.array([fitted.sigma(T[[k]], float(T[j]))[0, axis] for axis, (k, j) in enumerate(pairs)])
        swing = normal(swing, sigma * FEW, lasted)
        if record.error.misfits:
            swing = replace(swing, seconds=np.nan, otherwise="take a map that bends more, the curve is not followed")
    return {
        "residual": _residual(fitted, where, lasted),
        "swing": swing,
        "hysteresis": _hysteresis(fitted, lasted, unit),
        **({} if record.matrix is None else dict(_of_matrix(record.matrix, axes))),
    }


def _of_matrix(matrix: TriadMatrix, axes: Sequence[str]) -> Iterator[tuple[str, Measured]]:
    """Yield the largest error of the scale factor, and misalignment, of each axis over temperature.

    An axis is below a limit where it is at every temperature, with its guard.
    """
    T = np.linspace(matrix.T[0], matrix.T[-1], POINTS)
    M, told = np.abs(matrix.at(T)), np.reshape(matrix.told, (3, 3))
    own, free = np.eye(3, dtype=bool), matrix.free.reshape(3, 3)
    sigma = None if matrix.error is None else matrix.sigma(T).reshape(-1, 3, 3)
    for name, some in (("scale", own), ("misalignment", ~own & free)):
        rows = np.any(some, axis=1)
        names = [axis for axis, row in zip(axes, rows, strict=True) if row]
        values = np.max(np.where(some, M, 0.0), axis=(0, 2))[rows]
        measured = Measured(values, names, stands_on=f"M(T), {T[0]:.4g} to {T[-1]:.4g} °C", otherwise=LONGER)
        if hidden := [axes[i] + axes[j] for i, j in np.argwhere(some & ~told)]:
            measured = replace(measured, missing=f"not observable by the stimulus: {', '.join(hidden)}")
        elif sigma is not None:
            low, high = (np.where(some, M + side * SIDE * sigma, 0.0) for side in (-1, 1))
            at = np.argmax(np.where(some, M, 0.0).max(axis=2), axis=0)[rows]
            lows = low.max(axis=2)[at, np.flatnonzero(rows)]
            measured = replace(measured, low=lows, high=np.max(high, axis=(0, 2))[rows])
        yield name, measured


def _residual(fitted: FittedMap, where: str, lasted: float) -> Measured:
    record, axes = fitted.record, axes_of(fitted)
    if record.averaged_residual is None:
        return unmeasured(axes, "the map's file does not say its residual in averages; fit it anew")
    averages = f"{record.averaged_over:g} s averages, {record.samples:,} samples, {where}"
    residual = Measured(np.asarray(record.averaged_residual), axes, stands_on=averages, seconds=lasted)
    if record.averaged_bounds is None:
        short = "too short a soak to say how sure; record 20 min"
        text = short if record.lasted else "the map's file does not say how sure its residual is; fit it anew"
        return replace(residual, otherwise=text)
    return replace(residual, **dict(zip(("low", "high"), np.array(record.averaged_bounds).T, strict=True)))


def _hysteresis(fitted: FittedMap, lasted: float, unit: BiasUnit) -> Measured:
    """Return the largest difference between warming and cooling, of the memory in the map's record.

    Where none is seen, the value does not show, and its limit is what the soak would have shown with 95 %. A soak that
    only warms measures none.
    """
    memory, axes = fitted.record.memory, axes_of(fitted)
    if memory is None:
        return unmeasured(axes, "the map's file does not say what its soak tells of hysteresis; fit it anew")
    size, sigma, bound = (np.array(memory[k], dtype=np.float64) for k in ("size", "sigma", "none_larger_than"))
    if memory["answer"] == "undecided":
        why = memory["why"] or "it is not known from this soak"
        looked_for = memory.get("log_evidence") is not None
        return Measured(np.full(len(axes), np.nan), axes, otherwise=why) if looked_for else unmeasured(axes, why)
    if memory["answer"] == "none":
        high, zero = np.where(np.isfinite(bound), bound, np.inf), np.zeros(len(axes))
        return Measured(zero, axes, zero, high, "none is seen; one larger would have been, with 95 %", seconds=lasted)
    seen = f"seen: {' or '.join(memory['kinds'])}".replace("_", " ")
    k = int(np.argmax(np.abs(size)))
    largest = f"{axes[k]} {abs(size[k]) * unit.factor:.3g} {unit.shown}"
    beside = f"a hysteresis or lag of {largest} between warming and cooling is seen; no limit is set for it"
    difference = Measured(np.abs(size), axes, stands_on=seen, beside=beside)
    return normal(difference, np.where(np.isfinite(sigma), sigma * FEW, np.inf), lasted)


def unmeasured(axes: Sequence[str], why: str) -> Measured:
    """Return a measurement without values, and why there are none."""
    return Measured(np.full(len(axes), np.nan), axes, missing=why)


def normal(measured: Measured, sigma: Array, seconds: float) -> Measured:
    """Return a measurement with limits of a normal law whose deviation is sigma (d,)."""
    guard = SIDE * sigma
    return replace(measured, low=measured.values - guard, high=measured.values + guard, seconds=seconds)


def of_allan(
    coefficients: Sequence[Coefficients], axes: Sequence[str], span: float, *, of: str = ""
) -> dict[str, Measured]:
    """Return noise and bias instability of the d axes of a sensor, from the fit to its Allan curves.

    `span` is the length of what was used, s; `of` says what the curves are of, where it is not the sensor itself.
    A bias instability that does not show is judged by its upper limit.
    """
    stands_on = f"Allan deviation of {of}{span:.4g} s"
    result = {}
    for name, k in (("noise", WHITE), ("bias_instability", FLOOR)):
        value, low, high = (np.array([getattr(c, end)[k] for c in coefficients]) for end in ("value", "low", "high"))
        if hidden := [axis for axis, end in zip(axes, high, strict=True) if np.isinf(end)]:
            text = f"no averaging time shows it of {', '.join(hidden)}: filtered, interpolated or constant data"
            result[name] = unmeasured(axes, text)
            continue
        part = np.where(value > 0, SIDE / TWO_SIDES, 1.0)  # of a limit of 97.5 %, on a scale of logarithms
        with np.errstate(divide="ignore", invalid="ignore"):
            high = np.where(value > 0, value * (high / value) ** part, high)
            low = np.where(low > 0, value * (low / value) ** part, 0.0)
        result[name] = Measured(value, axes, low, high, stands_on, seconds=span)
    return result


def of_coast(yardsticks: Scores, length: float, align: float) -> Measured:
    """Return the error of prediction of a run: its rms over 10 minutes after an alignment, in the mean over the run.

    `length` is of what there is after the alignment, s, which lasts `align` s itself. The run is cut into parts of 10
    minutes, each as if aligned right before it (`yardsticks.coasts`). The mean of so many is computed by
    `fusion_core.wandering`, of the error e of the prediction over the whole run: white noise w in each cell of it,
    and what wanders by the law W::

        E = w (CELL / 30 s + CELL / align) + w rho mean over 10 min of var(e(t) - mean of e over the alignment)

    The error of the run's own prediction is measured, and no limit that it is beyond can be passed.
    """
    axes, (text, at_rest) = yardsticks.axes, _coasted(COAST, yardsticks, length)
    if text:
        return Measured(yardsticks.coast[COAST], axes, missing=text)
    J = len(yardsticks.coasts)
    values = np.sqrt(np.mean(yardsticks.coasts**2, axis=0))
    rows, joined = rows_of(yardsticks.errors[:, 0], yardsticks.errors[:, 1:], MAX_ROWS)
    before, after = np.arange(CELL / 2, align, CELL) - align, np.arange(CELL / 2, HORIZONS[COAST], CELL)
    t = rows.t[0] + np.concatenate([before, after]) + align
    wanted = [(CELL / WINDOW + CELL / align, _drifted(law.covariance(t, CELL), len(before))) for law in rows.laws]
    each = contrasts_about_level(rows)
    variances = [bounds(rows, each, r, float(k), wanted) for r, k in zip(joined.T, rows.within, strict=True)]
    low, high = np.sqrt(np.array(variances)).T
    high = np.maximum(high, yardsticks.coast[COAST])
    stands_on = f"{J} prediction{'s' * (J > 1)} of {COAST}, {at_rest}"
    return Measured(values, axes, low, high, stands_on, seconds=length)


def _drifted(covariance: Array, m: int) -> float:
    """Return the mean variance of what follows the first m times, less their mean, by the covariance of all times."""
    own = np.mean(np.diag(covariance)[m:])
    return float(own - 2 * np.mean(covariance[m:, :m]) + np.mean(covariance[:m, :m]))


def _coasted(horizon: str, yardsticks: Scores, length: float) -> tuple[str, str]:
    """Return the reason not to judge a prediction over a horizon, empty where there is none, and its share at rest."""
    ends, share = HORIZONS[horizon], yardsticks.share[horizon]
    first = f"the first {horizon}" if np.isfinite(ends) else "all that follows the alignment"
    at_rest = f"{100 * share:.0f} % at rest"
    if np.isfinite(ends) and length < ends * (1 - 1e-9):
        return f"there are {length / 60:.3g} min after the alignment; record {ends / 60:g} or more", at_rest
    if not share >= MIN_SHARE:
        return f"{100 * share:.0f} % of {first} were measured at rest; {100 * MIN_SHARE:.0f} % are needed", at_rest
    return "", at_rest


def coast_over(horizon: str, yardsticks: Scores, length: float, noise: Array) -> Measured:
    """Return the rms of a prediction's error over one of HORIZONS.

    `length` is of what there is after the alignment, s; `noise` (d,) the density of the white noise. The uncertainty is
    that of the reference, an average over 30 s whose white noise is `s^2 = noise^2 / 30 s`. With M the mean square of
    error and noise over T::

        Var M = 4 e^2 s^2 (30 s / T) + 2 s^4 (20 s / T),    e^2 = M - s^2,    sigma of rms = sqrt(Var M) / (2 rms)

    since a moving average over W of white noise has the correlation 1 - |lag| / W, which adds up to W, and its square
    to 2 W / 3.
    """
    T, values, axes = min(HORIZONS[horizon], length), yardsticks.coast[horizon], yardsticks.axes
    text, at_rest = _coasted(horizon, yardsticks, length)
    if text:
        return Measured(values, axes, missing=text)
    s2 = noise**2 / WINDOW
    e2 = np.maximum(values**2 - s2, 0.0)
    variance = (4 * e2 * s2 * WINDOW + 2 * s2**2 * 2 * WINDOW / 3) / T
    sigma = np.sqrt(variance) / (2 * np.where(values > 0, values, np.nan))
    return normal(Measured(values, axes, stands_on=f"{horizon}, {at_rest}"), sigma, T)


def of_alignment(sensor: Sensor, alignment: Alignment, align: float) -> Measured:
    """Return the white noise of a sensor over the alignment, which lasted `align` s.

    It is the scatter of differences of n neighbours; those overlap, so `(sigma of noise / noise)^2 = 3 / (4 n)`.
    """
    noise = sensor.noise * alignment.noise_ratio[sensor.channel]
    n = max(round(align / alignment.dt) - 1, 1)
    measured = Measured(noise, sensor.axes, stands_on=f"the alignment, {align:.4g} s", otherwise=WHOLE)
    return normal(measured, noise * np.sqrt(0.75 / n), np.nan)


class Averages:
    """Averages of the rate less what a map explains of it, block after block of a run.

    The interval is that of the updates, s; `less` returns, of a block of N rows, the map's part (N, d) of its rate, SI.
    """

    def __init__(self, interval: float, axes: Sequence[str], less: Less | None = None) -> None:
        self.step, self.axes, self.less = interval * max(1, round(SHORTEST / interval)), list(axes), less
        self._parts: list[Array] = []  # (3 + d, K): index, time at rest and moving [s], sum of the rate at rest

    def add(self, block: Mapping[str, Array]) -> None:
        """Take the next rows: `t` and `tau` (N,) s, `still` (N,), `rate` (N, d), and what the map needs."""
        rate = block["rate"] if self.less is None else block["rate"] - self.less(block)
        still = block["still"].astype(bool)
        weight = block["tau"] * still
        index = np.floor((block["t"] - block["tau"] / 2) / self.step)
        starts = np.concatenate([[0], np.flatnonzero(np.diff(index)) + 1])
        sums = np.add.reduceat(np.column_stack([weight, block["tau"] * ~still, weight[:, None] * rate]), starts)
        self._parts.append(np.column_stack([index[starts], sums]))

    def measured(self) -> Measured:
        """Return the bias instability of all stretches at rest without a gap."""
        cut, values = self._whole()
        lasted = cut.samples * self.step
        if not cut.enough:
            longest, least = np.max(cut.places, initial=0) * self.step, MIN_STRETCH * self.step
            return unmeasured(
                self.axes,
                f"{lasted:.4g} s at rest, {longest:.4g} s without a gap; record {MIN_SAMPLES * self.step:.4g} s or "
                f"more, {least:.4g} s of it without a gap",
            )
        fits = [fit(curve(axis, self.step, stretches=cut.rows, missing=cut.missing)) for axis in values.T]
        of = "the rest less the map, " if self.less is not None else "the rest, "
        return of_allan(fits, self.axes, lasted, of=of)["bias_instability"]

    def noise(self) -> Measured:
        """Return the density of the white noise, from the differences of neighbouring averages.

        Each has the variance `noise^2 (1 / tau_1 + 1 / tau_2)`, of averages over tau; neighbours share one of the two,
        so `(sigma of noise / noise)^2 = 3 / (4 n)`.
        """
        rows = self._rows()
        counts = rows[:, 1] >= self.step / 2
        pairs = counts[1:] & counts[:-1] & (np.diff(rows[:, 0]) == 1)
        n, time = int(np.sum(pairs)), np.maximum(rows[:, 1:2], self.step / 2)
        if n < MIN_SAMPLES:
            why = f"{n * self.step:.4g} s at rest in a row; record {MIN_SAMPLES * self.step:.4g} s or more"
            return unmeasured(self.axes, why)
        steps = np.diff(rows[:, 3:] / time, axis=0) / np.sqrt(1 / time[1:] + 1 / time[:-1])
        steps[~pairs] = 0.0
        square = np.sum(steps**2, axis=0)
        near = float(np.max(np.sum(steps[1:] * steps[:-1], axis=0) / np.maximum(square, np.finfo(float).tiny)))
        if alike(near, n, WHITE_ALIKE, WALKS):
            return unmeasured(
                self.axes,
                f"neighbouring averages of {self.step:.3g} s are alike (differences correlate by {near:.2f}, those of "
                f"white noise by {WHITE_ALIKE}): filtered or interpolated data do not show it",
            )
        measured = Measured(np.sqrt(square / n), self.axes, stands_on=f"{n * self.step:,.0f} s at rest")
        return normal(measured, measured.values * np.sqrt(0.75 / n), n * self.step)

    def _rows(self) -> Array:
        """Return index, time at rest and moving [s] and sum of the rate at rest (K, 3 + d) of all averages."""
        rows = np.concatenate(self._parts) if self._parts else np.zeros((0, 3 + len(self.axes)))
        if len(rows):  # an average may begin in one block and end in the next
            starts = np.concatenate([[0], np.flatnonzero(np.diff(rows[:, 0])) + 1])
            rows = np.column_stack([rows[starts, 0], np.add.reduceat(rows[:, 1:], starts)])
        return rows

    def _whole(self) -> tuple[Pieces, Array]:
        """Return the averages that count in pieces, and all (K, d) that these are rows of."""
        rows = self._rows()
        counts = rows[:, 1] >= self.step / 2
        known = counts | (rows[:, 2] > 0)  # what else was lost is a gap
        rows, counts = rows[known], counts[known]
        return pieces(rows[:, 0] * self.step, counts), rows[:, 3:] / np.maximum(rows[:, 1:2], self.step / 2)
