"""Continuation of a soak: the further profile that improves the map most, and whether any is needed.

The recordings are read and fitted as `fit-map` does, one after the other as if there were no pause. White noise and
walk are those of the residuals of the map (`measured_noise`), in place of the config's. A further profile is rated by
the sigma of the map that is fitted to both together; the misfit of the kind so far stays, and so does half of what is
between up and down where a memory is seen. One that is not excluded counts so far, as probable as it is, as in
`driftlab.maps.assessment`. G temperatures, d axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from driftlab.config import Config, with_recording
from driftlab.maps.fit import gather
from driftlab.maps.hysteresis.memory import MemoryVerdict
from driftlab.planning.chamber import Chamber, Profile, ramps, staircase
from driftlab.planning.search import (
    GRID,
    MIN_COVERAGE,
    SAMPLES,
    Progress,
    RatedProfile,
    SearchResult,
    SigmaCurve,
    possible,
)
from driftlab.planning.unit_model import UnitModel
from driftlab.soak.blocks import means, runs
from driftlab.soak.wander import expected_joint_error, fitted_jointly, wander_of
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap
from fusion_core.faults import Faults
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.curve_uncertainty import expected_curve_error, measured_noise

LITTLE = 0.05  # of sigma: an hour that gains less is not worth it
EDGE = 0.02  # of the range, by which its end may be missed
CYCLES = (1, 2, 4)
STEPS = 5.0  # K


@dataclass(frozen=True, eq=False)
class RecordedSoak(SigmaCurve):
    """Recordings, N samples in all, and the map that is fitted to them."""

    subject: UnitModel  # the unit, its noise as measured, its curve as fitted
    chamber: Chamber  # with the range that is asked for
    parts: tuple[tuple[Array, Array], ...]  # T (N_r,), degC, and bias (N_r, d), SI, of each recording
    dt: float  # from one sample to the next, s
    map: FittedMap
    temperature: Array  # (G,): over the range, degC
    sigma: Array  # (G, d): uncertainty of the map, SI; NaN where nothing was seen
    misfit: Array  # (G, d): the part of it that the kind of map is to blame for
    kinds: Array  # (3, d): variances of the curve's bends, and of level and shape of a recording (`wander_of`)
    memory: MemoryVerdict  # of the recording that is likeliest to have one
    between: Array  # (G, d): half of what is between up and down, as probable as it is, SI

    @property
    def T(self) -> Array:
        """All temperatures (N,)."""
        return np.concatenate([T for T, _ in self.parts])

    @property
    def hours(self) -> float:
        """Length in all."""
        return len(self.T) * self.dt / 3600

    def expected(self, more: Sequence[Array]) -> CurveError:
        """Return the error of the map that is fitted to these and to `more` recordings at T (N_r,), noise alone."""
        parts, subject = [*(T for T, _ in self.parts), *more], self.subject
        T, noises = np.concatenate(parts), (subject.noise, subject.walk, *self.kinds)
        still = replace(subject, walk=np.zeros_like(subject.walk)).drawn(T, self.dt, seed=0)
        return expected_joint_error(parts, self.dt, list(zip(*noises, strict=True)), subject.map.smoother(T, still))

    @property
    def seen(self) -> tuple[float, float]:
        """Lowest and highest temperature, degC."""
        return float(self.T.min()), float(self.T.max())

    @property
    def whole(self) -> bool:
        """True if the range was seen from end to end."""
        low, high = self.seen
        near = EDGE * self.chamber.swing
        return low <= self.chamber.low + near and high >= self.chamber.high - near


@dataclass(frozen=True, eq=False, kw_only=True)
class Continuation(SearchResult):
    """Result of a search for a further profile, and whether the recordings are enough.

    `enough` says why, in a word: `target`, `gain` (an hour gains too little), `floor` (the bias wanders by more); empty
    where they are not.
    """

    recorded: RecordedSoak
    enough: str = ""

    @property
    def gain(self) -> float:
        """By how much of sigma an hour of the chosen profile makes it smaller, in the mean over its hours."""
        return (1 - self.chosen.score / self.recorded.score) / self.chosen.profile.hours


Parts = list[tuple[Array, Array]]  # T (N,) in degC and bias (N, d) in SI of each recording


def read_parts(config: Config, recordings: Sequence[str], faults: Faults) -> tuple[Parts, float, MemoryVerdict]:
    """Return recordings as `fit-map` has them, how long a sample is, s, and the likeliest memory in one of them.

    Raises
    ------
    DataError
        If a recording cannot be used.
    """
    soaks = [gather(with_recording(config, name), (), faults) for name in recordings]
    memory = max((soak.memory for soak in soaks), key=lambda verdict: verdict.probability)
    return [(soak.T, soak.bias) for soak in soaks], float(np.median([soak.interval for soak in soaks])), memory


def of_samples(
    parts: Parts, dt: float, subject: UnitModel, chamber: Chamber, memory: MemoryVerdict | None = None
) -> RecordedSoak:
    """Return the soak of samples, one each `dt` in s; without `memory` nothing is between up and down."""
    T, bias = (np.concatenate(values) for values in zip(*parts, strict=True))
    found = wander_of(T, bias, np.cumsum([0, *(len(T_r) for T_r, _ in parts)])[:-1].tolist())
    joint = found if len(parts) > 1 else None
    fitted = fitted_jointly(subject.map, T, bias, {}, joint)
    many = int(np.ceil(len(T) / SAMPLES[1]))
    cuts = [runs([0], len(T_r), many) for T_r, _ in parts]
    rows = tuple((means(T_r, own), means(b_r, own)) for (T_r, b_r), own in zip(parts, cuts, strict=True))
    T_m, b_m = (np.concatenate(values) for values in zip(*rows, strict=True))
    answer, step = subject.map.smoother(T_m, b_m), dt * many
    measured = measured_noise(T_m, b_m - fitted.bias(T_m), step, answer)
    noise, walk = measured if joint is None else joint.densities(dt)
    straight = replace(fitted, outside="tangent")
    known = replace(
        subject, noise=noise, walk=walk, noise_of="measured on what was recorded",
        shape=straight.bias, shape_of="as fitted so far",
    )  # fmt: skip
    unknown = np.var(bias, axis=0)  # the level of a recording after one, of which nothing is known
    kinds = np.array([unknown, unknown, 0 * unknown])
    if found is not None:
        kinds[: 1 if joint is None else 3] = np.array(found.noises).T[2 : 3 if joint is None else 5]
    grid = np.linspace(chamber.low, chamber.high, GRID)
    near = EDGE * chamber.swing
    inside = (grid >= T.min() - near) & (grid <= T.max() + near)
    sigma = np.where(inside[:, None], straight.sigma(grid), np.nan)
    memory = memory or MemoryVerdict.unknown(subject.d, "")
    zero, between = np.zeros_like(sigma), np.sqrt(memory.variance(grid))
    before = RecordedSoak(known, chamber, rows, step, fitted, grid, sigma, zero, kinds, memory, between)
    alone = expected_curve_error(T_m, step, noise, walk, answer) if joint is None else before.expected([])
    misfit = np.sqrt(np.clip(np.nan_to_num(sigma) ** 2 - alone.variance(grid), 0.0, None))
    return replace(before, misfit=misfit, sigma=np.hypot(sigma, between))


def jointly(profile: Profile, before: RecordedSoak) -> RatedProfile:
    """Return the rating of the map that is fitted to the recordings and a further profile together."""
    chamber, grid = before.chamber, before.temperature
    new = profile.samples(chamber.lag, max(int(profile.duration / before.dt), 2))[1]
    T, variance = np.concatenate([before.T, new]), before.expected([new]).variance(grid)
    stays = before.misfit**2 + (before.between**2 if before.memory.answer == "seen" else 0.0)
    return RatedProfile.of(profile, chamber, T, grid, variance, stays)


def continuation_of(
    before: RecordedSoak, hours: float, target: float | None, progress: Progress = None
) -> Continuation:
    """Return the profile of `hours` that adds most to the recordings, and whether any is needed.

    Enough is what reaches the target. Where none is given: when the range was seen, and an hour more would gain less
    than LITTLE of sigma, or sigma is below the floor of the Allan deviation, by which the bias wanders anyway.
    """
    say = progress or (lambda *state: None)
    rated = []
    for profile in candidates(before, hours):
        say(f"{profile.name} after what was recorded")
        rated.append(jointly(profile, before))
    order = sorted(rated, key=lambda item: (item.share < MIN_COVERAGE, item.score))
    plan = Continuation(before.subject, before.chamber, hours, tuple(order), target=target, recorded=before)
    return replace(plan, enough=_enough(plan))


def _enough(plan: Continuation) -> str:
    before = plan.recorded
    if not before.whole:
        return ""
    if plan.target is not None:
        return "target" if before.score <= plan.target else ""
    if np.all(before.sigma <= before.subject.floor):
        return "floor"
    return "gain" if plan.gain < LITTLE else ""


def candidates(before: RecordedSoak, hours: float) -> Iterator[Profile]:
    """Yield profiles over the whole range, over its parts, and over what was not seen yet."""
    for low, high in dict.fromkeys(_parts(before)):
        chamber = replace(before.chamber, low=low, high=high)
        sweeps = (ramps(chamber, hours, cycles) for cycles in CYCLES)
        for profile in possible(*sweeps, staircase(chamber, hours, STEPS, down=True)):
            yield replace(profile, name=f"{low:.4g} to {high:.4g} °C: {profile.name}")


def _parts(before: RecordedSoak) -> Iterator[tuple[float, float]]:
    low, high, least = before.chamber.low, before.chamber.high, before.subject.map.min_swing
    cuts = np.linspace(low, high, 4).tolist()
    ranges = [(low, high), *pairwise(cuts), (cuts[0], cuts[2]), (cuts[1], cuts[3])]
    seen = before.seen
    overlap = EDGE * before.chamber.swing
    ranges += [(low, min(seen[0] + overlap, high))] if seen[0] > low + overlap else []
    ranges += [(max(seen[1] - overlap, low), high)] if seen[1] < high - overlap else []
    yield from (pair for pair in ranges if pair[1] - pair[0] >= least)
