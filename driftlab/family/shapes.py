"""How far the curve of a unit is from its family's, and where.

The distance is that of `driftlab.family.restricted`, in the law of the other units. Where it is, the curve says window
by window: with r the unit's own coefficients less its lot's mean and Q the inverse of their covariance, family's and
own, what the window b of coefficients is off what *all its others* let expect is::

    e_b = Q_bb^-1 (Q r)_b,    with covariance Q_bb^-1,    Q = L^-T (1 - M^-1) L^-1,  Q r = L^-T z

so a bend of one unit stands out although the level of every unit is its own. d axes, q coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftlab.family.law import Family
from driftlab.family.null import FEWEST, scores
from driftlab.family.restricted import Law
from driftlab.family.smooth_prior import WEIGHT
from driftlab.family.soaked import Soaked
from fusion_core.chunk import Array

KNOWN = 1e-2  # of the family's variance: a direction of which a unit says less is not compared
WINDOWS = (3, 5, 7, 9, 11, 15)  # coefficients
LOCAL = 0.5  # of a distance that a window has to hold, for the curve to bend there and be as the others elsewhere


@dataclass(frozen=True)
class Bend:
    """Where a curve is off: at `T` degC, over `width` K, by `height`; units spread there by `spread`; SI.

    `local` says whether it is as the others elsewhere.
    """

    T: float
    width: float
    height: float
    spread: float
    local: bool


class Shapes:
    """Distances of units from a family.

    Parameters
    ----------
    family : Family
    fitted : bool
        Whether the units are those that it was fitted on: each is then taken out of it again.
    """

    def __init__(self, family: Family, *, fitted: bool) -> None:
        self._family, self._fitted = family, fitted
        self._roots: dict[str, list[tuple[Array, Array, Array]]] = {}

    def deviations(self, soaked: Soaked, lot: str) -> Array:
        """Return, of each axis, z (d, q) over its expected deviations, NaN where the unit says nothing of it; and dof.

        As (d, q + 2): the last two are what the q are known by in all, and the degrees of freedom.
        """
        J, h = self._family.said(soaked)
        low = self._family.weights.get(soaked.unit, np.ones(len(h)))
        found, total = np.full((len(h), h.shape[1] + 2), np.nan), self._family.sampled + WEIGHT
        for axis in range(len(h)):
            z, V, _ = self._own(J[axis], h[axis], lot, axis)
            K = np.eye(len(z)) - V
            known, size = float(np.trace(K)), np.diag(K)
            if known < KNOWN:
                continue
            if self._fitted:
                w = float(low[axis])
                z = z * np.sqrt((1 - w / total) / (1 - min(w * float(z @ z) / total, 0.9)))
            found[axis, :-2] = np.where(size > KNOWN, z / np.sqrt(np.maximum(size, KNOWN)), np.nan)
            found[axis, -2:] = known, known**2 / float(np.sum(K * K))
        return found

    def bend(self, soaked: Soaked, lot: str, axis: int) -> Bend:
        """Return where the curve of an axis is off most, of what its own rest lets expect."""
        knots = self._family.knots
        J, h = self._family.said(soaked)
        z, V, inverse = self._own(J[axis], h[axis], lot, axis)
        Q, pull = inverse.T @ (np.eye(len(z)) - V) @ inverse, inverse.T @ z
        best, at, width = -np.inf, 0, knots.q
        for size in (size for size in WINDOWS if size <= max(knots.q // 2, 3)):
            for start in range(knots.q - size + 1):
                b = slice(start, start + size)
                gain = _squared(Q[b, b], pull[b]) - 2 * size
                if gain > best:
                    best, at, width = gain, start, size
        b = slice(at, at + width)
        scale = np.sqrt(np.maximum(np.diag(Q[b, b]), 1e-300))
        cov = np.linalg.pinv(Q[b, b] / np.outer(scale, scale), rcond=1e-8, hermitian=True) / np.outer(scale, scale)
        off = cov @ pull[b]
        B = knots.values(knots.peaks)[:, b]
        height, spread = B @ off, np.sqrt(np.maximum(np.einsum("ti,ij,tj->t", B, cov, B), 0.0))
        inner = slice(max(at, 1), max(min(at + width, knots.q - 1), max(at, 1) + 1))
        least = np.abs(height) - 2 * spread  # that it is off at all: in a gap of a soak any height will do
        k = int(np.argmax(least[inner])) + inner.start
        half = (np.abs(height) > abs(height[k]) / 2) & (spread <= max(3 * float(spread[k]), abs(height[k]) / 4))
        wide = float(np.sum(half)) * knots.step
        if best < LOCAL * float(z @ z):
            return self._whole(axis, z, inverse)
        return Bend(float(knots.peaks[k]), wide, float(height[k]), float(spread[k]), local=True)

    def _whole(self, axis: int, z: Array, inverse: Array) -> Bend:
        """Return where a curve that is not like the others over all its range is off its lot's mean most."""
        knots = self._family.knots
        B = knots.values(knots.peaks[1:-1])
        spread = np.sqrt(np.einsum("ti,ij,tj->t", B, self._family.Sigma[axis], B))
        off = B @ np.linalg.solve(inverse, z)
        k = int(np.argmax(np.abs(off) / spread))
        low, high = knots.domain
        return Bend(float(knots.peaks[1 + k]), high - low, float(off[k]), float(spread[k]), local=False)

    def _own(self, J: Array, h: Array, lot: str, axis: int) -> tuple[Array, Array, Array]:
        """Return z (q,), its covariance given the data (q, q), and the inverse of L."""
        if lot not in self._roots:
            before = self._family.marginal(lot)
            self._roots[lot] = [(c, *Law(P, P).root()[:2]) for c, P in zip(before.c, before.covariance, strict=True)]
        c, L, inverse = self._roots[lot][axis]
        V = np.linalg.inv(np.eye(len(L)) + L.T @ J @ L)
        return np.asarray(V @ (L.T @ (h - J @ c))), np.asarray(V), inverse


def distances(deviations: Array) -> Array:
    """Return about how many deviations of a Gaussian the units are out (n, d), of `Shapes.deviations` (n, d, q + 2).

    Large amounts of what units of the family have in common are likelier than a Gaussian has them where the units'
    own are, direction by direction.
    """
    n, d, q = deviations.shape[0], deviations.shape[1], deviations.shape[2] - 2
    found = np.full((n, d), np.nan)
    for axis in range(d):
        z, dof = deviations[:, axis, :q], deviations[:, axis, -1]
        counted = np.sum(np.isfinite(z), axis=1)
        own = counted > 0
        if np.sum(own) < FEWEST:
            continue
        said = np.any(np.isfinite(z), axis=0)
        square = np.nansum(scores(z[:, said]) ** 2, axis=1)
        share = np.divide(square, counted, out=np.full(n, np.nan), where=own)
        found[:, axis] = (np.cbrt(share) - 1 + 2 / (9 * dof)) / np.sqrt(2 / (9 * dof))
    return found


def _squared(Q: Array, pull: Array) -> float:
    """Return pull' Q^-1 pull."""
    scale = np.sqrt(np.maximum(np.diag(Q), 1e-300))
    x = pull / scale
    return float(x @ np.linalg.lstsq(Q / np.outer(scale, scale), x, rcond=1e-8)[0])
