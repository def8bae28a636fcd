"""Foretold detectability of effects, beside what the loop then finds and beside textbook matrices."""

import numpy as np
import pytest
from loop_cases.signatures import dragged

from driftlab.identification.records import Evidence, Record
from driftlab.identification.result import search
from driftlab.identification.state import name_of
from driftlab.planning.detectability import MonteCarlo, effects_in, predict_detectability
from driftlab.planning.simulated_search import Information, measured, noises, planned, shapes
from driftlab.planning.unit_model import UnitModel
from driftlab.reports.plan_effects import lines, matrix, table
from driftlab.units import BiasUnit
from fusion_core.chunk import Chunk
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.relaxation import Relaxation
from fusion_plugins.effects.turn_on import TurnOn
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

WHITE, WALK = np.deg2rad(3.0 / 3600), np.deg2rad(1e-5)  # rad/s/sqrt(Hz), rad/s/sqrt(s)
HOURS = 3.0
DURATION = HOURS * 3600
AXES = ("x", "y")


def curve(T):
    x = (T - 15) / 25
    return np.outer(x + x**2 / 4, np.full(len(AXES), np.deg2rad(60 / 3600)))


UNIT = UnitModel(
    "gyro", AXES, BiasUnit("rad/s", "deg/h"), Polynomial(order=3), np.full(2, WHITE), np.full(2, WALK), "", curve, ""
)


def up_and_down(t, times=3):
    return -10 + 50 * (1 - np.abs(1 - 2 * (t / DURATION * times % 1)))


def up(t):
    return -10 + 50 * t / DURATION


def test_nats_are_those_of_the_whole_covariance():
    found = planned(UNIT, up_and_down, DURATION, rows=240)
    effects = [Hysteresis(width="8 K"), Relaxation(tau="10 min")]
    information = Information(found, UNIT, effects)
    n = len(found.columns.evidence)
    (noise, _) = noises(UNIT, found.columns.evidence.interval)
    S = noise.covariance(n) + 1e3 * noise.variance * np.ones((n, n))  # a level of which nothing is known
    B = found.columns.W[:, found.columns.of_map([])]
    h, r = (shapes(found, UNIT, effect, 0)[:, 0] for effect in effects)

    def left(*others):
        X = np.column_stack([B, *others]) / np.sqrt(noise.variance)
        white = np.linalg.inv(np.linalg.cholesky(S))
        A, y = white @ X, white @ h
        return 0.5 * len(AXES) * np.sum((y - A @ np.linalg.lstsq(A, y, rcond=1e-11)[0]) ** 2)

    own = np.ones(1)
    assert information.nats(0, own) == pytest.approx(left(), rel=0.05)
    assert information.left(0, own, [1]) == pytest.approx(left(r), rel=0.1)
    assert information.left(0, own, [0]) == pytest.approx(0.0, abs=1e-6 * information.nats(0, own))


@pytest.mark.parametrize("tau", ["2 min", "1 h"])
def test_the_size_of_what_settles_is_that_of_generalised_least_squares(tau):
    t = np.arange(1.0, DURATION + 1)
    rng, T = np.random.default_rng(3), up_and_down(t)
    steps, white = rng.normal(size=(2, len(t), len(AXES)))
    found = measured(UNIT, [(T, curve(T) + WALK * np.cumsum(steps, axis=0) + WHITE * white)], 1.0)
    settling = TurnOn(tau=tau)
    size, sigma = Information(found, UNIT, [settling]).size(0)
    columns = found.columns
    n, B = len(columns.evidence), columns.W[:, columns.of_map([])]
    (noise, _) = noises(UNIT, columns.evidence.interval)
    root = np.linalg.inv(np.linalg.cholesky(noise.covariance(n)))
    X = root @ np.column_stack([shapes(found, UNIT, settling, 0), np.ones(n), B])
    y = columns.W[:, columns.y[0]] * columns.scale[columns.y[0]]
    assert size[0] == pytest.approx(float(np.linalg.lstsq(X, root @ y)[0][0]), abs=0.1 * sigma[0])
    assert sigma[0] == pytest.approx(float(np.sqrt(np.linalg.pinv(X.T @ X, rcond=1e-11)[0, 0])), rel=0.05)
    assert abs(size[0]) < 4 * sigma[0]  # nothing settles in it


