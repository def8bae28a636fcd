"""Effects common to units are found where none of them shows one alone, and nothing where there is nothing."""

from __future__ import annotations

import json
from dataclasses import replace

import family
import numpy as np
import pytest
from families_at_rest import AXES, DEG_H, effect_of, of_other_type, planted, soaked
from loop_cases.signatures import dragged
from statsmodels.stats.meta_analysis import combine_effects

from driftlab.family.basis import SplineBasis
from driftlab.family.contrasts import UnitRows, without_noise
from driftlab.family.partitions import in_partitions
from driftlab.family.shared_effect import without_effects
from driftlab.family.shared_effect_search import Offer, between, contrasts_of, gains, mean_of, of_size
from driftlab.family.shared_effects import SharedEffects, find_common, sentences
from driftlab.family.unit_information import UnitInformation
from driftlab.soak.blocks import SoakRows
from driftlab.units import BiasUnit

PLAY = effect_of("hysteresis", width=6.0)
# deg/h a K: 0.9 standard deviations of what one unit says of an axis, 1.6 of three; the fast gate of one unit's loop,
# sqrt(2 (log 54 + 5)), is at 4.2
THIRD = 0.1
UNIT = BiasUnit("rad/s", "deg/h")


def _apart(found: SharedEffects, own: UnitInformation, lot: str) -> UnitInformation:
    return without_effects(own, lot, found.effects, found.noise.get(own.unit))


def _sizes(n: int, seed: int, size: float = THIRD) -> np.ndarray:
    return size * (1 + 0.3 * np.random.default_rng(seed).normal(size=(n, 3)))


@pytest.fixture(scope="module")
def of_a_third() -> tuple[list[family.Unit], list[tuple[UnitInformation, str]], SharedEffects]:
    dealt = family.deal(100, seed=41)
    units = planted(dealt, PLAY, _sizes(100, 41), 41)
    return dealt, units, find_common(units)


def test_a_hysteresis_of_a_third_of_what_one_unit_shows_is_named(
    of_a_third: tuple[list[family.Unit], list[tuple[UnitInformation, str]], SharedEffects],
) -> None:
    _, units, found = of_a_third
    (effect,) = found.effects
    assert found.verdict == "explained"
    assert effect.effect.kind == "hysteresis"
    assert 4.5 < effect.effect.hyper_parameters["width"] < 8.0
    np.testing.assert_array_less(np.abs(effect.mean.ravel() / DEG_H - THIRD), 4 * effect.sigma.ravel() / DEG_H)
    alone = contrasts_of(in_partitions(units), [Offer(PLAY, 1)], ())
    assert np.median(np.sqrt(alone.information)) * THIRD * DEG_H < 1.2  # what one unit has, in its own deviation
    (said,) = sentences(found, UNIT, AXES)
    assert said.startswith("hysteresis of temperature, width")
    assert "deg/h/K" in said


def test_maps_get_better_with_it_and_units_have_what_they_were_dealt(
    of_a_third: tuple[list[family.Unit], list[tuple[UnitInformation, str]], SharedEffects],
) -> None:
    dealt, units, found = of_a_third
    T = np.linspace(family.LOW + 1, family.HIGH - 1, 100)
    errors = np.zeros((2, len(units), 3))
    for k, (unit, (own, lot)) in enumerate(zip(dealt, units, strict=True)):
        for j, one in enumerate((own, _apart(found, own, lot))):
            for axis in range(3):
                c = np.linalg.lstsq(one.J[axis], one.h[axis], rcond=1e-10)[0]
                errors[j, k, axis] = np.mean((one.knots.values(T) @ c - unit.bias(T)[:, axis]) ** 2)
    without, within = np.sqrt(errors.mean(axis=(1, 2)))
    assert within < 0.98 * without
    c = np.stack([found.of_units[own.unit][0].c[:, 0] for own, _ in units]) / DEG_H
    sigma = np.stack([found.of_units[own.unit][0].sigma[:, 0] for own, _ in units]) / DEG_H
    off = (c - _sizes(100, 41)) / sigma
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.4


def test_it_comes_back_from_json(
    of_a_third: tuple[list[family.Unit], list[tuple[UnitInformation, str]], SharedEffects],
) -> None:
    _, units, found = of_a_third
    content = json.dumps(found.model_dump(mode="json"))
    again = SharedEffects.model_validate(json.loads(content))
    assert json.dumps(again.model_dump(mode="json")) == content
    own, lot = units[0]
    fresh = found.model_copy(update={"noise": {}})
    np.testing.assert_allclose(_apart(again, own, lot).h, _apart(fresh, own, lot).h, rtol=1e-10)
    np.testing.assert_allclose(_apart(again, own, lot).white, _apart(found, own, lot).white, rtol=0.02)


