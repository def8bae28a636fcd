"""Fit of the five coefficients of an Allan curve, with their limits.

::

    allan^2(tau) = 3 Q^2/tau^2 + N^2/tau + (2 ln 2/pi) B^2 + K^2 tau/3 + R^2 tau^2/2          (IEEE Std 952, annex C)

Of samples that are filtered the quantisation gives way to what the filter takes off, and averaging times within its
reach are left out (`Design.smoothed`).

Values: non-negative least squares, each averaging time weighted by its effective degrees of freedom under the fitted
model itself, iterated. Neighbouring averaging times share nearly all their samples, so the scatter of the fit about the
curve says nothing of its error. The limits are those of the values under which such an estimate would have been likely
(Neyman's construction): curves are drawn under a trial value and fitted alike.

J averaging times, p <= 5 coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from driftlab.noise.allan_model import KEYS, RAMP, WALK, WHITE, WHITE_ALIKE, AllanCurve, Design, alike, design
from driftlab.noise.allan_unsteady import Unsteady, unsteady_of
from fusion_core.chunk import Array

LEVEL = 0.95  # probability that an interval covers the true value
TAIL = (1 - LEVEL) / 2
MODEL_ERROR = 0.02  # of the variance: no unit follows five power laws more closely than that
GOOD = 0.11  # a departure of the variance up to which a fit begins at the shortest averaging time
REACH = 10  # times `a` of `Design.smoothed`: a filter of first or second order has then all but come to rest
SHAPED = 100  # samples over which what is no filter, as vibration, may bend the curve
RAMP_SHOWS = "a rate ramp shows"
SMOOTH = "neighbouring samples are alike, as those of a low-pass filter or of interpolation"
AVERAGES = 100  # over which a correlation is looked at
LEFT = 15  # averaging times that are left to a fit at least


@dataclass(frozen=True)
class Coefficients:
    """The five coefficients in SI in the order of KEYS, and their 95 % limits; zero where none is significant.

    The upper limit of what is not measured is infinite. So it is of the quantisation of filtered samples, in whose
    place `best` has, below zero, what the filter takes off.
    `spread` (J,) is the relative standard deviation of the Allan deviation at each averaging time; the fit begins at
    the averaging time number `first`. `best` is the fit itself, with terms in it that are not certain.
    """

    value: Array
    low: Array
    high: Array
    spread: Array
    best: Array
    first: int = 0
    notes: list[str] = field(default_factory=list)


def fit(curve: AllanCurve) -> Coefficients:
    """Fit the five coefficients to a curve.

    The walk is taken from the Hadamard curve, which a constant ramp does not reach, where the ramp shows on the Allan
    curve or the two curves do not agree on the walk.
    """
    if not (np.all(curve.allan > 0) and np.all(curve.hadamard > 0)):
        return _unknown(curve, "does not move at all at some averaging times: no coefficient can be fitted")
    whole, other = design(curve, hadamard=False), design(curve, hadamard=True)
    smooth = _smooth(curve, whole, other)
    if smooth:
        whole, other = whole.smoothed(), other.smoothed()
    first = (_beyond if smooth else _begin)(whole, curve.allan**2, curve.dt)
    if smooth and first > len(curve.tau) - LEFT:
        return _unknown(curve, f"{SMOOTH}: too few averaging times are left beyond its reach, nothing is measured")
    unsteady = _unsteady(curve, whole, first)
    whole, other = replace(whole, unsteady=unsteady), replace(other, unsteady=unsteady)
    allan = _limits(whole.since(first), curve.allan[first:] ** 2, list(range(int(smooth), 5)))
    hadamard = _limits(other.since(first), curve.hadamard[first:] ** 2, [WALK])
    value, low, high = allan.value, allan.low, allan.high
    notes = []
    if low[RAMP] > 0 or low[WALK] > hadamard.high[WALK]:
        why = RAMP_SHOWS if low[RAMP] > 0 else "Allan and Hadamard curves disagree on the walk"
        value[WALK], low[WALK], high[WALK] = hadamard.value[WALK], hadamard.low[WALK], hadamard.high[WALK]
        notes.append(
            f"{why}: a drift (temperature, warming up) bends the long end. The walk is fitted on the Hadamard curve, "
            "which a constant ramp does not reach; take the drift out with a thermal map"
        )
    elif allan.doubtful:
        names = " or ".join(KEYS[k].replace("_", " ") for k in allan.doubtful)
        notes.append(
            f"something more is there, which {names} would explain, but another term as well: reported as a limit; a "
            "longer recording tells"
        )
    notes += _fit_notes(curve, first, allan.error, smooth=smooth)
    notes += [unsteady.note] if unsteady else []
    best = np.sqrt(allan.theta)
    if smooth:
        high[0], best[0] = np.inf, -best[0]
    spread = whole.spread(allan.theta)
    if unsteady:
        spread = np.hypot(spread, unsteady.scatter * whole.shared(allan.theta))
    return Coefficients(value, low, high, spread / 2, best, first, notes)


def _unsteady(curve: AllanCurve, model: Design, first: int) -> Unsteady | None:
    """Return the unsteady part of the noise, by averaging time number `first`; None where there surely is none.

    A term has as much of it as it has of the variance there.
    """
    theta = _model_error(model.since(first), curve.allan[first:] ** 2)[1]
    terms, spread = (np.maximum(model.A[first], 0) * theta)[:RAMP], float(model.spread(theta)[first])
    if spread == 0:
        return None
    part, sizes = terms * np.sum(terms) / np.sum(terms**2), curve.m / curve.stride[first]
    return unsteady_of(curve.parts[first], sizes, first, (spread, part, curve.tail))


def _unknown(curve: AllanCurve, why: str) -> Coefficients:
    zero = np.zeros(len(KEYS))
    return Coefficients(zero, zero, np.full(len(KEYS), np.inf), np.zeros_like(curve.tau), zero, notes=[why])


def _fit_notes(curve: AllanCurve, first: int, error: float, *, smooth: bool) -> Iterator[str]:
    if smooth:
        yield (
            f"{SMOOTH}: fitted from {curve.tau[first]:.3g} s on, beyond its reach; the quantisation is not measured, "
            "and the noise is that before the filter"
        )
    elif first > 0:
        yield (
            f"fitted from {curve.tau[first]:.3g} s on: at shorter averaging times the curve does not have the shape of "
            "the five terms, as with vibration"
        )
    if error > MODEL_ERROR:
        yield (
            f"the curve departs from the five terms by about {50 * error:.0f} % (an oscillation, a low-pass "
            "filter, or a drift that is no ramp); the limits are widened by as much"
        )


def _begin(model: Design, v: Array, dt: float) -> int:
    """Return from which averaging time on the five terms fit well: the first, unless the short ones are bent."""
    last = max(0, min(len(v) - LEFT, int(np.searchsorted(model.tau, SHAPED * dt))))
    errors = [_model_error(model.since(j), v[j:])[0] for j in range(last + 1)]
    wanted = max(GOOD, 1.5 * min(errors))
    first = next(j for j, error in enumerate(errors) if error <= wanted)
    return first if errors[first] < errors[0] / 2 else 0


def _smooth(curve: AllanCurve, allan: Design, hadamard: Design) -> bool:
    """Return True if neighbouring samples are alike, and the five terms do not say so: a filter, or interpolation.

    Where the terms do not fit, averages over longer say it: slow noise makes those more alike, a filter less.
    """
    error, theta = _model_error(allan, curve.allan**2)
    terms, n = 1 - 1.5 * (hadamard.A[0] @ theta[:RAMP]) / (allan.A[0] @ theta), float(np.sum(curve.lengths))
    if error > GOOD:
        some = curve.alike[curve.m <= n / AVERAGES]
        k = int(np.argmin(some)) if len(some) else 0
        terms, n = float(curve.alike[k]), n / float(curve.m[k])
    tolerance = MODEL_ERROR + GOOD * abs(terms - WHITE_ALIKE)
    return alike(float(curve.alike[0]), int(n), terms, tolerance)


def _beyond(model: Design, v: Array, dt: float) -> int:
    """Return the first averaging time beyond the reach of a filter, as the fit of what it takes off tells it."""
    found = [_model_error(model.since(j), v[j:]) for j in range(max(1, len(v) - LEFT + 1))]
    wanted = 1.5 * min(error for error, _ in found)
    first, theta = next((j, theta) for j, (error, theta) in enumerate(found) if error <= wanted)
    with np.errstate(over="ignore"):  # where there is no white noise
        reach = REACH * 2 * theta[0] / max(theta[WHITE], np.finfo(float).tiny)
    return max(first, int(np.searchsorted(model.tau, reach)))


def _model_error(model: Design, v: Array) -> tuple[float, Array]:
    """Return by how much (of the variance) v departs from the five terms beyond its scatter, and the fit (p,)."""
    everything = list(range(model.A.shape[1]))
    error, theta = MODEL_ERROR, _estimate(model, v, everything, MODEL_ERROR)
    while error < 0.5 and _misfit(model, v, theta, error) > 2:
        error *= 1.5
        theta = _estimate(model, v, everything, error)
    return error, theta


@dataclass(frozen=True)
class NoiseLimits:
    """Values and limits (5,), the model's error, the squared estimates (p,), and what is needed but not certain."""

    value: Array
    low: Array
    high: Array
    error: float
    theta: Array
    doubtful: list[int]


