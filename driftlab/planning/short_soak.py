"""Shortest soak of a unit whose family is known: the posterior map's sigma, before anything is recorded.

The information J of a soak on the coefficients c depends on the course of the temperature and on the noise, not on the
readings. So the covariance of the posterior map is known beforehand, C = (Cov^-1 + J)^-1, and so is the error of a map
without the family in the mean over the family's units: with estimates a = K (B c + e) of the rows, e the noise of
covariance S, and a map E a over the range::

    E (E a - B_g c)^2 = diag (E K B - B_g) (Cov + mu mu') (E K B - B_g)' + E K S K' E'

q coefficients, G temperatures, d axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from driftlab.family.mixed_model import Family
from driftlab.family.posterior_map import posterior_of
from driftlab.family.unit_information import UnitInformation
from driftlab.planning.chamber import Chamber, Profile, ramps
from driftlab.planning.search import RatedProfile
from driftlab.soak.blocks import SoakRows
from fusion_core.chunk import Array
from fusion_core.errors import ConfigError

SHARES = (0.2, 0.3, 0.4, 0.6, 0.8, 1.0)  # of the range
PLACES = {"lower": 0.0, "middle": 0.5, "upper": 1.0}
SHORTER = 2.0 ** -np.arange(4)  # of the hours
STEPS = 8  # lengths from the shortest to the longest, among which the shortest that is enough is sought
ROWS, ROW = 240, 10.0  # of a soak at most, and their least length, s
ORDERS = range(1, 6)  # of polynomials without the family
NEARLY = 1.1  # of the least sigma: as good, where no sigma is asked for


@dataclass(frozen=True, eq=False)
class ShortSoakPlan:
    """Result of a search for the shortest soak."""

    family: Family
    chamber: Chamber
    noise: Array  # (d,): density that is planned with, SI
    walk: Array  # (d,): density, SI
    hours: tuple[float, ...]  # lengths that are tabled, the longest first
    tried: tuple[RatedProfile, ...]  # of each share and length the best place
    # the shortest that reaches the target; without one, the shortest that is nearly as good as any
    chosen: RatedProfile
    target: float | None  # sigma to reach, rms over the range of the worst axis, SI
    reached: bool  # whether the target is
    own_hours: float | None  # length without the family; None where no length of the table's will do

    def best(self, share: float, hours: float) -> RatedProfile | None:
        """Return the rating of a share of the range in so many hours."""
        same = (s for s in self.tried if s.share == share and np.isclose(s.profile.hours, hours, rtol=0.02))
        return next(same, None)


def shortened(
    family: Family, chamber: Chamber, hours: float, noise: Array, walk: Array, target: float | None
) -> ShortSoakPlan:
    """Return the shortest soak, of at most `hours`, for a unit with these densities of noise (d,) each."""

    def best(share: float, hours: float) -> RatedProfile | None:
        """Return the best place for a share of the range, None where the chamber cannot do it in these hours."""
        rated = (expected(family, chamber, *part, noise, walk) for part in _parts(chamber, share, hours))
        return min(rated, key=lambda s: s.score, default=None)

    lengths = tuple((hours * SHORTER).tolist())
    tried = tuple(s for h in lengths for share in SHARES if (s := best(share, h)))
    if not tried:
        raise ConfigError(
            f"--hours {hours:g}: the chamber cannot take any part of the family's range in so short a time; give more "
            "hours, a faster --rate, or a narrower --range"
        )
    if target is None:
        least = min(s.score for s in tried)
        good = [s for s in tried if s.score <= NEARLY * least]
        chosen = min(good, key=lambda s: (s.profile.hours, s.score))
        return ShortSoakPlan(family, chamber, noise, walk, lengths, tried, chosen, None, True, None)
    own_hours: list[float] = []
    enough: list[RatedProfile] = []
    for length in np.geomspace(hours * SHORTER[-1], hours, STEPS):
        here = [s for share in SHARES if (s := best(share, float(length)))]
        enough = enough or [s for s in here if s.score <= target]
        own_hours += [s.profile.hours for s in here if s.own_score <= target]
    chosen = min(enough or tried, key=lambda s: (s.share, s.score) if enough else (s.score, s.share))
    own = min(own_hours) if own_hours else None
    return ShortSoakPlan(family, chamber, noise, walk, lengths, tried, chosen, target, bool(enough), own)


def _parts(chamber: Chamber, share: float, hours: float) -> Iterator[tuple[float, str, Profile]]:
    for place, at in PLACES.items() if share < 1 else [("whole", 0.0)]:
        low = chamber.low + at * (1 - share) * chamber.swing
        high = low + share * chamber.swing
        begin = min(max(chamber.start, low), high)
        if (profile := ramps(Chamber(low, high, begin, chamber.rate, chamber.lag), hours, 1)) is not None:
            yield share, place, profile


def expected(
    family: Family, chamber: Chamber, share: float, place: str, profile: Profile, noise: Array, walk: Array
) -> RatedProfile:
    """Return the rating of a profile for a unit of the family."""
    count = int(np.clip(profile.duration / ROW, 8, ROWS))
    t, T = profile.samples(chamber.lag, count)
    rows = SoakRows(t, T, np.zeros((count, len(noise))), np.full(count, profile.duration / count), {})
    soaked = UnitInformation.of("", family.axes, [rows], noise, walk, family.knots.step)
    low, high = family.knots.domain
    grid = np.linspace(max(chamber.low, low), min(chamber.high, high), 2 * family.knots.intervals + 1)
    without = np.stack([_without(family, soaked, grid, axis) for axis in range(len(noise))], axis=1)
    spread, covered = posterior_of(family, soaked).sigma_at(grid), (float(T.min()), float(T.max()))
    return RatedProfile(profile, grid, spread, spread, covered, share, place, without)


def _without(family: Family, soaked: UnitInformation, grid: Array, axis: int) -> Array:
    """Return the error (G,) of the best polynomial on a soak's rows, free, clamped or straight beyond what it saw."""
    rows, before = soaked.recordings[0], family.marginal()
    mean, second = before.c[axis], before.covariance[axis] + np.outer(before.c[axis], before.c[axis])
    low, high = float(rows.T.min()), float(rows.T.max())
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-6)
    seen, at = family.knots.values(rows.T), family.knots.values(grid)
    best, least = np.abs(at @ mean), np.inf
    x, inside = (grid - middle) / half, (np.clip(grid, low, high) - middle) / half
    for order in ORDERS:
        V = np.polynomial.chebyshev.chebvander((rows.T - middle) / half, order)
        X = rows.whitened(np.column_stack([V, seen]), soaked.white[axis], soaked.walk[axis], free=False)
        own, rest = X[:, : order + 1], X[:, order + 1 :]
        K = np.linalg.pinv(own)
        slopes = np.polynomial.chebyshev.chebder(np.eye(order + 1), axis=0)
        clamped = np.polynomial.chebyshev.chebvander(inside, order)
        straight = clamped + (x - inside)[:, None] * np.polynomial.chebyshev.chebval(inside, slopes).T
        for E in (np.polynomial.chebyshev.chebvander(x, order), clamped, straight):
            off, noisy = E @ (K @ rest) - at, E @ K
            square = np.einsum("gq,qp,gp->g", off, second, off, optimize=True) + np.sum(noisy**2, axis=1)
            if np.mean(square) < least:
                best, least = np.sqrt(square), float(np.mean(square))
    return np.asarray(best)
