"""The map of a unit of which a part was soaked: its own data and its family, as a map's file.

The curve is the posterior's mean, its error the posterior's covariance in a few modes, as wide as was measured on units
that were left out (`driftlab.family.bands`). The level is part of it: the family says where levels lie, the soak where
this one does; a prediction takes differences of the modes, in which a level cancels. d axes, q coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.family.band_calibration import PASSES
from driftlab.family.bands import LEVELS, Band, deviation
from driftlab.family.record import UnitRecord
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import Densities, densities_of
from fusion_core.chunk import Array
from fusion_core.contracts import CurveError, FittedMap, MapRecord, ThermalMap
from fusion_core.host.registry import registry
from fusion_core.thermal.curve_error import modes_of_axes, six_digits
from fusion_core.thermal.record_texts import recorded

if TYPE_CHECKING:
    from driftlab.family.mixed_model import Family, Posterior

KIND = "spline"
GRID = 1  # temperatures an interval, at which the error is kept
WIDER = 1.2  # times the family's walk, from which one that does not show is taken for the family's
SPREAD = 0.1  # least of a family's spread of noise, logarithm
CURVE = 4  # temperatures an interval, at which the curve is taken
ROUNDING = 1e-5  # of the largest deviation, or of a variance
LOST = 0.05  # of the variance at any temperature, with the modes that are left out


@dataclass(frozen=True, eq=False)
class UnitPosterior:
    """Posterior of a unit by its own soak and its family.

    Attributes
    ----------
    family : Family
    soaked : UnitInformation
    lot : str
    posterior : Posterior
    band : Band
    """

    family: Family
    soaked: UnitInformation
    lot: str
    posterior: Posterior
    band: Band

    @cached_property
    def T(self) -> Array:
        """Temperatures (N,) over the family's domain, degC."""
        return self.family.knots.grid(CURVE)[0]

    @cached_property
    def sigma(self) -> Array:
        """Deviation (N, d) of the posterior map."""
        return self.sigma_at(self.T)

    def sigma_at(self, T: Array) -> Array:
        """Return the deviation (N, d) of the posterior map at T (N,): within 1.96 of it lie 95 of 100 units."""
        knots = self.family.knots
        return deviation(knots.values(T), self.posterior.covariance) * self.band.factor(T, knots.step)

    @cached_property
    def before(self) -> Array:
        """Deviation (N, d) of a unit that was not soaked from the mean of its family."""
        return deviation(self.family.knots.grid(CURVE)[1], self.family.marginal(self.lot).covariance)

    @property
    def hours(self) -> float:
        """Of its soak."""
        return float(sum(rows.span.sum() for rows in self.soaked.recordings)) / 3600

    @property
    def inside(self) -> NDArray[np.bool_]:
        """True where T (N,) was soaked."""
        return (self.band.low <= self.T) & (self.band.high >= self.T)

    @cached_property
    def far(self) -> Array | None:
        """Distance (d,) of the unit from its family over that of one unit in a hundred; None where not measured."""
        if self.band.far is None:
            return None
        before = self.family.marginal(self.lot)
        return before.distance(*self.family.information_of(self.soaked)) / self.band.far

    def map(self, provenance: Mapping[str, str]) -> FittedMap:
        """Return the posterior map over the family's domain, its error with how errors at two temperatures go together.

        Straight on over what units entered beyond, as readings of a thermometer scatter about the ends of a soak.

        `provenance` says of its making, for the record.
        """
        family, knots = self.family, self.family.knots
        record = MapRecord(
            kind=KIND, domain=knots.domain, channel=family.channel, unit=family.bias_unit, axes=family.axes,
            residual=self._residual(), samples=self.soaked.count, error=self._error(), provenance=recorded(provenance),
        )  # fmt: skip
        settings, (T, B) = _settings(knots.step), knots.grid(CURVE)
        fitted = settings.from_curve(T, B @ self.posterior.c.T, record)
        return settings.over(fitted, family.seen or knots.domain)

    def _residual(self) -> tuple[float, ...]:
        """Return the rms (d,) of the residual of the map on the unit's own rows."""
        values, c = self.family.knots.values, self.posterior.c
        left = [rows.bias - values(rows.T) @ c.T for rows in self.soaked.recordings]
        return tuple(np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0)).tolist())

    def _error(self) -> CurveError:
        knots = self.family.knots
        T, B = knots.grid(GRID)
        factor = self.band.factor(T, knots.step)
        per_axis = [_modes(B, C) * own for C, own in zip(self.posterior.covariance, factor.T, strict=True)]
        modes = modes_of_axes(per_axis)
        curve = B @ self.posterior.c.T
        second = np.diff(curve, n=2, axis=0) / (T[1] - T[0]) ** 2
        bend = np.maximum(np.sqrt(np.mean(second**2, axis=0)), 8 * np.ptp(curve, axis=0) / (T[-1] - T[0]) ** 2)
        return CurveError(T=tuple(T.tolist()), modes=six_digits(modes), bend=tuple(bend.tolist()))