def _limits(model: Design, v: Array, wanted: list[int]) -> NoiseLimits:
    """Fit the terms of `model` to variances v (J,), and find the limits of the coefficients `wanted`."""
    p = model.A.shape[1]
    error, theta = _model_error(model, v)
    low, high, chance = np.zeros(5), np.zeros(5), np.zeros(p)
    for c in wanted:
        trial = ProfileTrial(model, v, c, error)
        chance[c] = trial.exceeds(0.0)
        start = float(np.sqrt(theta[c]))
        low[c], high[c] = _lower(trial, start), _upper(trial, max(start, 1e-3 * trial.visible))
    needed = _needed(model, v, [c for c in wanted if low[c] == 0], chance, error)
    estimate = _estimate(model, v, needed, error)
    for c in wanted:
        # the others as they are finally reported, in place of refitted to each trial value: the wider limits count
        low[c], high[c] = _widened(ProfileTrial(model, v, c, error, estimate), low[c], high[c])
    value = np.zeros(5)
    value[wanted] = np.sqrt(estimate[wanted])
    doubtful = [c for c in wanted if value[c] > 0 and low[c] == 0]
    high = np.maximum(high, value)
    value[low == 0] = 0  # never a number that may as well be none
    return NoiseLimits(value, np.minimum(low, value), high, error, theta, doubtful)


