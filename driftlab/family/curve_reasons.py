"""What is wrong with a curve that is not as its family's: of a few hypotheses the one under which it is likeliest.

Each hypothesis is a law of the coefficients, and with J, h what the soak says::

    - 2 log p = c'Jc - 2 h'c - a'M^-1 a + log det M + price,   a = L'(h - J c),  M = 1 + L'J L

Of a reversed sign c is the mean with the other sign, of swapped axes c and L are each other's; a scale of the mean
(with a level), a level and a local deviation have the size that is likeliest. A price is twice the logarithm of what
was tried. A hypothesis is believed if with it the curve is an ordinary one of the family. q coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from driftlab.family.curve_statistics import CurveStatistics, Deviation
from driftlab.family.tail_law import Laws
from fusion_core.chunk import Array

PRICES = {"sign": 4.0, "swap": 4.0, "level": 8.0, "scale": 18.0, "bump": 16.0}
SCALES = 0.25, 4.0  # of either sign: -0.4 times the usual curve is not the usual one negated
ORDINARY = 1e-3  # probability of a curve as far from its family, that is still one of it
LITTLE = 0.15  # of the squared distance


@dataclass(frozen=True)
class Reason:
    """What is wrong: `what` is `sign`, `swap`, `scale`, `level`, `bump`, or `curve` where none of these is all.

    The curve of `axes` is `off` most at `T` degC, where units spread by `spread` (SI), or is so many `times` the usual.
    """

    what: str
    axes: tuple[int, ...]
    off: float
    spread: float
    T: float
    times: float = 1.0


class CurveReasons:
    """Reasons for odd curves, by the statistics of a family and the laws of these."""

    def __init__(self, statistics: CurveStatistics, laws: Laws) -> None:
        self.statistics, self.laws = statistics, laws

    def of(self, J: Array, h: Array, lot: str, axes: Sequence[int]) -> list[Reason]:
        """Return what is wrong with the curves of the axes that are odd, of a soak with J (d, q, q) and h (d, q)."""
        found, rest = [], list(axes)
        every = [self._hypotheses(J[axis], h[axis], lot, axis) for axis in range(len(J))]
        least = [own[0 if axis in axes else -1][0] for axis, own in enumerate(every)]
        for a, b in combinations(range(len(J)), 2):
            if not {a, b} & set(rest):
                continue
            crossed = [self._prior(J[i], h[i], lot, k, 1.0, i) for i, k in ((a, b), (b, a))]
            cost = sum(own[0] for own in crossed) + PRICES["swap"]
            if cost < least[a] + least[b] and all(own[1] for own in crossed):
                rest = [axis for axis in rest if axis not in (a, b)]
                found.append(self._where("swap", (a, b), J[a], h[a], lot))
        for axis in rest:
            ordinary = [reason for _, reason, good in every[axis] if good]
            found.append(ordinary[0] if ordinary else every[axis][-1][1])
        return found

    def _hypotheses(self, J: Array, h: Array, lot: str, axis: int) -> list[tuple[float, Reason, bool]]:
        """Return cost, reason, and whether it makes the curve ordinary, the likeliest first; at the end `curve`."""
        shapes = self.statistics.shapes(lot)[axis]
        found = []
        cost, good = self._prior(J, h, lot, axis, -1.0, axis)
        found.append((cost + PRICES["sign"], self._where("sign", (axis,), J, h, lot), good))
        cost, own = _cost(J, h, shapes.c, shapes.L)
        where = self._where("curve", (axis,), J, h, lot)
        gain, size, left = _less(own, shapes.level[:, None])
        spread = float(1 / np.sqrt(shapes.level @ own.K @ shapes.level))
        reason = Reason("level", (axis,), float(size[0]), spread, where.T)
        found.append((cost - gain + PRICES["level"], reason, self._ordinary(left, axis, own)))
        times = 1 + float(_less(own, np.column_stack([shapes.scale, shapes.level]))[1][0])
        if SCALES[0] < abs(times) < SCALES[1]:
            scaled, wide = _cost(J, h, times * shapes.c, times * shapes.L)
            gain, _, left = _less(wide, shapes.level[:, None] / times)
            reason = Reason("scale", (axis,), where.off, where.spread, where.T, times)
            found.append((scaled - gain + PRICES["scale"], reason, self._ordinary(left, axis, own)))
        seen = np.flatnonzero(self.statistics.seen(J))
        bumps = shapes.bumps[:, seen]
        t = (bumps.T @ own.z) ** 2 / np.einsum("ig,ij,jg->g", bumps, own.K, bumps, optimize=True)
        k = int(seen[np.argmax(t)]) if len(seen) else 0
        g = shapes.bumps[:, k]
        gain, size, left = _less(own, g[:, None])
        bump = Reason("bump", (axis,), float(size[0]), float(1 / np.sqrt(g @ own.K @ g)), float(self.statistics.at[k]))
        found.append((cost - gain + PRICES["bump"], bump, self._ordinary(left, axis, own)))
        return [*sorted(found, key=lambda one: one[0]), (cost, where, True)]

    def _prior(self, J: Array, h: Array, lot: str, axis: int, times: float, own: int) -> tuple[float, bool]:
        """Return the cost of a curve that is so many times one of an axis, and whether it is ordinary then."""
        mine, shapes = self.statistics.shapes(lot)[own], self.statistics.shapes(lot)[axis]
        cost, left = _cost(J, h, times * shapes.c, shapes.L)
        return cost, self._ordinary(left, own, _cost(J, h, mine.c, mine.L)[1])

    def _ordinary(self, left: Deviation, axis: int, before: Deviation) -> bool:
        """Whether what is left of a curve is ordinary, or next to nothing of what it was."""
        law, square = self.laws.curves.get("curve"), left.squared()
        if law is None or np.isnan(square):
            return False
        values = np.full((1, len(law.centre)), square)
        little = left.z @ left.z < LITTLE * (before.z @ before.z)
        return bool(law.p(values, upper=True)[0, axis] > ORDINARY or little)

    def _where(self, what: str, axes: tuple[int, ...], J: Array, h: Array, lot: str, times: float = 1.0) -> Reason:
        """Return a reason with where the curve of the first of the axes is off its lot's mean most."""
        statistics, axis = self.statistics, axes[0]
        shapes, knots = statistics.shapes(lot)[axis], statistics.family.knots
        B = knots.values(knots.peaks[1:-1])
        spread = np.sqrt(np.einsum("ti,ij,tj->t", B, statistics.family.Sigma[axis], B))
        off = B @ (shapes.L @ _cost(J, h, shapes.c, shapes.L)[1].z)
        k = int(np.argmax(np.abs(off) / spread))
        return Reason(what, axes, float(off[k]), float(spread[k]), float(knots.peaks[1 + k]), times)


def _less(own: Deviation, g: Array) -> tuple[float, Array, Deviation]:
    """Return what shapes g (q, G) of the likeliest sizes gain, these sizes (G,), and what they leave."""
    pull, square = g.T @ own.z, g.T @ own.K @ g
    size = np.linalg.solve(square, pull)
    return float(pull @ size), np.asarray(size), Deviation(own.z - own.K @ g @ size, own.K, 0.0)


def _cost(J: Array, h: Array, c: Array, L: Array) -> tuple[float, Deviation]:
    """Return - 2 log p of the module's text, without the price, and the deviation of the coefficients."""
    M = np.eye(L.shape[1]) + L.T @ J @ L
    V = np.linalg.inv(M)
    a = L.T @ (h - J @ c)
    z = V @ a
    cost = float(c @ J @ c - 2 * h @ c - a @ z + np.linalg.slogdet(M)[1])
    return cost, Deviation(z, np.eye(len(z)) - V, 0.0)