def posterior_of(family: Family, soaked: UnitInformation, lot: str = "") -> UnitPosterior:
    """Return the posterior of a unit of a lot that was soaked; a lot that is not the family's is an unknown one."""
    T = np.concatenate([rows.T for rows in soaked.recordings])
    low, high, bands = float(T.min()), float(T.max()), family.bands
    ones = np.ones((len(LEVELS), len(family.axes)))  # of a family that nothing is measured on
    band = Band(low, high, ones) if bands is None else bands.band(family.knots.domain, (low, high))
    return UnitPosterior(family, soaked, lot, family.posterior(soaked, lot), band)


def unit_posterior(family: Family, soaked: UnitInformation, lot: str = "") -> UnitPosterior:
    """Return the posterior of a unit, its noise pooled with the family's."""
    return posterior_of(family, with_pooled_noise(soaked, family), lot)


def with_pooled_noise(soaked: UnitInformation, family: Family, own: Densities | None = None) -> UnitInformation:
    """Return the unit's information, its noise pooled with the family's.

    A soak that is short, or goes one way, hardly separates a walk from the curve, and the likely size of one that does
    not show is mostly the largest that is not excluded. The logarithms of both densities are those of the unit and
    those of the family's units, each with the weight of its variance. `own` are the unit's, where they are known.
    """
    if family.bands is None:
        return soaked
    noise = family.bands.noise
    own = densities_of(soaked.recordings, soaked.knots.step) if own is None else own
    white = _pooled(own.white, own.white_sigma, noise.white, noise.white_spread)
    walk = _pooled(own.walk, own.walk_sigma, noise.walk, noise.walk_spread)
    return soaked.with_noise(white, walk)


def informed_where_unknown(soaked: UnitInformation, family: Family, record: UnitRecord) -> UnitInformation:
    """Return the unit's information, its noise pooled with the family's where its walk does not show.

    Where it does, or repeated sweeps need a larger one, it stays as it is.
    """
    if family.bands is None:
        return soaked
    (white, walk), (white_sigma, walk_sigma) = own = record.table(("noise", "walk"), len(family.axes))
    hidden = (walk <= 0) & (soaked.walk < PASSES * walk_sigma)
    if not np.all(np.isfinite(own)) or not np.any(hidden & (soaked.walk > WIDER * np.array(family.bands.noise.walk))):
        return soaked
    pooled = with_pooled_noise(soaked, family, Densities(white, white_sigma, walk, walk_sigma, soaked.walk))
    return soaked.with_noise(soaked.white, np.where(hidden, pooled.walk, soaked.walk))


def _pooled(value: Array, sigma: Array, typical: Sequence[float], spread: Sequence[float]) -> Array:
    """Return densities (d,) from those of a unit with their deviation, and the family's with that of the logarithm."""
    family, apart = np.asarray(typical), np.maximum(np.asarray(spread), SPREAD) ** 2
    shows = value > 0
    own = np.where(shows, value, family)
    error = np.where(shows, (sigma / own) ** 2, np.inf)
    weight = apart / (apart + error)
    return np.asarray(np.exp(weight * np.log(own) + (1 - weight) * np.log(family)))


@lru_cache(maxsize=4)
def _settings(step: float) -> ThermalMap:
    """Return the kind of map, once a process: reading units takes longer than the map."""
    settings = registry().classes(ThermalMap)[KIND].model_validate({"kind": KIND, "interval": f"{step} K"})
    assert isinstance(settings, ThermalMap)
    return settings


def _modes(B: Array, C: Array) -> Array:
    """Return the modes (r, G) of B C B': the one of the surest temperature, and of the rest as few as suffice.

    The first is the level of the soaked range, as far as it is not known. Of the rest all but LOST of the variance at
    each temperature is covered, in units of each temperature's own deviation: the soaked range is a hundred times surer
    than the rest, and would be lost among modes that are largest over all. The variance left out is made up for.
    """
    values, vectors = np.linalg.eigh(C)
    root = B @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    tiny = np.finfo(float).tiny
    level = root[int(np.argmin(np.linalg.norm(root, axis=1)))]
    level = level / max(float(np.linalg.norm(level)), tiny)
    first = root @ level
    rest = root - np.outer(first, level)
    size = np.linalg.norm(rest, axis=1)
    size = np.maximum(size, max(ROUNDING * float(size.max()), tiny))
    U, s, _ = np.linalg.svd(rest / size[:, None], full_matrices=False)
    modes = U * s
    held = np.cumsum(modes**2, axis=1)
    r = 1 + int(np.argmax(np.all(held >= (1 - LOST) * held[:, -1:] - ROUNDING, axis=0)))
    whole = np.sqrt(held[:, -1:] / np.maximum(held[:, r - 1 : r], tiny))
    return np.vstack([first, (modes[:, :r] * whole * size[:, None]).T])
