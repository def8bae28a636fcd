"""Search for the chamber profile with the smallest uncertainty of the map: few proven ones, each rated alike.

A profile is rated by the sigma that its map will have over the range (`expected_curve_error`), of the worst axis.
White noise falls with the hours, whatever the profile. A walk looks like a curve where the sweep is slow and one way;
where each temperature is passed again and again, going up and going down, it looks like none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from driftlab.planning.chamber import Chamber, Profile, mixed, quickest, ramps, staircase
from driftlab.planning.unit_model import UnitModel
from fusion_core.chunk import Array
from fusion_core.errors import ConfigError
from fusion_core.thermal.curve_uncertainty import expected_curve_error, expected_misfit
from fusion_core.threads import one_thread

Progress = Callable[..., None] | None

CYCLES = (1, 2, 3, 4, 6, 8, 12, 16, 24)
CLASSIC = 5.0  # K, step of the staircase that others are compared with
MIX = 10.0  # K, step of the levels after ramps
MIN_COVERAGE = 0.97  # of the range, by a profile
ALIKE = 1.05  # profiles whose sigma differs by less than this factor are as good
SAME = 1e-6  # of the hours of a profile: rounding
SLOWER = 1.25  # times as long as the quickest ramps, again and again: profiles that any more hours allow
SHARES = (0.125, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 4.0)  # of the hours, for the Pareto curve
GRID = 121
DRAWS = 4  # of samples by which a kind's smoothing is found
EVERY, SAMPLES = 4.0, (7200, 40_000)  # s from one to the next, and fewest and most
LONGEST = 64.0  # times the hours: up to there a target is looked for


class SigmaCurve:
    """Uncertainty of a map over temperature: `sigma` (G, d) in SI at `temperature` (G,) in degC; NaN: not known."""

    temperature: Array
    sigma: Array

    @property
    def rms(self) -> Array:
        """Root mean square of sigma (d,) over the temperatures at which it is known, SI."""
        return rms(self.sigma[np.isfinite(self.sigma[:, 0])])

    @property
    def score(self) -> float:
        """That of the worst axis; infinite where nothing is known."""
        return float(np.max(self.rms)) if np.isfinite(self.sigma[:, 0]).any() else float("inf")

    @property
    def worst(self) -> tuple[float, float, int]:
        """Largest sigma that is known (SI), the temperature (degC) and the axis where it is."""
        k, axis = np.unravel_index(int(np.nanargmax(self.sigma)), self.sigma.shape)
        return float(self.sigma[k, axis]), float(self.temperature[k]), int(axis)


def rms(values: Array) -> Array:
    """Return the root mean square (d,) of values (G, d)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


@dataclass(frozen=True, eq=False)
class RatedProfile(SigmaCurve):
    """A profile, and the expected uncertainty of its map."""

    profile: Profile
    temperature: Array  # (G,): over the range, degC
    sigma: Array  # (G, d): of the map that will be fitted, SI
    # (G, d): the part that the unit's noise makes, the rest is the misfit of the kind; with a family all of it
    noise: Array
    covered: tuple[float, float]  # lowest and highest temperature of the body, degC
    share: float  # of the range that is covered
    place: str = ""  # with a family, the part of the range that is soaked: `lower`, `middle`, `upper`, or `whole`
    # (G, d): with a family, the root mean square error of the map without it that is best for its units
    without_family: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def of(cls, profile: Profile, chamber: Chamber, T: Array, grid: Array, noise: Array, misfit: Array) -> RatedProfile:
        """Return the rating of a profile that brings the body to T (N,), of variances (G, d) of noise and misfit."""
        low, high = float(T.min()), float(T.max())
        share = (min(high, chamber.high) - max(low, chamber.low)) / chamber.swing
        return cls(profile, grid, np.sqrt(noise + misfit), np.sqrt(noise), (low, high), max(share, 0.0))

    @property
    def alone(self) -> float:
        """Score by noise alone."""
        return float(np.max(rms(self.noise)))

    @property
    def own_score(self) -> float:
        """Score without the family."""
        return float(np.max(rms(self.without_family)))