def _misfit(model: Design, v: Array, theta: Array, error: float) -> float:
    off = v / (model.A @ theta) - 1
    return float(np.mean(off**2 / (model.spread(theta) ** 2 + error**2)))


def _needed(model: Design, v: Array, doubtful: list[int], chance: Array, error: float) -> list[int]:
    """Return the coefficients that are left when those not needed to explain the curve go, the least likely first."""
    needed = list(range(model.A.shape[1]))
    for c in sorted(doubtful, key=lambda c: -float(chance[c])):
        if len(needed) > 1 and ProfileTrial(model, v, c, error, free=needed).exceeds(0.0) > TAIL:
            needed.remove(c)
    return needed


def _estimate(model: Design, v: Array, free: list[int], error: float, fixed: Array | None = None) -> Array:
    """Return squared coefficients (p,): those in `free` fitted, the others as in `fixed`, or zero."""
    from scipy.optimize import nnls

    theta = np.zeros(model.A.shape[1]) if fixed is None else fixed.copy()
    offset = model.A @ theta
    spread = np.ones(len(v))
    mean = v
    for _ in range(5 if free else 0):
        B = model.A[:, free] / (mean * spread)[:, None]
        scale = np.linalg.norm(B, axis=0)
        theta[free] = nnls(B / scale, (v - offset) / (mean * spread))[0] / scale
        mean = np.maximum(model.A @ theta, 1e-3 * v)
        spread = np.hypot(model.spread(np.maximum(theta, 1e-300)), error)
    return theta