def test_signs_that_differ_from_unit_to_unit_are_seen() -> None:
    n = 40
    signs = np.random.default_rng(5).choice([-1.0, 1.0], size=(n, 3))
    found = find_common(planted(family.deal(n, seed=52), PLAY, 2 * signs * _sizes(n, 52), 52))
    (effect,) = found.effects
    assert effect.effect.kind == "hysteresis"
    assert effect.of_size > effect.price > effect.of_mean
    np.testing.assert_allclose(effect.spread.ravel() / DEG_H, 2 * THIRD, rtol=0.35)
    assert "of either sign" in sentences(found, UNIT, AXES)[0]


def test_a_lot_that_has_it_alone_is_named() -> None:
    dealt = family.deal(40, seed=63, lots=5)
    has = np.array([[unit.lot == "L03"] for unit in dealt])
    found = find_common(planted(dealt, PLAY, has * _sizes(40, 63, 2 * THIRD), 63))
    (effect,) = found.effects
    assert effect.effect.kind == "hysteresis"
    assert [lot.lot for lot in effect.lots if lot.has] == ["L03"]
    assert effect.differs < 1e-3
    assert effect.others is not None
    np.testing.assert_array_less(effect.others.mean, effect.mean / 2)
    assert "in lot L03" in sentences(found, UNIT, AXES)[0]


def test_a_lag_is_one_of_the_temperature_that_every_map_sees() -> None:
    found = find_common(planted(family.deal(20, seed=8), effect_of("thermal_lag", tau=20.0), np.ones((20, 3)), 8))
    (effect,) = found.effects
    assert effect.effect.kind == "thermal_lag"
    assert effect.effect.hyper_parameters["tau"] == pytest.approx(20.0, rel=0.1)


@pytest.mark.parametrize(("colour", "seed"), [("white", 101), ("changing", 102), ("coloured", 103)])
def test_families_without_any_effect_have_none(colour: str, seed: int) -> None:
    found = find_common(of_other_type(24, seed, colour))
    assert found.verdict == "nothing_common"
    assert found.effects == ()
    assert sentences(found, UNIT, AXES) == [f"No effect of {found.tried} candidates is common to the 24 units."]


def test_a_clean_family_of_the_example_has_none() -> None:
    assert find_common(soaked(family.deal(24, seed=77), 77)).verdict == "nothing_common"


def test_too_few_units_are_not_asked() -> None:
    found = find_common([])
    assert found.verdict == "nothing_common"
    assert "10 are needed" in sentences(found, UNIT, AXES)[0]


def test_coefficients_are_those_of_dense_generalised_least_squares() -> None:
    unit = planted(family.deal(1, seed=9), PLAY, np.full((1, 3), 0.5), 9)[0][0]
    (rows,) = unit.recordings
    half = SoakRows(rows.t[::2], rows.T[::2], rows.bias[::2], rows.span[::2], {})  # as many as are not averaged
    unit = UnitInformation.of("a", AXES, [half], unit.white, unit.walk, 2.5)
    shown = contrasts_of(in_partitions([(unit, "")]), [Offer(PLAY, 1)], ())
    T = without_noise(half.T)
    low = dragged(T, 6.0) - T
    knots = SplineBasis.covering(*unit.knots.domain, 1.25)
    for axis in range(3):
        since = half.t - half.t[0]
        V = unit.walk[axis] ** 2 * np.minimum.outer(since, since) + np.diag(unit.white[axis] ** 2 / half.span)
        L = np.linalg.cholesky(V)
        X = np.linalg.solve(L, np.column_stack([low, knots.values(half.T)]))
        c = np.linalg.lstsq(X, np.linalg.solve(L, half.bias[:, axis]), rcond=1e-10)[0]
        beside = X[:, 0] - X[:, 1:] @ np.linalg.lstsq(X[:, 1:], X[:, 0], rcond=1e-10)[0]
        assert shown.c[0, axis, 0] == pytest.approx(c[0], rel=1e-4)
        assert shown.information[0, axis, 0] == pytest.approx(beside @ beside, rel=1e-4)


def test_placebos_have_the_noise_that_rows_have() -> None:
    rng = np.random.default_rng(3)
    columns = UnitRows(soaked(family.deal(1, seed=4), 4)[0][0])
    drawn = []
    for _ in range(200):
        noise = [rng.normal(size=len(r)) for r in columns.r]
        columns.r = [e - Q @ (Q.T @ e) for Q, e in zip(columns.Q, noise, strict=True)]
        drawn.append(columns.contrasts([PLAY], [1]))
    c = np.stack([one.c * np.sqrt(one.information) for one in drawn])
    placebos = np.stack([one.placebos for one in drawn])
    held = np.any(placebos != 0, axis=0)
    for sample in (c.reshape(200, -1), placebos[:, held]):
        np.testing.assert_allclose(np.mean(sample**2, axis=0), 1.0, atol=0.4)  # four deviations of 200
    together = np.corrcoef(np.column_stack([c[:, 0, 0], placebos[:, 0, 0][:, held[0, 0]]]).T)
    np.testing.assert_allclose(together, np.eye(len(together)), atol=0.3)
    z = of_size(c[:, :, 0], np.ones((200, 3)), placebos[:, :, 0])
    assert np.all(np.abs(z) < 4)


