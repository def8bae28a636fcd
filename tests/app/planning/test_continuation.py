"""Continued soaks: the sigma that is foretold is the one that the joint fit then has."""

from dataclasses import replace

import numpy as np
import pytest

from driftlab.maps.hysteresis.memory import memory_of
from driftlab.planning.chamber import Chamber, ramps
from driftlab.planning.continuation import continuation_of, jointly, of_samples
from driftlab.planning.unit_model import UnitModel
from driftlab.reports import plan_continuation
from driftlab.soak.blocks import brief
from driftlab.units import BiasUnit
from fusion_plugins.thermal_maps.polynomial import Polynomial

WHITE, WALK = np.deg2rad(3.0 / 3600), np.deg2rad(2e-5)
CHAMBER = Chamber(-10.0, 40.0, 25.0, 2 / 60, 120.0)
DT = 2.0
SUBJECT = UnitModel(
    "gyro", ("x", "y", "z"), BiasUnit("rad/s", "deg/h"), Polynomial(order=3), np.full(3, WHITE), np.full(3, 50 * WALK),
    "a guess", None, "",
)  # fmt: skip


def soak(profiles, seed):
    """Return temperature and bias of profiles one after the other, the walk going on."""
    T = [p.samples(CHAMBER.lag, int(p.duration / DT))[1] for p in profiles]
    whole, rng = np.concatenate(T), np.random.default_rng(seed)
    steps, white = rng.normal(size=(2, len(whole), 3))
    curve = np.outer((whole - 15) / 25, np.full(3, 3e-4))
    bias = curve + np.cumsum(steps, axis=0) * WALK * np.sqrt(DT) + white * WHITE / np.sqrt(DT)
    cuts = np.cumsum([len(part) for part in T])[:-1]
    return list(zip(T, np.split(bias, cuts), strict=True))


def test_the_sigma_that_is_foretold_is_that_of_the_joint_fit():
    profile, ratios = ramps(CHAMBER, 3.0, 1), []
    for seed in range(6):
        first, second = soak([profile, profile], seed)
        foretold = jointly(profile, of_samples([first], DT, SUBJECT, CHAMBER))
        both = of_samples([first, second], DT, SUBJECT, CHAMBER)
        ratios.append(foretold.rms / np.sqrt(np.nanmean(both.sigma**2, axis=0)))
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.15)


def test_measured_noise_stands_in_place_of_a_guess():
    found = [of_samples(soak([ramps(CHAMBER, 6.0, 2)], s), DT, SUBJECT, CHAMBER).subject for s in range(6)]
    assert np.mean([item.noise for item in found]) == pytest.approx(WHITE, rel=0.15)
    assert np.mean([item.walk for item in found]) == pytest.approx(WALK, rel=0.3)


def test_what_was_not_seen_is_not_known_and_is_recorded_first():
    narrow = replace(CHAMBER, high=20.0, start=10.0)
    before = of_samples(soak([ramps(narrow, 3.0, 2)], 0), DT, SUBJECT, CHAMBER)
    unseen = before.temperature > before.seen[1] + 2
    assert np.isnan(before.sigma[unseen]).all()
    assert np.isfinite(before.sigma[before.temperature < before.seen[1]]).all()
    found = continuation_of(before, 3.0, 1.0)  # any sigma would do, were it known
    assert found.enough == ""
    assert found.chosen.covered[1] > 38
    assert "the rest of the range is not known" in plan_continuation.headline(found)


def test_enough_is_what_reaches_the_target_or_gains_too_little():
    before = of_samples(soak([ramps(CHAMBER, 6.0, 3)], 1), DT, SUBJECT, CHAMBER)
    assert continuation_of(before, 1.0, 1.01 * before.score).enough == "target"
    assert continuation_of(before, 1.0, 0.99 * before.score).enough == ""
    loud = replace(before, subject=replace(before.subject, noise=before.subject.noise * 1e3))
    assert continuation_of(loud, 1.0, None).enough == "floor"
    text = plan_continuation.headline(continuation_of(before, 1.0, 1.01 * before.score))
    assert text.startswith("enough: ")
    assert "was asked for" in text


def test_a_part_of_the_range_is_offered_and_named():
    before = of_samples(soak([ramps(CHAMBER, 3.0, 1)], 2), DT, SUBJECT, CHAMBER)
    found = continuation_of(before, 2.0, None)
    names = [item.profile.name for item in found.judged]
    assert any(name.startswith("-10 to 40 °C: ") for name in names)
    assert any(name.startswith("-10 to 6.667 °C: ") for name in names)
    scores = [item.score for item in found.judged]
    assert scores == sorted(scores)
    assert len(plan_continuation.profiles(found).rows) == 7


def test_what_the_kind_cannot_follow_is_not_recorded_away():
    ((T, bias),) = soak([ramps(CHAMBER, 6.0, 3)], 3)
    bent = bias + 3e-4 * np.tanh((T - 15) / 2)[:, None]
    found = continuation_of(of_samples([(T, bent)], DT, SUBJECT, CHAMBER), 2.0, 1e-7)
    assert found.enough == ""
    assert "is not reached by recording more" in plan_continuation.headline(found)
    assert any("kind: polynomial cannot follow" in line for line in plan_continuation.lines(found))


def test_half_of_what_is_between_up_and_down_is_not_known_and_stays():
    ((T, bias),) = soak([ramps(CHAMBER, 6.0, 2)], 0)
    half = 30 * np.deg2rad(1 / 3600)
    bias = bias + half * np.sign(np.gradient(T))[:, None] * (0.9 + 0.1 * np.cos(T / 50))[:, None]
    memory = memory_of(brief(T, bias, [0], DT))
    before = of_samples([(T, bias)], DT, SUBJECT, CHAMBER, memory)
    assert memory.answer == "seen"
    assert before.score == pytest.approx(half, rel=0.15)
    found = continuation_of(before, 3.0, half / 2)
    assert found.enough == ""
    assert found.chosen.score == pytest.approx(half, rel=0.15)
    assert "is not reached by recording more" in plan_continuation.headline(found)
    assert any("between up and down" in line and "hysteresis" in line for line in plan_continuation.lines(found))
    assert of_samples([(T, bias)], DT, SUBJECT, CHAMBER).score < half / 2  # the curve between them alone
