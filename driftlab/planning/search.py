"""Search for the chamber profile with the smallest uncertainty of the map: few proven ones, each rated alike.

A profile is rated by the sigma that its map will have over the range (`expected_curve_error`), of the worst axis.
White noise falls with the hours, whatever the profile. A walk looks like a curve where the sweep is slow and one way;
where each temperature is passed again and again, going up and going down, it looks like none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from driftlab.planning.chamber import Chamber, Profile, mixed, ramps, staircase
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
    tried = [judge(profile, subject, chamber) for profile in candidates(chamber, hours)]
    if max((item.share for item in tried), default=0.0) < MIN_COVERAGE:
        raise ConfigError(_too_short(chamber, hours, tried))
    points: list[Point] = []
    for share in SHARES:
        say(f"profiles of {share * hours:g} h")
        point = _point(subject, chamber, share * hours) if share != 1.0 else Point(hours, ranked(tried)[0], None)
        points += [] if point is None else [point]
    # where a cycle more does not fit, a slower one is worse by the walk: then the recording ends earlier
    early = min((p.best for p in points if p.hours < hours), key=lambda item: item.score, default=None)
    tried += [early] if early is not None and ALIKE * early.score < ranked(tried)[0].score else []
    order = ranked(tried)
    classic = next((item for item in tried if _is_classic(item)), None)
    keep = order[:2] + [item for item in (classic,) if item is not None and item not in order[:2]]
    finer = {item: judge(item.profile, subject, chamber, DRAWS) for item in keep}
    order = [finer.get(item, item) for item in order]
    classic = None if classic is None else finer[classic]
    pareto = _falling([Point(hours, order[0], classic) if p.hours == hours else p for p in points])
    shortest = None if target is None else _shortest(subject, chamber, hours, target, pareto)
    return SearchResult(subject, chamber, hours, tuple(order), classic, pareto, target, shortest)


def _falling(points: list[Point]) -> tuple[Point, ...]:
    """Return the points with the best profile of up to so many hours: who has more may stop earlier."""

    def best(hours: float) -> RatedProfile:
        return min((point.best for point in points if point.hours <= hours), key=lambda item: item.score)

    return tuple(replace(point, best=best(point.hours)) for point in points)


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


def _point(subject: UnitModel, chamber: Chamber, hours: float) -> Point | None:
    tried = [judge(profile, subject, chamber) for profile in leading(chamber, hours)]
    if not tried or max(item.share for item in tried) < MIN_COVERAGE:
        return None
    return Point(hours, ranked(tried)[0], next((item for item in tried if _is_classic(item)), None))


def _shortest(
    subject: UnitModel, chamber: Chamber, hours: float, target: float, points: tuple[Point, ...]
) -> RatedProfile | None:
    """Return the shortest profile that reaches the target, to 3 % of its hours; None where LONGEST do not."""
    reached = next((point for point in points if point.best.score <= target), None)
    low = max((p.hours for p in points if reached is None or p.hours < reached.hours), default=points[0].hours / 8)
    high = points[-1].hours
    while reached is None and high < LONGEST * hours:
        low, high = high, 2 * high
        point = _point(subject, chamber, high)
        reached = point if point is not None and point.best.score <= target else None
    if reached is None:
        return None
    best, high = reached.best, reached.hours
    while high > 1.03 * low:
        middle = float(np.sqrt(low * high))
        point = _point(subject, chamber, middle)
        if point is not None and point.best.score <= target:
            best, high = point.best, middle
        else:
            low = middle
    return best
