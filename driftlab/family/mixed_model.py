"""The family of units of one type, c_i ~ N(mu + lot, Sigma) for each axis: fitted to its units, and its posteriors.

Sigma and the spread of the lots are those of `driftlab.family.reml`, of all units or of a seeded sample of SAMPLE of
them; mu and the lots' shifts are of all units under these, one unit at a time. A unit that saw part of the range has no
information on the rest: its posterior there is that of a unit like it. d axes, q coefficients, G lots.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationInfo,
    field_serializer,
    model_validator,
)

from driftlab import __version__
from driftlab.family.bands import Bands
from driftlab.family.baseline import Baseline
from driftlab.family.basis import SplineBasis
from driftlab.family.partitions import SIZE, FamilyUnits, Partition, Partitions, UnitOfLot, added, in_partitions, tree
from driftlab.family.record import LOT_DIGITS, Covariances, RoundedCovariances
from driftlab.family.reml import (
    ByLot,
    Means,
    OfAxes,
    RemlFit,
    VarianceComponents,
    fit_axis,
    inverse,
    means_of,
    outlier_weights,
    root_of,
)
from driftlab.family.tail_law import TailLaws
from driftlab.family.terms import TermsLaw
from driftlab.family.unit_information import UnitInformation
from fusion_core.chunk import Array, Integers
from fusion_core.thermal.curve_error import Numbers
from fusion_core.thermal.fitted_map import COLDEST, HOTTEST
from fusion_core.thermal.map_file import expect_covariance
from fusion_core.thermal.record_texts import AxisNames, Name, Plain, SiUnit, check_tree

FROM_FILE = "file"  # context of validation: a family that this process has not fitted

Count = Annotated[int, Field(ge=0, le=10**12)]
Share = Annotated[float, Field(ge=0, le=1e30)]

SAMPLE = 1500  # units that Sigma is of, where there are more
MIN_UNITS = 3  # that saw a temperature, for it to be in the family's domain
ENTERED = 0.199  # of an interval of the knots, for a unit to have seen it
MIN_SHARE = 0.02  # of all units, likewise


def fit_family(units: FamilyUnits, *, channel: str = "gyro", bias_unit: str = "rad/s", seed: int = 0) -> Family:
    """Return the family of units.

    Parameters
    ----------
    units : FamilyUnits
    channel, bias_unit : str
        Whose bias, and its SI unit.
    seed : int
        Of the sample of SAMPLE units that Sigma is of, where there are more.

    Raises
    ------
    ValueError
        If there are fewer than MIN_UNITS units, they differ in axes or in the step of their knots, or no temperature
        was seen by MIN_UNITS of them.
    """
    units = in_partitions(units)
    knots, axes, lots, lot, seen = _survey(units)
    n = len(units)
    chosen = np.arange(n)
    if n > SAMPLE:
        chosen = np.sort(np.random.default_rng(seed).choice(n, SAMPLE, replace=False))
    present, own = np.unique(lot[chosen], return_inverse=True)
    sample = stacked(units if n <= SAMPLE else units.chosen(chosen), knots)
    fits = [*sample.engine(partial(_fit_of, sample.parts, slice(None), own, knots.peaks), range(len(axes)))]
    means = _means_of_all(units, knots, fits, present, lot) if n > SAMPLE else [fit.means for fit in fits]
    w = np.stack([fit.w for fit in fits], axis=1)
    low = np.flatnonzero(np.any(w < 0.5, axis=1))
    names = [soaked.unit for soaked, _ in units.chosen(chosen[low]).read()]
    return Family(
        channel=channel, bias_unit=bias_unit, axes=axes, first=knots.first, intervals=knots.intervals,
        step=knots.step, seen=seen, units=n, sampled=len(chosen), **_laws(fits, means, lots),
        weights={name: w[k].tolist() for name, k in zip(names, low, strict=True)},
    )  # fmt: skip


def fit_some(family: Family, sample: Partitions[OfAxes], lots: Sequence[str], some: Integers) -> Family:
    """Return the family of `some` of its units, by their places in a `sample`, which are of these `lots`.

    Its knots are kept, and EM begins with its law.
    """
    n, counts = len(some), Counter(lots[k] for k in some)
    numbers, laws = numbered(counts, n), map(VarianceComponents, family.Sigma, family.Lambda)
    held = [part.read() for part in sample.parts]  # once for all axes
    fit = partial(_fit_of, held, some, np.array([numbers[lots[k]] for k in some]), family.knots.peaks)
    fits = [fit(axis, law) for axis, law in enumerate(laws)]
    laws_of_some = _laws(fits, [fit.means for fit in fits], {name: (k, counts[name]) for name, k in numbers.items()})
    return family.model_copy(update={"units": n, "sampled": n, **laws_of_some})


def _laws(fits: Sequence[RemlFit], means: Sequence[Means], lots: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
    """Return the laws of a family by its attributes; of each lot its number and its units."""
    return {
        "mu": np.stack([m.mu for m in means]), "mu_covariance": _symmetric([m.covariance for m in means]),
        "Sigma": np.stack([fit.law.Sigma for fit in fits]), "Lambda": _symmetric([fit.law.Lambda for fit in fits]),
        "lots": _lots(lots, means), "steps": [fit.steps for fit in fits], "moved": [fit.moved for fit in fits],
    }  # fmt: skip


def _survey(
    units: Partitions[Sequence[UnitOfLot]],
) -> tuple[SplineBasis, tuple[str, ...], dict[str, tuple[int, int]], Integers, tuple[float, float]]:
    """Return the knots over the temperatures that enough units saw, and the axes.

    And of each lot its number and its units; each unit's lot by number (n,); and these temperatures' ends, degC.

    Raises
    ------
    ValueError
        As `fit_family`.
    """
    if len(units) < MIN_UNITS:
        raise ValueError(f"{len(units)} units to learn from; at least {MIN_UNITS} are needed to know how units differ")
    first = next(units.read())[0]
    axes, step = first.axes, first.knots.step
    spans, places, columns, ranges = Counter[tuple[int, int]](), dict[str, int](), [], []
    for own, lots, temperatures in units.map(partial(_spans, axes, step)):
        spans.update(own)
        ranges.append(temperatures)
        columns.append(np.array([places.setdefault(lot, len(places)) for lot in lots]))
    numbers = numbered(places, len(units))
    lot = np.array([numbers[name] for name in places])[np.concatenate(columns)]
    counts = np.bincount(np.concatenate(columns))
    lowest = min(low for low, _ in spans)
    seen = np.zeros(max(sum(span) for span in spans) - lowest, dtype=int)
    for (low, intervals), count in spans.items():
        seen[low - lowest : low - lowest + intervals] += count
    least = max(MIN_UNITS, MIN_SHARE * len(units))
    enough = np.flatnonzero(seen >= least)
    if len(enough) == 0:
        raise ValueError(
            f"no temperature was seen by {int(np.ceil(least))} of {len(units)} units; soak the units of a family over "
            "one range"
        )
    knots = SplineBasis(lowest + int(enough[0]), int(enough[-1] - enough[0]) + 1, step)
    lowest_first, highest_last = np.sort(np.concatenate(ranges), axis=0).T
    enough_units = int(np.ceil(least))
    seen_by_enough = float(lowest_first[enough_units - 1]), float(highest_last[-enough_units])
    return knots, axes, {name: (numbers[name], int(counts[places[name]])) for name in numbers}, lot, seen_by_enough


def _spans(
    axes: tuple[str, ...], step: float, units: Sequence[UnitOfLot]
) -> tuple[Counter[tuple[int, int]], list[str], Array]:
    """Return the number of units that saw each range of knots, by its first and its intervals, and each unit's lot.

    And the lowest and highest temperature (n, 2) of each.
    An interval was seen that a unit went through by ENTERED: with less, the curve beyond is anything.
    """
    spans, lots = Counter[tuple[int, int]](), []
    for soaked, lot in units:
        if soaked.axes != axes or soaked.knots.step != step:
            raise ValueError(
                f"unit {soaked.unit} has axes {', '.join(soaked.axes)} and knots {soaked.knots.step} K apart, others "
                f"{', '.join(axes)} and {step} K; a family is of one type of unit, soaked alike"
            )
        spans[_seen(soaked)] += 1
        lots.append(lot)
    return spans, lots, np.array([soaked.seen for soaked, _ in units])


def _seen(soaked: UnitInformation) -> tuple[int, int]:
    """Return the first knot and the number of intervals that a unit saw; of less than one, what it was in."""
    knots = soaked.knots
    low, high = (T / knots.step for T in soaked.seen)
    low, high = int(np.ceil(low - 1 + ENTERED)), int(np.floor(high + 1 - ENTERED))
    return (low, high - low) if low < high else (knots.first, knots.intervals)


def numbered(lots: Iterable[str], units: int) -> dict[str, int]:
    """Return a number for each lot; 0 for all where every unit has one of its own, which tells nothing of lots."""
    names = sorted(lots)
    return dict.fromkeys(names, 0) if len(names) == units else {name: k for k, name in enumerate(names)}


def stacked(units: Partitions[Sequence[UnitOfLot]], knots: SplineBasis) -> Partitions[OfAxes]:
    """Return the information of units on knots, which stays where it was made."""
    return units.keep("stacked", partial(_stacked, knots))


def _stacked(knots: SplineBasis, units: Sequence[UnitOfLot]) -> OfAxes:
    J, h = zip(*(marginalised(soaked, knots) for soaked, _ in units), strict=True)
    return OfAxes(np.stack(J), np.stack(h))


def _fit_of(
    sample: Sequence[Partition[OfAxes] | OfAxes], some: Integers | slice, lot: Integers, peaks: Array, axis: int,
    law: VarianceComponents | None = None,
) -> RemlFit:  # fmt: skip
    """Return the fit of an axis of `some` of a sample, of lots `lot` (n,), from a law on, in parts of SIZE units."""
    read = (part if isinstance(part, OfAxes) else part.read() for part in sample)
    contents = ((own.J[:, axis].copy(), own.h[:, axis]) for own in read)
    J, h = (np.concatenate(part)[some] for part in zip(*contents, strict=True))
    cuts = [slice(k, k + SIZE) for k in range(0, len(lot), SIZE)]
    return fit_axis([(J[cut], h[cut], lot[cut]) for cut in cuts], peaks, law)


def _means_of_all(
    units: Partitions[Sequence[UnitOfLot]], knots: SplineBasis, fits: list[RemlFit], present: Integers, lot: Integers
) -> list[Means]:
    """Return the means of all units, numbered by `lot`, of which the fits are a sample with the lots `present`."""
    d, q, G = len(fits), knots.q, int(lot.max()) + 1
    L, inverse, spread = (np.stack(part) for part in zip(*(fit.law.root() for fit in fits), strict=True))
    centres = np.repeat(np.stack([fit.means.mu for fit in fits])[None], G, axis=0)
    centres[present] += np.stack([fit.means.shifts for fit in fits], axis=1)
    of_lots = partial(_of_their_lots, knots, L, np.array([fit.limit for fit in fits]))
    information, weighted = np.zeros((d, G, q, q)), np.zeros((d, G, q))
    at_centres = np.einsum("dij,gdj->gdi", inverse, centres)
    for g, (own_information, own_weighted) in tree(units.map(of_lots, lot, ByLot(at_centres, lot))).items():
        information[:, g], weighted[:, g] = own_information, own_weighted
    return [means_of(*own).turned(L[k]) for k, own in enumerate(zip(information, weighted, spread, strict=True))]


def _of_their_lots(
    knots: SplineBasis, L: Array, limits: Array, units: Sequence[UnitOfLot], lot: Integers, centres: Mapping[int, Array]
) -> dict[int, tuple[Array, Array]]:
    """Return the information of units on the means of their lots, and that times their values, by lot.

    (d, q, q) and (d, q), in the coordinates L.

    Weighted by their distances from `centres` (d, q), which are in those coordinates.
    """
    one, back = np.eye(knots.q), L.transpose(0, 2, 1)
    sums: dict[int, tuple[Array, Array]] = {}
    for (soaked, _), g in zip(units, lot.tolist(), strict=True):
        J, h = marginalised(soaked, knots)
        A, a = back @ J @ L, back @ h[..., None]
        K = one - inverse(A + one)
        z = (a - K @ (a + centres[g][..., None]))[..., 0]
        w = outlier_weights(np.sum(z**2, axis=1) / np.trace(K, axis1=1, axis2=2), limits)[:, None, None]
        V = inverse(A + w * one)
        own = w * (one - w * V), (w * V @ a)[..., 0]
        sums[g] = added(sums[g], own) if g in sums else own
    return sums


def _lots(lots: Mapping[str, tuple[int, int]], means: Sequence[Means]) -> dict[str, LotEffect]:
    """Return the effects of the lots that have a name, or of the only one; of each its number and its units."""
    if len({number for number, _ in lots.values()}) < len(lots):
        return {}
    return {
        name: LotEffect(
            units=count, shift=np.stack([m.shifts[g] for m in means]),
            sigma=np.sqrt(np.stack([np.diag(m.shifts_covariance[g]) for m in means])),
            mean_covariance=_symmetric([m.of_lot[g] for m in means]),
        )
        for name, (g, count) in lots.items() if name or len(lots) == 1
    }  # fmt: skip


def _symmetric(matrices: Sequence[Array]) -> Array:
    """Return matrices (d, q, q) without what rounding made of their symmetry."""
    stacked = np.stack(matrices)
    return (stacked + stacked.transpose(0, 2, 1)) / 2


@dataclass(frozen=True, eq=False)
class Posterior:
    """Coefficients `c` (d, q) of a unit and their `covariance` (d, q, q), on the family's knots."""

    c: Array
    covariance: Array

    @cached_property
    def root(self) -> tuple[Array, Array]:
        """L (d, q, q) with the covariance L L', and its inverse."""
        return _root_of(self.covariance.tobytes(), *self.covariance.shape)

    def informed(self, J: Array, h: Array) -> Posterior:
        """Return the law of a unit of this one when its soak has J (d, q, q) and h (d, q)."""
        L, back = self.root[0], self.root[0].transpose(0, 2, 1)
        V = inverse(np.eye(L.shape[2]) + back @ J @ L)
        a = back @ (h[..., None] - J @ self.c[..., None])
        return Posterior(self.c + (L @ (V @ a))[..., 0], L @ V @ back)

    def distance(self, J: Array, h: Array) -> Array:
        """Return the distance (d,) from this law of a unit whose soak has J (d, q, q) and h (d, q), noise included.

        The mean square of the coefficients in the directions on which the soak has more information than the law; 1 is
        expected of a Gaussian one.
        """
        part = np.flatnonzero(np.any(J, axis=(0, 1)))
        J, h = J[:, part][:, :, part], h[:, part]
        L, _ = _root_of(self.covariance[:, part][:, :, part].tobytes(), *J.shape)
        back = L.transpose(0, 2, 1)
        gain, U = np.linalg.eigh(back @ J @ L)
        a = (U.transpose(0, 2, 1) @ (back @ (h[..., None] - J @ self.c[:, part, None])))[..., 0]
        seen = gain > 1.0
        squares = np.where(seen, a**2 / np.where(seen, gain + gain**2, 1.0), 0.0).sum(axis=1)
        count = seen.sum(axis=1)
        return np.where(count > 0, squares / np.maximum(count, 1), 1.0)


