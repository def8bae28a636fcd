"""Scale factor and misalignment over the units of a family: the law of the nine terms of M, as of the bias.

A term of a unit is a parabola through three values, at the ends and in the middle of the temperatures of the family's
stimuli. Their law over units is that of `driftlab.family.reml`, term by term, the units' own covariances taken off.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import numpy as np
from numpy.polynomial import chebyshev
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from driftlab.family.record import Covariances, TermParabolas, UnitRecord
from driftlab.family.reml import WEIGHT, fit_axis
from driftlab.triad.model import PARABOLA, TermPrior
from fusion_core.chunk import Array
from fusion_core.thermal.curve_error import Numbers
from fusion_core.thermal.map_file import expect_covariance

MIN_UNITS = 5  # of which a law is fitted
ENDS = np.array([-1.0, 0.0, 1.0])  # of a domain, where the values are
TERMS_OF_M = 9


class TermsLaw(BaseModel):
    """Law of the terms of M over units as `family.json` has it: values at the ends and in the middle of `T`, degC.

    Attributes
    ----------
    units : int
    mu, mu_covariance : (9, 3) and (9, 3, 3) arrays
        Mean of the units.
    Sigma : (9, 3, 3) array
        Covariance of the units about it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    T: tuple[FiniteFloat, FiniteFloat]
    units: Annotated[int, Field(ge=0)]
    mu: Numbers
    mu_covariance: Covariances
    Sigma: Covariances

    @model_validator(mode="after")
    def _is_a_law(self) -> TermsLaw:
        shape, low, high = (TERMS_OF_M, len(ENDS)), *self.T
        square = (*shape, len(ENDS))
        if low >= high or self.mu.shape != shape or {self.mu_covariance.shape, self.Sigma.shape} != {square}:
            raise ValueError("terms are not nine of three values over a range")
        expect_covariance("terms.Sigma", self.Sigma)
        expect_covariance("terms.mu_covariance", self.mu_covariance)
        return self

    def prior(self) -> TermPrior:
        """Return the law of the terms of one more unit: Student's, since so many units leave Sigma unsure."""
        B, freedom = np.linalg.inv(chebyshev.chebvander(ENDS, PARABOLA)), self.units + WEIGHT - PARABOLA
        covariance = self.Sigma * freedom / (freedom - 2) + self.mu_covariance
        return TermPrior(self.T, self.mu @ B.T, B @ covariance @ B.T)


def fit_terms(records: Iterable[UnitRecord]) -> TermsLaw | None:
    """Return the law of the terms of units; None of fewer than MIN_UNITS that have them over temperature."""
    units = [record.parabolas for record in records if record.parabolas is not None]
    if len(units) < MIN_UNITS:
        return None
    low, high = (float(np.median(ends)) for ends in zip(*(unit.T for unit in units), strict=True))
    peaks = (low + high) / 2 + (high - low) / 2 * ENDS
    J, h = zip(*(_information(unit, peaks) for unit in units), strict=True)
    lot = np.zeros(len(units), dtype=np.intp)
    terms = zip(np.stack(J, axis=1), np.stack(h, axis=1), strict=True)
    fits = [fit_axis([(*term, lot)], peaks) for term in terms]
    return TermsLaw(
        T=(low, high), units=len(units), mu=np.stack([fit.means.mu for fit in fits]),
        mu_covariance=np.stack([fit.means.covariance for fit in fits]),
        Sigma=np.stack([fit.law.Sigma for fit in fits]),
    )  # fmt: skip


def _information(unit: TermParabolas, T: Array) -> tuple[Array, Array]:
    """Return J (9, 3, 3) and h (9, 3) of a unit's terms at T (3,)."""
    low, high = unit.T
    B = chebyshev.chebvander((2 * T - low - high) / (high - low), PARABOLA)
    J = np.asarray(np.linalg.inv(B @ unit.covariance @ B.T), dtype=np.float64)
    return J, np.einsum("kij,kj->ki", J, unit.c @ B.T)
