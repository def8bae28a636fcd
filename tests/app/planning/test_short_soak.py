"""A plan with a family foretells what units of the family will get, and what they would get without it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from driftlab.family.basis import SplineBasis
from driftlab.family.mixed_model import Family
from driftlab.family.unit_information import UnitInformation
from driftlab.planning.chamber import Chamber
from driftlab.planning.search import RatedProfile
from driftlab.planning.short_soak import expected, shortened
from driftlab.soak.blocks import SoakRows

LOW, HIGH = -10.0, 40.0
CHAMBER = Chamber(LOW, HIGH, 15.0, 5 / 60, 120.0)
NOISE, WALK = np.array([2.0]), np.array([0.05])


@lru_cache(maxsize=1)
def _family() -> Family:
    """A family of a Gaussian law that is known: a level, a slope, a wave."""
    knots = SplineBasis.covering(LOW, HIGH)
    u = (knots.peaks - 15) / 25
    shapes = np.stack([40 * np.ones_like(u), 30 * u, 20 * np.sin(3 * u)])
    Sigma = (shapes.T @ shapes + 1e-4 * np.eye(knots.q))[None]
    zero = np.zeros_like(Sigma)
    return Family(
        channel="gyro", bias_unit="rad/s", axes=("x",), first=knots.first, intervals=knots.intervals, step=knots.step,
        units=200, sampled=200, mu=50 * u[None] ** 2, mu_covariance=zero, Sigma=Sigma, Lambda=zero, lots={},
    )  # fmt: skip


@pytest.fixture(scope="module")
def plan() -> RatedProfile:
    return shortened(_family(), CHAMBER, 2.0, NOISE, WALK, 8.0).chosen


def test_units_that_are_soaked_so_get_the_sigma_that_is_foretold(plan: RatedProfile) -> None:
    family, profile = _family(), plan.profile
    t, T = profile.samples(CHAMBER.lag, int(profile.duration / 10))
    B, G = family.knots.values(T), family.knots.values(plan.temperature)
    rng, errors, own = np.random.default_rng(3), [], []
    root = np.linalg.cholesky(family.Sigma[0])
    step = profile.duration / len(t)
    for _ in range(300):
        c = family.mu[0] + root @ rng.normal(size=family.knots.q)
        walk = np.cumsum(rng.normal(size=len(t))) * WALK[0] * np.sqrt(step)
        bias = B @ c + walk + rng.normal(size=len(t)) * NOISE[0] / np.sqrt(step)
        rows = SoakRows(t, T, bias[:, None], np.full(len(t), step), {})
        found = family.posterior(UnitInformation.of("", ("x",), [rows], NOISE, WALK, family.knots.step))
        errors.append(G @ (found.c[0] - c))
        own.append([curve - G @ c for order in range(1, 6) for curve in _polynomials(T, bias, order, plan.temperature)])
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(plan.score, rel=0.15)
    best = np.sqrt(np.mean(np.square(own), axis=(0, 2))).min()
    assert plan.own_score == pytest.approx(best, rel=0.15)
    assert plan.score < 8.0 < plan.own_score


def _polynomials(T: np.ndarray, bias: np.ndarray, order: int, at: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return a least-squares polynomial beyond T: as it goes on, clamped, and straight on."""
    fit = np.polynomial.Chebyshev.fit(T, bias, order)
    inside = np.clip(at, T.min(), T.max())
    return fit(at), fit(inside), fit(inside) + (at - inside) * fit.deriv()(inside)


def test_the_shortest_that_reaches_the_aim_is_chosen_and_no_aim_is_promised_that_is_not() -> None:
    loose = shortened(_family(), CHAMBER, 2.0, NOISE, WALK, 8.0)
    tight = shortened(_family(), CHAMBER, 2.0, NOISE, WALK, 1.5)
    assert loose.reached
    assert loose.chosen.score <= 8.0
    assert not any(s.score <= 8.0 and s.profile.hours < 0.95 * loose.chosen.profile.hours for s in loose.tried)
    assert loose.chosen.profile.hours <= tight.chosen.profile.hours * (1 + 1e-9)
    none = shortened(_family(), CHAMBER, 2.0, NOISE, WALK, 1e-3)
    assert not none.reached
    assert none.own_hours is None
    assert none.chosen.score == min(s.score for s in none.tried)


def test_a_part_says_no_more_than_the_whole_where_the_bias_does_not_walk() -> None:
    still = shortened(_family(), CHAMBER, 2.0, NOISE, 1e-6 * WALK, None)
    at_most = [s.score for s in still.tried if np.isclose(s.profile.hours, 2.0, rtol=0.02)]
    assert at_most == sorted(at_most, reverse=True)
    assert still.reached


def test_a_family_whose_units_are_alike_needs_no_soak() -> None:
    family = _family().model_copy(update={"Sigma": 1e-6 * _family().Sigma})
    short = shortened(family, CHAMBER, 1.0, NOISE, WALK, None).chosen
    again = expected(family, CHAMBER, short.share, short.place, short.profile, NOISE, WALK)
    assert again.score == short.score < 0.1