@lru_cache(maxsize=64)
def _root_of(covariance: bytes, *shape: int) -> tuple[Array, Array]:
    """Return the root of a covariance and its inverse, once of what many units have in common: it takes long."""
    return root_of(np.frombuffer(covariance).reshape(shape))


class LotEffect(BaseModel):
    """Deviation of the mean of a lot from the family's: `shift` (d, q), its `sigma`, and the number of its units.

    `mean_covariance` (d, q, q) is that of the family's mean and the shift together.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: Count
    shift: Numbers
    sigma: Numbers
    mean_covariance: RoundedCovariances


class Family(BaseModel):
    """The family as `family.json` has it: of a symmetric matrix the upper triangle, row by row; all in SI.

    Attributes
    ----------
    channel, bias_unit : str
        Whose bias, and its SI unit.
    axes : tuple of str
    seen : (low, high)
        Temperatures that enough units entered, degC; None: the knots' domain.
    first, intervals, step : int, int, float
        Of the knots, over the temperatures that enough of the units saw: `first` times `step` is the lower end, degC.
    units, sampled : int
        Number of the units, and of those that Sigma is of.
    mu, mu_covariance : (d, q) and (d, q, q) arrays
        Mean; `mu_sigma` in the file are its deviations.
    Sigma, Lambda : (d, q, q) arrays
        Covariance of units about their lot's mean, and of the lots' means about the family's.
    lots : dict of str to LotEffect
    weights : dict of str to (d,)
        Of the units that were weighted down in Sigma and mu.
    steps, moved : (d,)
        Of EM, and by what share of the units' deviations Sigma or Lambda changed in the last.
    map_kind, config : str
        Kind of the units' own maps, and the config (YAML).
    bands : Bands or None
        Widths of the bands, as measured on units left out (`driftlab.family.bands`).
    common_effects : dict or None
        Effects that the units share (`driftlab.family.shared_effects`), in whose presence mu and Sigma are.
    odd_lots : tuple of str
        Why lots are off the others as a whole, a sentence each.
    laws : TailLaws or None
        Laws of the units' curves and figures, by which a new one is judged (`driftlab.family.outliers`).
    baseline : Baseline or None
        Limits of the line's control charts, by which units of later days are judged.
    terms : TermsLaw or None
        Law of scale factors and misalignments, of units with a stimulus.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    driftlab: Plain = __version__
    channel: Name
    bias_unit: SiUnit
    axes: Annotated[AxisNames, Field(min_length=1)]
    first: int
    intervals: int
    step: FiniteFloat
    seen: tuple[FiniteFloat, FiniteFloat] | None = None
    units: Count
    sampled: Count
    mu: Numbers
    mu_sigma: Any = None
    mu_covariance: Covariances
    Sigma: Covariances
    Lambda: Covariances
    lots: dict[Plain, LotEffect]
    weights: dict[Plain, tuple[Share, ...]] = {}
    steps: tuple[Count, ...] = ()
    moved: Numbers = Field(default_factory=lambda: np.zeros(0))
    map_kind: Plain = ""
    config: str = ""
    bands: Bands | None = None
    common_effects: Annotated[dict[str, Any], AfterValidator(check_tree)] | None = None
    odd_lots: tuple[Plain, ...] = ()
    laws: TailLaws | None = None
    baseline: Baseline | None = None
    terms: TermsLaw | None = None

    @model_validator(mode="after")
    def _shapes(self) -> Family:
        if self.intervals < 1 or self.step <= 0:
            raise ValueError("knots have no width")
        if not COLDEST <= self.first * self.step < (self.first + self.intervals) * self.step <= HOTTEST:
            raise ValueError(f"its knots are beyond {COLDEST:g} to {HOTTEST:g} °C")
        d, q, lots = len(self.axes), self.knots.q, self.lots.values()
        vectors = [self.mu, *(part for lot in lots for part in (lot.shift, lot.sigma))]
        matrices = [self.mu_covariance, self.Sigma, self.Lambda, *(lot.mean_covariance for lot in lots)]
        if any(part.shape != (d, q) for part in vectors) or any(part.shape != (d, q, q) for part in matrices):
            raise ValueError(f"what it has does not fit {d} axes of {q} coefficients")
        return self

    @model_validator(mode="after")
    def _covariances(self, info: ValidationInfo) -> Family:
        """Check those of a file; a fit of few units may have rounded one below zero in some direction."""
        if info.context != FROM_FILE:
            return self
        if np.linalg.eigvalsh(self.Sigma).min() <= 0:
            raise ValueError("Sigma is no covariance")
        expect_covariance("mu_covariance", self.mu_covariance)
        expect_covariance("Lambda", self.Lambda)
        for lot in self.lots.values():
            expect_covariance("mean_covariance", lot.mean_covariance, 1e3 * 10.0**-LOT_DIGITS)
        return self

    @field_serializer("mu_sigma")
    def _deviations_of_mu(self, _: Any) -> Any:
        return np.sqrt(np.diagonal(self.mu_covariance, axis1=1, axis2=2)).tolist()

    @property
    def knots(self) -> SplineBasis:
        """Over the family's domain."""
        return SplineBasis(self.first, self.intervals, self.step)

    def marginal(self, lot: str = "") -> Posterior:
        """Return the law of a new unit before it is soaked: of a lot of the family, or of an unknown one."""
        if lot in self.lots:
            own = self.lots[lot]
            return Posterior(self.mu + own.shift, self.Sigma + own.mean_covariance)
        return Posterior(self.mu, self.Sigma + self.Lambda + self.mu_covariance)

    def posterior(self, soaked: UnitInformation | None, lot: str = "") -> Posterior:
        """Return the law of a unit of a lot, by the family and by its own soak.

        The unit is taken as a new one: of a unit that the family was fitted on, its own data count in mu once more,
        with a weight of one unit of all.

        Raises
        ------
        ValueError
            If the soak's axes or knots are not the family's.
        """
        before = self.marginal(lot)
        if soaked is None:
            return before
        return before.informed(*self.information_of(soaked))

    def information_of(self, soaked: UnitInformation) -> tuple[Array, Array]:
        """Return J (d, q, q) and h (d, q) of a soak on the family's knots.

        Raises
        ------
        ValueError
            If its axes or the step of its knots are not the family's.
        """
        if soaked.axes != self.axes or soaked.knots.step != self.knots.step:
            raise ValueError(
                f"unit {soaked.unit} has axes {', '.join(soaked.axes)} and knots {soaked.knots.step} K apart, the "
                f"family {', '.join(self.axes)} and {self.knots.step} K; soak units of one family alike"
            )
        return marginalised(soaked, self.knots)


def marginalised(soaked: UnitInformation, knots: SplineBasis) -> tuple[Array, Array]:
    """Return J (d, q, q) and h (d, q) of a soak on other knots, the temperatures beyond them marginalised."""
    wide = soaked.knots.joined(knots)
    J, h = soaked.on(wide)
    if wide == knots:
        return J, h
    keep, seen = knots.within(wide), np.any(np.diagonal(J, axis1=1, axis2=2) > 0, axis=0)
    seen[keep] = False
    beyond = np.flatnonzero(seen)
    Jk, hk = J[:, keep, keep], h[:, keep]
    if len(beyond) == 0:
        return Jk, hk
    across, inner = J[:, keep][:, :, beyond], J[:, beyond][:, :, beyond]
    inner = inner + 1e-9 * np.max(np.diagonal(inner, axis1=1, axis2=2), axis=1)[:, None, None] * np.eye(len(beyond))
    taken = across @ np.linalg.inv(inner)
    rest = Jk - taken @ across.transpose(0, 2, 1)
    return (rest + rest.transpose(0, 2, 1)) / 2, hk - np.einsum("dij,dj->di", taken, h[:, beyond])