@dataclass(frozen=True, eq=False)
class Point:
    """A point of the Pareto curve: the best profile of some hours, and the classic staircase (None: too short)."""

    hours: float
    best: RatedProfile
    classic: RatedProfile | None


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search: the chosen profile first among `judged`, the others by their sigma.

    `target` is the sigma that was asked for, and `shortest` the shortest profile that reaches it, where one does.
    """

    subject: UnitModel
    chamber: Chamber
    hours: float
    judged: tuple[RatedProfile, ...]
    classic: RatedProfile | None = None
    pareto: tuple[Point, ...] = ()
    target: float | None = None
    shortest: RatedProfile | None = None

    @property
    def chosen(self) -> RatedProfile:
        """The profile to record."""
        return self.judged[0]


def candidates(chamber: Chamber, hours: float) -> Iterator[Profile]:
    """Yield the profiles that fill the hours and that the chamber can: staircases, ramps, and both; classic first."""
    yield from possible(
        staircase(chamber, hours, CLASSIC), staircase(chamber, hours, CLASSIC, down=True),
        staircase(chamber, hours, 2 * CLASSIC, down=True), *(ramps(chamber, hours, cycles) for cycles in CYCLES),
        *(mixed(chamber, hours, cycles, MIX) for cycles in CYCLES),
    )  # fmt: skip


def leading(chamber: Chamber, hours: float) -> Iterator[Profile]:
    """Yield those of the candidates that are among the best of any hours: the classic, and few ramps and many."""
    every = possible(*(ramps(chamber, hours, cycles) for cycles in CYCLES))
    steps = possible(staircase(chamber, hours, CLASSIC), staircase(chamber, hours, 2 * CLASSIC, down=True))
    yield from (*steps, *every[:1], *every[1:][-2:])


def possible(*profiles: Profile | None) -> list[Profile]:
    """Return the profiles that there are."""
    return [profile for profile in profiles if profile is not None]


def judge(profile: Profile, subject: UnitModel, chamber: Chamber, draws: int = 1) -> RatedProfile:
    """Return the rating of a profile; the kind's smoothing is the mean of that of `draws` simulated soaks."""
    count = int(np.clip(profile.duration / EVERY, *SAMPLES))
    T, dt = profile.samples(chamber.lag, count)[1], profile.duration / count
    grid = np.linspace(chamber.low, chamber.high, GRID)
    noise, misfit = np.zeros((2, GRID, subject.d))
    with one_thread():  # a few hundred blocks
        for seed in range(draws):
            answer = subject.map.smoother(T, subject.drawn(T, dt, seed))
            noise += expected_curve_error(T, dt, subject.noise, subject.walk, answer).variance(grid) / draws
            if subject.shape is not None:
                misfit += expected_misfit(T, answer, subject.shape, subject.d).variance(grid) / draws
    return RatedProfile.of(profile, chamber, T, grid, noise, misfit)


def ranked(rated: list[RatedProfile]) -> list[RatedProfile]:
    """Return the profiles by their sigma, those that cover the range first.

    Of profiles that are as good the first is the one with the least noise (what the kind cannot follow may hide it),
    and of those with as little the slowest, which leaves least to gradients within the unit.
    """
    order = sorted(rated, key=lambda item: (item.share < MIN_COVERAGE, item.score))
    whole = [item for item in order if (item.share < MIN_COVERAGE) == (order[0].share < MIN_COVERAGE)]
    alike = [item for item in whole if item.score <= ALIKE * order[0].score]
    quiet = [item for item in alike if item.alone <= ALIKE * min(other.alone for other in alike)]
    first = min(quiet, key=lambda item: float(np.max(np.abs(item.profile.rates))))
    return [first, *(item for item in order if item is not first)]