def made_up(effect, size, seed):
    """A recording with a play planted in it, as the loop has it, its bias made sample by sample."""
    t = np.arange(1.0, DURATION + 1)
    T, rng = up_and_down(t), np.random.default_rng(seed)
    slip = dragged(T, effect.width) - T
    bias = curve(T) + (size / np.ptp(slip) * slip)[:, None]
    bias = bias + WALK * np.cumsum(rng.normal(size=bias.shape), axis=0) + WHITE * rng.normal(size=bias.shape)
    means = [x.reshape(-1, 4, *x.shape[1:]).mean(axis=1) for x in (t, T, bias)]
    chunk = Chunk(means[0], {"temperature": means[1], "gyro": means[2]}, sensors=frozenset({"gyro"}))
    record = Record("made up", True, True, chunk, np.arange(0, len(chunk), 3))
    return Evidence((record,), "gyro", AXES, UNIT.unit, 12.0, 60.0), (T, bias)


def named(evidence):
    T = evidence.chunks[0]["temperature"]
    found = search(evidence, UNIT.map.basis((float(T.min()), float(T.max()))), lambda text: None)
    return {name_of(term.effect) for term in found.model}


@pytest.fixture(scope="module")
def play():
    """What is foretold of a hysteresis."""
    (found,) = predict_detectability(UNIT, up_and_down, DURATION, ["hysteresis"]).effects
    return found


def test_the_loop_finds_twice_the_smallest_size_and_not_half_of_it(play):
    large, small = (
        [named(made_up(play.effect, times * play.found_from, s)[0]) for s in range(4)] for times in (2, 0.5)
    )
    assert sum("hysteresis" in names for names in large) >= 3
    assert sum("hysteresis" in names for names in small) <= 1


def test_what_only_warms_up_cannot_show_a_loop():
    kinds = ["hysteresis", "thermal_rate", "drift"]
    seen, never = (predict_detectability(UNIT, body, DURATION, kinds) for body in (up_and_down, up))
    assert "hysteresis" in {item.name for item in seen.effects}
    assert "hysteresis" in never.silent
    assert never.only == "warms up"
    assert any(line.startswith("hysteresis: is not seen") and "bend of the map" in line for line in lines(never))
    names, rows = matrix(seen)
    assert len(table(never).rows) == len(never.effects) + len(never.silent)
    assert len(names) == len(rows)
    assert all(row[k] == ("", "") for k, (_, row) in enumerate(rows))


def test_less_noise_finds_smaller_effects(play):
    quiet = UnitModel(**{**UNIT.__dict__, "noise": UNIT.noise / 4, "walk": UNIT.walk / 4})
    (still,) = predict_detectability(quiet, up_and_down, DURATION, ["hysteresis"]).effects
    assert still.found_from == pytest.approx(play.found_from / 4, rel=0.35)
    assert still.left == play.left == {}


def test_what_was_recorded_says_how_large_an_effect_may_be():
    effect, size = Hysteresis(width="8 K"), np.deg2rad(12 / 3600)
    found = [effects_in(UNIT, [made_up(effect, size, s)[1]], 1.0, ["hysteresis"])[0] for s in range(3)]
    assert all(item.sure for item in found)
    assert np.mean([item.size for item in found]) == pytest.approx(size, rel=0.2)
    (none,) = effects_in(UNIT, [made_up(effect, 0.0, 0)[1]], 1.0, ["hysteresis"])
    assert not none.sure


@pytest.mark.parametrize("hours", [56, 10_000])
def test_the_means_of_a_long_plan_are_longer_and_no_more(hours):
    search = planned(UNIT, lambda t: 20.0 + 30.0 * np.sin(t / 5000.0), hours * 3600.0)
    assert 18_000 <= len(search.columns.evidence.chunks[0]) <= 20_000


@pytest.mark.parametrize("swing", [40.0, 140.0, 300.0, 5000.0])
def test_the_curves_of_a_wide_range_are_no_more_than_those_of_a_chamber(swing):
    """Inner products of all columns are kept, and an effect on the map's input has a set of curves for each lag."""
    unit = UnitModel(**{**UNIT.__dict__, "map": Spline()})
    search = planned(unit, lambda t: 20.0 + swing * (t / DURATION - 0.5), DURATION, rows=400)
    assert min(swing, 150) - 1 <= len(search.columns.of_map([])) <= 153


def test_the_fits_of_an_effect_are_let_go_of_with_it():
    search = planned(UNIT, up_and_down, DURATION, rows=240)
    effects = [Hysteresis(width="4 K"), Hysteresis(width="8 K")]
    own = [np.column_stack([shapes(search, UNIT, one, axis)[:, 0] for axis in (0, 1)]) for one in effects]
    sizes = MonteCarlo(search, UNIT, 1.0).smallest(effects, own, [1e-5, 1e-5], np.ones((2, 2), dtype=bool))
    assert np.all(np.isfinite(sizes))
    assert not search.squares._fits
