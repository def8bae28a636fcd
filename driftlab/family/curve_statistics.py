"""How far the curves of a unit are from its family's, in the law of the other units, and along which shapes.

With r the unit's own coefficients less its lot's mean, and Q the inverse of their covariance, family's and own::

    T^2 = z'z / tr K,   z = L' Q r,  K = 1 - M^-1 = L' Q L       over all shapes, by what the soak says of each
    t_g = g'Q r / sqrt(g'Q g)                                     along a shape g of which there may be more or less

with Sigma = L L' and M of `driftlab.family.reml`. Shapes are a level, a scale (g the mean curve), bumps of four
widths at all temperatures of which the soak says something (the logarithm of the largest |t| counts). Of a unit that
the family was fitted on, its own part in Sigma is taken out (Sherman and Morrison), of weight w among N::

    t_-g = t_g / sqrt((1 - h) (1 - h + w t_g^2 / N)),    h = w z'z / N

d axes, q coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from driftlab.family.mixed_model import Family
from driftlab.family.reml import WEIGHT, VarianceComponents
from driftlab.family.unit_information import UnitInformation
from fusion_core.chunk import Array

KNOWN = 1e-2  # of the family's variance: a soak that says less of an axis says nothing
WIDTHS = (1.5, 2.2, 3.2, 5.0)  # of bumps, in steps of the knots
SEEN = 1e-6  # of what a soak says of a bump where it says most: of one that it says less of, it says nothing
MOST = 0.9  # of Sigma, that a unit may have been


@dataclass(frozen=True, eq=False)
class CurveDeviation:
    """The coefficients of an axis less its lot's mean: z (q,), K (q, q), and what the data of the unit are h (q,) of.

    `w` is the unit's weight in Sigma over the sum of all, 0 of a new unit.
    """

    z: Array
    K: Array
    w: float

    @cached_property
    def h(self) -> float:
        """What of Sigma is the unit's own."""
        return min(self.w * float(self.z @ self.z), MOST)

    def squared(self) -> float:
        """Return the squared distance as a Gaussian deviation (Wilson and Hilferty), NaN where nothing is known."""
        known = float(np.trace(self.K))
        if known < KNOWN:
            return np.nan
        dof = known**2 / float(np.sum(self.K * self.K))
        share = float(self.z @ self.z) / known * (1 - self.w) / (1 - self.h)
        return float((np.cbrt(share) - 1 + 2 / (9 * dof)) / np.sqrt(2 / (9 * dof)))

    def apart(self, t: Array) -> Array:
        """Return t with the unit's own part taken out of Sigma."""
        return np.asarray(t / np.sqrt((1 - self.h) * (1 - self.h + self.w * t**2)))


@dataclass(frozen=True, eq=False)
class DeviationShapes:
    """Of one lot and axis: mean c (q,), L (q, q), its inverse, and the shapes g in L's coordinates, (q, shapes)."""

    c: Array
    L: Array
    inverse: Array
    level: Array
    scale: Array
    bumps: Array


class CurveStatistics:
    """Statistics of units under a family.

    Parameters
    ----------
    family : Family
    fitted : bool
        Whether the units are those that it was fitted on: each is then taken out of it again.
    """

    def __init__(self, family: Family, *, fitted: bool) -> None:
        self.family, self._fitted = family, fitted
        self._shapes: dict[str, list[DeviationShapes]] = {}
        self.at, self._bumps = _bumps(family)

    def deviations(self, J: Array, h: Array, lot: str, unit: str = "") -> list[CurveDeviation]:
        """Return those of each axis, of what a unit's soak says: J (d, q, q) and h (d, q)."""
        low = self.family.weights.get(unit, np.ones(len(h)))
        total, found = self.family.sampled + WEIGHT, []
        for axis, shapes in enumerate(self.shapes(lot)):
            V = np.linalg.inv(np.eye(len(shapes.c)) + shapes.L.T @ J[axis] @ shapes.L)
            z = V @ (shapes.L.T @ (h[axis] - J[axis] @ shapes.c))
            w = float(low[axis]) / total if self._fitted else 0.0
            found.append(CurveDeviation(z, np.eye(len(z)) - V, w))
        return found

    def of(self, soaked: UnitInformation, lot: str) -> dict[str, Array]:
        """Return the statistics of a unit, `level`, `scale`, `bump` and `curve`, each (d,)."""
        J, h = self.family.said(soaked)
        found, shapes = self.deviations(J, h, lot, soaked.unit), self.shapes(lot)
        rows: dict[str, list[float]] = {"level": [], "scale": [], "bump": [], "curve": []}
        for axis, (own, shape) in enumerate(zip(found, shapes, strict=True)):
            curve = own.squared()
            silent, bumps = np.nan if np.isnan(curve) else 1.0, shape.bumps[:, self.seen(J[axis])]
            t = silent * own.apart(_along(own, np.column_stack([shape.level, shape.scale, bumps])))
            rows["level"].append(float(t[0]))
            rows["scale"].append(float(t[1]))
            rows["bump"].append(float(np.log(np.max(np.abs(t[2:]), initial=0.0))) if len(t) > 2 else np.nan)
            rows["curve"].append(curve)
        return {name: np.array(values) for name, values in rows.items()}

    def seen(self, J: Array) -> npt.NDArray[np.bool_]:
        """Return the bumps (B,) of which a soak with J (q, q) says something: not those where it has no samples."""
        said = np.einsum("ib,ij,jb->b", self._bumps, J, self._bumps, optimize=True)
        return np.asarray((said > SEEN * np.max(said)) & (said > 0))

    def shapes(self, lot: str) -> list[DeviationShapes]:
        """Return the shapes of a lot, of each axis."""
        if lot not in self._shapes:
            before, found = self.family.marginal(lot), []
            for c, P in zip(before.c, before.covariance, strict=True):
                L, inverse, _ = VarianceComponents(P, P).root()
                found.append(
                    DeviationShapes(c, L, inverse, inverse @ np.ones(len(c)), inverse @ c, inverse @ self._bumps)
                )  # fmt: skip
            self._shapes[lot] = found
        return self._shapes[lot]


def _bumps(family: Family) -> tuple[Array, Array]:
    """Return where bumps are (B,), degC, and their coefficients (q, B)."""
    peaks, step = family.knots.peaks, family.knots.step
    at = np.tile(peaks[1:-1], len(WIDTHS))
    width = np.repeat(WIDTHS, len(peaks) - 2) * step
    return at, np.exp(-(((peaks[:, None] - at) / width) ** 2))


def _along(own: CurveDeviation, g: Array) -> Array:
    """Return t of shapes g (q, G) in the coordinates of L."""
    return np.asarray(g.T @ own.z / np.sqrt(np.maximum(np.einsum("ig,ij,jg->g", g, own.K, g, optimize=True), 1e-300)))