def _nonnegative(A: Array, V: Array, weight: Array) -> Array:
    """Return the non-negative least squares solutions (p,) or (p, draws) of A theta = V, rows weighted.

    With at most five coefficients, all sets of positive ones are tried at once for all draws; the best feasible set is
    the solution.
    """
    p = A.shape[1]
    rows = V.reshape(len(V), -1)
    B = A * weight[:, None]
    scale = np.linalg.norm(B, axis=0)
    B = B / scale
    G, g = B.T @ B, B.T @ (rows * weight[:, None])
    best = np.zeros((p, rows.shape[1]))
    gain = np.zeros(rows.shape[1])
    for size in range(1, p + 1):
        for chosen in combinations(range(p), size):
            index = list(chosen)
            x = _inverse(G[index][:, index]) @ g[index]
            more = np.einsum("pd,pd->d", x, g[index])
            better = np.flatnonzero((x.min(axis=0) > 0) & (more > gain))
            gain[better] = more[better]
            columns = np.zeros((p, len(better)))
            columns[index] = x[:, better]
            best[:, better] = columns
    return np.asarray((best / scale[:, None]).reshape(p, *V.shape[1:]))


def _inverse(G: Array) -> Array:
    """Return the inverse (k, k); the pseudo-inverse where terms look alike, as on a curve of few points."""
    try:
        return np.asarray(np.linalg.inv(G))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(G, hermitian=True))


@dataclass(frozen=True)
class ProfileTrial:
    """The question how likely the estimate of coefficient c would be, were its true value t.

    The other coefficients are refitted for each t, or have the squared values `others` (p,).
    """

    model: Design
    v: Array
    c: int
    error: float
    others: Array | None = None
    free: list[int] = field(default_factory=lambda: list(range(len(KEYS))))

    @property
    def visible(self) -> float:
        """The value at which the coefficient alone would reach the curve somewhere."""
        return float(np.sqrt(np.min(self.v / self.model.A[:, self.c])))

    def exceeds(self, t: float) -> float:
        """Return the probability of an estimate as large as that of v, or larger."""
        drawn, measured = self._estimates(t)
        return float(np.mean(drawn >= measured))

    def falls_short(self, t: float) -> float:
        """Return the probability of an estimate as small as that of v, or smaller."""
        drawn, measured = self._estimates(t)
        return float(np.mean(drawn <= measured))

    def _estimates(self, t: float) -> tuple[Array, float]:
        model, c = self.model, self.c
        free = [k for k in self.free if k < model.A.shape[1]]
        theta = np.zeros(model.A.shape[1]) if self.others is None else self.others.copy()
        theta[c] = t**2
        if self.others is None:
            theta = _estimate(model, self.v, [k for k in free if k != c], self.error, theta)
        theta[:RAMP] = np.maximum(theta[:RAMP], 1e-300)
        mean = np.maximum(model.A @ theta, 1e-9 * self.v)  # where no term is left
        weight = 1 / (mean * np.hypot(model.spread(theta), self.error))
        drawn = np.column_stack([self.v, model.draw(theta, self.error)])
        estimates = _nonnegative(model.A[:, free], drawn, weight)[free.index(c)]
        return estimates[1:], float(estimates[0])


def _lower(trial: ProfileTrial, start: float) -> float:
    """Return the value below `start` up to which so large an estimate is unlikely; 0 where it is likely without any."""
    return 0.0 if trial.exceeds(0.0) > TAIL else _bisect(lambda t: trial.exceeds(t) > TAIL, start / 30, start)


def _upper(trial: ProfileTrial, start: float) -> float:
    """Return the value above `start` from which on so small an estimate is unlikely."""
    stop = 2 * max(start, trial.visible)
    while trial.falls_short(stop) > TAIL and stop < 100 * trial.visible:
        stop *= 2
    return _bisect(lambda t: trial.falls_short(t) <= TAIL, start, stop)


def _widened(trial: ProfileTrial, low: float, high: float) -> tuple[float, float]:
    """Return the limits, moved outwards where this trial finds values beyond them likely."""
    if trial.falls_short(high) > TAIL:
        high = _upper(trial, high)
    if low > 0 and trial.exceeds(low) > TAIL:
        low = _lower(trial, low)
    return low, high


def _bisect(above: Callable[[float], bool], low: float, high: float) -> float:
    """Return the place at which `above` turns true between two positive numbers, to 2 % or so."""
    while high > 1.02 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if above(middle) else (middle, high)
    return float(np.sqrt(low * high))
