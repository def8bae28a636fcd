"""Report of a line, and its control charts: their statistics. All values in SI.

Control charts are of single units: Shewhart's (individuals, moving ranges) and the EWMA. Values are in a scale in which
they are about normal, in the order in which the units were made. Of value i with the deviation
sigma_i = sqrt(s^2 + own_i^2), s between the units and own_i of its measurement::

    z_i = (x_i - centre) / sigma_i,         alarm beyond 3
    w_i = (1 - lambda) w_{i-1} + lambda z_i,  alarm beyond 2.962 sqrt(lambda / (2 - lambda) (1 - (1 - lambda)^{2 i}))

s is of the moving range of the units on which the limits stand, so that neither a shift nor a drift of the line widens
them. Sources: Montgomery, Introduction to Statistical Quality Control, 7th ed., 6.4 and 9.2 (table 9.11: lambda 0.2,
L 2.962 alarm once in 500 units of a line in control; three sigma, once in 370); NIST/SEMATECH e-Handbook 6.3.2.

The scale is the logarithm of a quantity, its root, or as it is. A size (a density, a rms) varies by a share of itself,
so its logarithm is tried first and stays unless another scale is clearly more normal, by the correlation of the ordered
values with normal scores (Filliben).

m values of a chart, n values in general.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.family.baseline import Baseline, FrozenLimits, ScaleName
from driftlab.family.record import PER
from driftlab.spc.capability import D2, Capability
from driftlab.spc.subgroups import LotPoint
from driftlab.units import RATE, BiasUnit
from fusion_core.chunk import Array

MIN_UNITS = 10  # for a chart
LEVEL = "level"


@dataclass(frozen=True)
class StepChange:
    """A step of one quantity of one axis.

    Attributes
    ----------
    at, low, high : int
        Place in the line of the first unit after it, and the 95 % interval of that.
    before, after : float
        Usual value (SI) in the stretches on either side of it.
    error : float
        Deviation of the difference, in the chart's scale.
    p : float
        Probability of such a step anywhere in this chart by chance.
    of_lot : str
        The lot that is off, where the line begins or ends it there and is afterwards as before; else empty.
    """

    at: int
    low: int
    high: int
    before: float
    after: float
    error: float
    p: float
    of_lot: str = ""


@dataclass(frozen=True)
class Trend:
    """A quantity that rises or falls all along the line: usual value (SI) of its first and of its last unit."""

    before: float
    after: float


@dataclass(frozen=True, eq=False)
class ControlChart:
    """The control chart of one quantity of one axis; m units have it.

    Attributes
    ----------
    quantity, axis, unit : str
        One of FIGURES, or `level`; the unit is SI.
    at : (m,) int array
        Places of the units in the line.
    figures : callable
        Returns the values (m,), SI, and the deviations (m,) of their measurements in the scale, by the records.
    scale : ChartScale
        In which the limits lie alike above and below.
    basis : (start, stop)
        Places in the line of the units on which the limits stand, unless `of_family`.
    centre : float
        Middle of a line in control, SI.
    changes : tuple of StepChange
    lots : tuple of LotPoint
        In the order of their first units.
    law : InControl
        Of the values in the scale: the limits stand on it.
    trend : Trend or None
        Where a straight line fits better than steps; then there are no changes.
    rules : mapping of str to callable
        Run rules that were asked for, of `z`.
    phi : float
        Autocorrelation of neighbouring units about the line's course, 0 where it may be chance.
    frozen : FrozenLimits or None
        Of a family that was known, on which centre and limits then stand.
    """

    quantity: str
    axis: str
    unit: str
    at: NDArray[np.intp]
    figures: Callable[[], tuple[Array, Array]]
    scale: ChartScale
    basis: tuple[int, int]
    centre: float
    changes: tuple[StepChange, ...]
    lots: tuple[LotPoint, ...]
    law: InControl
    trend: Trend | None = None
    rules: Mapping[str, Callable[[Array], NDArray[np.bool_]]] = field(default_factory=dict)
    phi: float = 0.0
    frozen: FrozenLimits | None = None

    # what follows of the above is computed where it is asked for: of a million units it would be gigabytes

    @lru_cache(maxsize=1)  # noqa: B019  # of the chart that is worked on: its properties ask for them again and again
    def _figures(self) -> tuple[Array, Array]:
        return self.figures()

    @property
    def value(self) -> Array:
        """Values (m,), SI."""
        return self._figures()[0]

    @property
    def of_family(self) -> bool:
        """True if centre and limits are those of a family that was known."""
        return self.frozen is not None

    @property
    def sigma(self) -> Array:
        """Deviations (m,) in control, in the scale."""
        # no less than that of values that do not vary
        return np.maximum(self.law.sigma(self._figures()[1].astype(np.float32).astype(np.float64)), 1e-100)

    @property
    def z(self) -> Array:
        """Deviations (m,) from the centre, in sigmas."""
        z = (self.scale.to(self.value) - self.law.centre) / self.sigma
        return z if self.frozen is None else self.frozen.scores(z)

    @property
    def limits(self) -> tuple[Array, Array]:
        """Shewhart's limits (m,), SI."""
        three, sigma = np.full(len(self.at), SIGMAS), self.sigma
        return self._back(-three, sigma), self._back(three, sigma)

    @property
    def ewma(self) -> tuple[Array, Array, Array]:
        """The EWMA and its limits (m,), as values (SI) of a unit whose own deviation is the middle one."""
        reach, middle = ewma_limit(len(self.at)), float(np.median(self.sigma))
        w, low, high = (self._back(of, middle) for of in (ewma(self.z), -reach, reach))
        return w, low, high

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """Alarms (m,) of Shewhart's chart."""
        return np.abs(self.z) > SIGMAS

    @property
    def drifting(self) -> NDArray[np.bool_]:
        """Alarms (m,) of the EWMA."""
        return np.abs(ewma(self.z)) > ewma_limit(len(self.at))

    @property
    def patterns(self) -> dict[str, NDArray[np.bool_]]:
        """Alarms (m,) of the run rules that were asked for, by rule."""
        z = self.z
        return {rule: alarms(z) for rule, alarms in self.rules.items()}

    def _back(self, z: Array, sigma: Array | float) -> Array:
        """Return values (m,), SI, that deviate by z sigmas."""
        off = z if self.frozen is None else self.frozen.deviations(z)
        return self.scale.back(self.law.centre + sigma * off)

    @property
    def ranges(self) -> Array:
        """Moving ranges (m - 1,) of each unit and the one before it, in sigmas: D2 is usual, D4 the limit."""
        return np.abs(np.diff(self.z))

    def as_json(self, line: LineReport) -> dict[str, Any]:
        """Return limits, alarms, changes and lots as `fleet.json` has them; in SI, ranges in sigmas."""
        names, (low, high) = line.units, self.limits
        changes = [
            {
                "unit": names[step.at], "unit_95": [names[step.low], names[step.high]], "before": step.before,
                "after": step.after, "p": step.p, "lot": step.of_lot or None,
            }
            for step in self.changes
        ]  # fmt: skip
        return {
            "quantity": self.quantity, "axis": self.axis, "unit": self.unit, "units": len(self.at),
            "scale": self.scale.name, "frozen": self.of_family, "centre": self.centre,
            "low": float(np.median(low)), "high": float(np.median(high)), "beyond": int(np.sum(self.beyond)),
            "ewma_beyond": int(np.sum(self.drifting)),
            "moving_range": {"usual": D2, "limit": D4, "beyond": int(np.sum(self.ranges > D4))},
            "autocorrelation": self.phi, "changes": changes, "trend": None if self.trend is None else vars(self.trend),
            "lots": [lot.as_json() for lot in self.lots if lot.name],
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class TSquaredChart:
    """Chart of Hotelling's T-squared of the figures of one axis, against a frozen covariance; m units have it.

    Attributes
    ----------
    axis : str
    quantities : tuple of str
    at : (m,) int array
        Places of the units in the line.
    value, limit : (m,) arrays
        A unit without some of the quantities has a limit of its own.
    contributions : (m, p) array
        Of each quantity: by how much T-squared would be less without it; NaN where it is not known.
    """

    axis: str
    quantities: tuple[str, ...]
    at: NDArray[np.intp]
    value: Array
    limit: Array
    contributions: Array

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """Alarms (m,)."""
        return np.asarray(self.value > self.limit)


@dataclass(frozen=True)
class GroupDifference:
    """A figure of an axis that differs between the groups of a column.

    Attributes
    ----------
    quantity, axis, column : str
    p : float
        Probability of such a difference by chance.
    group : str
        The group that is furthest from the others.
    units : int
        Its units that were compared.
    value, others : float
        Middle of its units, and of those compared with them, SI; the two are as far apart as within blocks.
    """

    quantity: str
    axis: str
    column: str
    p: float
    group: str
    units: int
    value: float
    others: float

    def as_json(self, unit: str) -> dict[str, Any]:
        """Return it as `fleet.json` has it; `unit` is the quantity's, SI."""
        return {**vars(self), "unit": unit}


@dataclass(frozen=True, eq=False)
class LineReport:
    """A line, its units in the order in which they were made.

    Attributes
    ----------
    units, lots, dates : tuple of str
    domains : (n, 2) array
        Temperatures that each unit was soaked over, from and to, degC; NaN where not known.
    order : str
        Basis of the order, in a sentence.
    axes : tuple of str
    unit : BiasUnit
        Of the bias: in SI, and as it is shown.
    controls : tuple of ControlChart
    capability : tuple of Capability
    too_few : tuple of str
        Quantities without a chart because fewer than MIN_UNITS units have them.
    multivariate : tuple of TSquaredChart
    baseline : Baseline or None
        Frozen limits on which the charts stand.
    partial : tuple of int
        Places of units that were soaked over another range than most, or than that of the baseline: then neither swing
        nor prediction is charted.
    differences : tuple of GroupDifference
        Figures that differ between the groups of a column of the units' table.
    sentences : tuple of str
        Changes, the present state, and the limits, in words.
    """

    units: tuple[str, ...] = ()
    lots: tuple[str, ...] = ()
    dates: tuple[str, ...] = ()
    domains: Array = field(default_factory=lambda: np.zeros((0, 2)))
    order: str = ""
    axes: tuple[str, ...] = ()
    unit: BiasUnit = RATE
    controls: tuple[ControlChart, ...] = ()
    capability: tuple[Capability, ...] = ()
    too_few: tuple[str, ...] = ()
    multivariate: tuple[TSquaredChart, ...] = ()
    baseline: Baseline | None = None
    partial: tuple[int, ...] = ()
    differences: tuple[GroupDifference, ...] = ()
    sentences: tuple[str, ...] = ()

    def shown(self, quantity: str) -> BiasUnit:
        """Return the unit of a quantity."""
        per = PER.get(quantity, "")
        return BiasUnit(self.unit.si + per, self.unit.shown + per)


SIGMAS = 3.0
LAMBDA, L = 0.2, 2.962
MEDIAN_RANGE = 0.9539  # and their median: sqrt(2) times the third quartile of a normal value
D4 = 3.686  # deviations that a moving range may have: D4 d2 = 3.267 * 1.128
WITHIN = 0.9754  # mean of the moving ranges that are below D4 deviations, over that of all


@dataclass(frozen=True)
class InControl:
    """Law of a line in control.

    Attributes
    ----------
    centre : float
    spread : float
        s, the deviation between units without that of their measurement.
    share : float
        Factor of the own deviations: below 1 where they claim more than the values scatter.
    """

    centre: float
    spread: float
    share: float = 1.0

    def sigma(self, own: Array) -> Array:
        """Return the deviation (n,) of values measured with own deviations (n,)."""
        return np.asarray(np.hypot(self.spread, self.share * own))


def in_control(x: Array, own: Array) -> InControl:
    """Return centre and spread of values x (n,), at least two, with own deviations (n,), 0 where not known.

    Neither single odd values nor a shift among them count: the centre is an M-estimate, the spread of moving ranges of
    which those that no chart would let pass are left out.
    """
    low, high = 0.0, _short_term(x)
    if high == 0.0:
        return InControl(float(np.median(x)), 0.0)
    if not np.any(own):
        return InControl(_middle(x, np.full(len(x), high)), high)
    about = x - np.median(x)
    tight = _short_term(about / np.where(own > 0, own, np.median(own[own > 0])))
    if tight <= 1:  # the own deviations alone claim more than is there
        least = 1e-3 * high
        return InControl(_middle(x, np.hypot(least, tight * own)), least, tight)
    for _ in range(40):  # the more spread, the less do standardised values range: one root
        s = (low + high) / 2
        low, high = (s, high) if _short_term(about / np.hypot(s, own)) > 1 else (low, s)
    return InControl(_middle(x, np.hypot(s, own)), s)


def _short_term(x: Array) -> float:
    """Return the deviation from one unit to the next, by the mean of the moving ranges that are in control."""
    ranges = np.abs(np.diff(x))
    rough = float(np.median(ranges)) / MEDIAN_RANGE
    ranges = ranges[ranges <= D4 * rough] if rough > 0 else ranges
    return float(np.mean(ranges)) / (D2 * (WITHIN if rough > 0 else 1.0))


def _middle(x: Array, sigma: Array) -> float:
    """Return Huber's M-estimate of the mean of x (n,) with deviations (n,)."""
    return float(huber(np.ones((len(x), 1)), x, sigma, np.array([np.median(x)]))[0])


def huber(X: Array, x: Array, sigma: Array, start: Array) -> Array:
    """Return Huber's M-estimate of the coefficients (p,) of columns X (n, p) in x (n,) with deviations (n,)."""
    found = start
    for _ in range(20):
        w = np.sqrt(np.minimum(1.345 / np.maximum(np.abs(x - X @ found) / sigma, 1e-12), 1.0)) / sigma
        found = np.asarray(np.linalg.lstsq(X * w[:, None], x * w, rcond=None)[0], dtype=np.float64)
    return found


def ewma(z: Array, most: float = SIGMAS) -> Array:
    """Return the EWMA (..., n) of z (..., n), which counts to `most`.

    Values further out belong to Shewhart's chart; else one odd unit would hold the EWMA out of its limits for ten.
    Clipped at three, it alarms once in 530 units.
    """
    steps = LAMBDA * np.clip(z, -most, most)
    rows = steps.reshape(-1, steps.shape[-1]).tolist()
    return np.reshape([[*accumulate(row, lambda w, step: step + (1 - LAMBDA) * w)] for row in rows], steps.shape)


def ewma_limit(n: int) -> Array:
    """Return the limit (n,) of the EWMA about 0, which is less for the first units."""
    return np.asarray(L * np.sqrt(LAMBDA / (2 - LAMBDA) * (1 - (1 - LAMBDA) ** (2.0 * np.arange(1, n + 1)))))


@dataclass(frozen=True)
class ChartScale:
    """Scale of values.

    Attributes
    ----------
    name : str
        `log`, `sqrt` or `as it is`.
    """

    name: ScaleName

    def to(self, values: Array) -> Array:
        """Return values in this scale."""
        if self.name == "as it is":
            return np.asarray(values, dtype=np.float64)
        return np.log(values) if self.name == "log" else np.sqrt(np.maximum(values, 0.0))

    def back(self, x: Array) -> Array:
        """Return values (SI) of this scale."""
        if self.name == "as it is":
            return np.asarray(x)
        return np.exp(x) if self.name == "log" else np.maximum(x, 0.0) ** 2

    def sigma(self, values: Array, sigma: Array) -> Array:
        """Return deviations of values in this scale, 0 where they are not known."""
        known = np.where(np.isfinite(sigma), sigma, 0.0)
        if self.name == "as it is":
            return known
        if self.name == "log":
            return np.asarray(known / values)
        return np.asarray(0.5 * known / np.sqrt(np.maximum(np.maximum(values, known), 1e-300)))  # also of 0


def scale_of(values: Array, *, size: bool) -> ChartScale:
    """Return the scale of values (n,); `size`: they are positive by their nature, though some may show as 0."""
    if not size or np.any(values < 0):
        return ChartScale("as it is")
    some = [ChartScale("log")] if np.all(values > 0) else []
    some += [ChartScale("sqrt"), ChartScale("as it is")]
    lack = [1 - _straightness(scale.to(values)) for scale in some]
    best = int(np.argmin(lack))
    return some[best] if lack[best] < 0.5 * lack[0] and lack[0] > 0.005 else some[0]


def _straightness(x: Array) -> float:
    from scipy.special import ndtri

    n, core = len(x), np.sort(x[~far_out(x)])  # odd units say nothing of the law
    if np.ptp(core) == 0:
        return 0.0
    cut = (n - len(core)) // 2
    normal = ndtri((np.arange(cut, cut + len(core)) + 0.625) / (n + 0.25))
    return float(np.corrcoef(core, normal)[0, 1])


def far_out(x: Array) -> NDArray[np.bool_]:
    """Return True of the values (n,) beyond five robust deviations; of none where most are the same."""
    about = np.abs(x - np.median(x))
    reach = 5 * 1.4826 * np.median(about)
    return np.asarray((about > reach) & (reach > 0))