class Ratings:
    """Ratings of profiles of a unit in a chamber, all that were asked for."""

    def __init__(self, subject: UnitModel, chamber: Chamber) -> None:
        self.subject, self.chamber = subject, chamber
        self.every: list[RatedProfile] = []
        self.hours: list[float] = []  # of the points
        self._ramps: dict[int, list[RatedProfile]] = {cycles: [] for cycles in CYCLES}  # each SLOWER than the last

    def of(self, profiles: Iterable[Profile]) -> list[RatedProfile]:
        """Return the ratings of profiles."""
        rated = [judge(profile, self.subject, self.chamber) for profile in profiles]
        self.every += rated
        return rated

    def whole(self, hours: float) -> list[RatedProfile]:
        """Return those that cover the range within up to so many hours, with ramps that do not depend on the hours.

        These are the quickest of each number of cycles, and slower ones for as long as that makes them better.
        """
        for cycles, known in self._ramps.items():
            longer = quickest(self.chamber, cycles) * SLOWER ** len(known)
            while longer <= hours and (len(known) < 2 or known[-1].score < known[-2].score):
                known += self.of(possible(ramps(self.chamber, longer, cycles)))
                longer *= SLOWER
        within = hours * (1 + SAME)
        return [item for item in self.every if item.profile.hours <= within and item.share >= MIN_COVERAGE]

    def best(self, point: Point) -> RatedProfile:
        """Return the best profile of up to the point's hours."""
        return min([point.best, *self.whole(point.hours)], key=lambda item: item.score)

    def point(self, hours: float) -> Point | None:
        """Return the best profile that fills the hours; None where none of them covers the range."""
        tried = self.of(leading(self.chamber, hours))
        self.hours.append(hours)
        if max((item.share for item in tried), default=0.0) < MIN_COVERAGE:
            return None
        return Point(hours, ranked(tried)[0], next((item for item in tried if _is_classic(item)), None))

    def shortest(self, hours: float, target: float) -> RatedProfile | None:
        """Return the shortest profile that reaches the target, to 3 % of its hours; None where LONGEST do not."""

        def reached(within: float) -> RatedProfile | None:
            good = [item for item in self.whole(within) if item.score <= target]
            return min(good, key=lambda item: item.profile.hours, default=None)

        high = max([hours, *self.hours])
        while (best := reached(high)) is None and high < LONGEST * hours:
            high *= 2
            self.point(high)
        low = 0.0
        while best is not None and best.profile.hours > 1.03 * low:
            longest = best.profile.hours
            low = max((tried for tried in self.hours if tried < longest * (1 - SAME)), default=longest / 8)
            if longest > 1.03 * low:
                self.point(float(np.sqrt(low * longest)))
                best = reached(longest)
        return best


def search(
    subject: UnitModel, chamber: Chamber, hours: float, target: float | None = None, progress: Progress = None
) -> SearchResult:
    """Return the profiles of up to `hours`, judged, and the Pareto curve of hours against sigma.

    Raises
    ------
    ConfigError
        If the hours are too few for any profile to cover the range.
    """
    say = progress or (lambda *state: None)
    say(f"profiles of {hours:g} h")
    ratings = Ratings(subject, chamber)
    tried = ratings.of(candidates(chamber, hours))
    ratings.hours.append(hours)
    if max((item.share for item in tried), default=0.0) < MIN_COVERAGE:
        raise ConfigError(_too_short(chamber, hours, tried))
    points: list[Point] = []
    for share in SHARES:
        say(f"profiles of {share * hours:g} h")
        point = ratings.point(share * hours) if share != 1.0 else Point(hours, ranked(tried)[0], None)
        points += [] if point is None else [point]
    # where a cycle more does not fit, a slower one is worse by the walk: then the recording ends earlier
    early = min((item for item in ratings.whole(hours) if item not in tried), key=lambda item: item.score, default=None)
    tried += [early] if early is not None and ALIKE * early.score < ranked(tried)[0].score else []
    order = ranked(tried)
    classic = next((item for item in tried if _is_classic(item)), None)
    finer = {item: judge(item.profile, subject, chamber, DRAWS) for item in {*order[:2], classic or order[0]}}
    order = ranked([finer.get(item, item) for item in order])
    ratings.every = [finer.get(item, item) for item in ratings.every]
    classic = None if classic is None else finer[classic]
    points = [replace(p, best=order[0], classic=classic) if p.hours == hours else p for p in points]
    # who has more hours may stop earlier
    pareto = tuple(p if p.hours == hours else replace(p, best=ratings.best(p)) for p in points)
    shortest = None if target is None else ratings.shortest(hours, target)
    return SearchResult(subject, chamber, hours, tuple(order), classic, pareto, target, shortest)


def _too_short(chamber: Chamber, hours: float, tried: list[RatedProfile]) -> str:
    widest = max(tried, key=lambda item: item.share, default=None)
    most = "" if widest is None else f" (at most {widest.covered[0]:.1f} to {widest.covered[1]:.1f} °C)"
    return (
        f"--hours {hours:g}: no profile brings the unit from {chamber.low:g} to {chamber.high:g} °C and back{most}, "
        f"at {60 * chamber.rate:.3g} K/min and {chamber.lag:g} s behind the chamber; give more --hours, or a narrower "
        "--range"
    )


def _is_classic(item: RatedProfile) -> bool:
    """Return True if a profile is a staircase whose last step leads up: it never comes back."""
    moving = item.profile.rates[item.profile.rates != 0]
    return item.profile.family == "staircase" and bool(moving[-1] > 0)