def test_the_spread_of_units_is_that_of_statsmodels() -> None:
    rng = np.random.default_rng(12)
    v = np.exp(rng.normal(size=(40, 3)))
    c = 0.7 + rng.normal(size=(40, 3)) * np.sqrt(v + np.array([0.0, 0.5, 4.0]))
    s2 = between(c, v)
    m, sigma, _ = mean_of(c, v, s2)
    for k in range(3):
        other = combine_effects(c[:, k], v[:, k], method_re="iterated", atol=1e-12, maxiter=10_000)
        assert s2[k] == pytest.approx(max(other.tau2, 0.0), rel=1e-5, abs=1e-6)
        if s2[k] > 0:
            assert m[k] == pytest.approx(other.mean_effect_re, rel=1e-6)
    again = mean_of(np.concatenate([c, c]), np.concatenate([v, v]), s2)[1]
    np.testing.assert_allclose(again, sigma / np.sqrt(2), rtol=0.02)


def test_gains_are_ratios_of_normal_densities() -> None:
    from scipy.stats import norm

    c, v, m, s2 = np.array([[1.3]]), np.array([[0.4]]), np.array([0.9]), np.array([0.25])
    expected = norm.logpdf(1.3, 0.9, np.sqrt(0.65)) - norm.logpdf(1.3, 0, np.sqrt(0.4))
    assert gains(c, v, m, s2)[0, 0] == pytest.approx(expected)
    assert gains(c, np.array([[np.inf]]), m, s2)[0, 0] == 0.0


def test_the_thermometers_noise_is_no_lag() -> None:
    rng = np.random.default_rng(2)
    t = np.linspace(0, 1, 700)
    T = 40 * np.sin(3 * t)
    found = without_noise(T + 0.01 * rng.normal(size=700))
    assert np.std(found - T) < 0.005
    np.testing.assert_allclose(without_noise(T), T, atol=1e-5)


def test_a_unit_without_the_effects_says_of_its_curve_what_the_dense_covariance_does(
    of_a_third: tuple[list[family.Unit], list[tuple[UnitInformation, str]], SharedEffects],
) -> None:
    _, units, found = of_a_third
    own, lot = units[3]
    apart = _apart(found, own, lot)
    (rows,), (effect,) = own.recordings, found.effects
    since, z = rows.t - rows.t[0], _shown(effect.effect, rows)
    law, B = effect.law_of(lot), own.knots.values(rows.T)
    V = apart.walk[0] ** 2 * np.minimum.outer(since, since) + np.diag(apart.white[0] ** 2 / rows.span)
    V += law.spread[0, 0] ** 2 * np.outer(z, z)
    y = rows.bias[:, 0] - law.mean[0, 0] * z
    np.testing.assert_allclose(apart.J[0], B.T @ np.linalg.solve(V, B), rtol=1e-6, atol=1e-6 * np.max(apart.J[0]))
    np.testing.assert_allclose(apart.h[0], B.T @ np.linalg.solve(V, y), rtol=1e-6, atol=1e-6 * np.max(abs(apart.h[0])))


def _shown(effect: object, rows: SoakRows) -> np.ndarray:
    from fusion_core.chunk import Chunk

    chunk = Chunk(rows.t, {"temperature": without_noise(rows.T)})
    return np.asarray(effect.signature(chunk, None)[0][:, 0, 0])  # type: ignore[attr-defined]


def test_more_units_than_the_sample_all_have_their_sizes() -> None:
    units = planted(family.deal(40, seed=21), PLAY, _sizes(40, 21, 4 * THIRD), 21)
    found = find_common(units, sample=20)
    assert (found.units, found.searched) == (40, 20)
    assert set(found.of_units) == {own.unit for own, _ in units}
    assert "drawn at random" in sentences(found, UNIT, AXES)[-1]
    assert "its phase is no property of a unit" in [one.reason for one in found.rejected]


def test_a_unit_that_lacks_what_an_effect_reads_has_none_of_it() -> None:
    rng = np.random.default_rng(6)
    units = []
    for k, (own, lot) in enumerate(soaked(family.deal(16, seed=31), 31)):
        (rows,) = own.recordings
        voltage = 5 + np.cumsum(0.01 * rng.normal(size=len(rows.t)))
        more = replace(rows, bias=rows.bias + 10 * DEG_H * (voltage - 5)[:, None])
        if k != 5:
            more = replace(more, channels={"voltage": voltage})
        units.append((UnitInformation.of(own.unit, AXES, [more], own.white, own.walk, 2.5), lot))
    found = find_common(units)
    (effect,) = found.effects
    assert effect.effect.subject == "voltage"
    np.testing.assert_allclose(effect.mean[:, 0] / DEG_H, 10.0, rtol=0.1)
    np.testing.assert_allclose(found.of_units["0005"][0].c, effect.mean, rtol=1e-12)
    assert _apart(found, *units[5]).count == units[5][0].count
