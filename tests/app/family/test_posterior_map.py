"""The map of a unit of which a part was soaked: nearer than without its family, and as sure as it says."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from driftlab.family import band_calibration
from driftlab.family.band_calibration import PARTS, measure_bands
from driftlab.family.bands import LEVELS
from driftlab.family.file import load_family, save_family
from driftlab.family.mixed_model import Family, fit_family, fit_some
from driftlab.family.posterior_map import UnitPosterior, unit_posterior, with_pooled_noise
from driftlab.family.unit_information import UnitInformation
from driftlab.soak.blocks import SoakRows
from fusion_core.contracts import ThermalMap
from fusion_core.host.registry import registry

AXES, LOW, HIGH, STEP, ROW = ("x", "y"), -10.0, 40.0, 2.5, 20.0
WHITE, WALK = np.array([2.0, 2.0]), np.array([0.02, 0.02])
T = np.linspace(LOW, HIGH, 81)


def _curve(seed: int) -> tuple[np.ndarray, ...]:
    """Return what a unit is dealt, by laws with heavy tails and skew: amounts of four shapes (4, 2)."""
    rng = np.random.default_rng(seed)
    dealt = [rng.standard_t(4, 2), rng.gamma(1.5, 1.0, 2) - 1.5, rng.laplace(0, 1, 2), rng.choice([-1.0, 1.0], 2)]
    return tuple(np.array([[40.0], [30.0], [20.0], [10.0]]) * np.stack(dealt))


def _bias(seed: int, temperature: np.ndarray) -> np.ndarray:
    u = (temperature - 15) / 25
    shapes = np.stack([np.ones_like(u), u, np.cos(2 * u), np.tanh(3 * u - 1)], axis=1)
    return shapes @ np.stack(_curve(seed)) + np.outer(50 * u**2, [1.0, -1.0])


def _unit(seed: int, begin: float = 0.0, share: float = 1.0, hours: float = 1.5, ways: int = 2) -> UnitInformation:
    rng = np.random.default_rng([seed, 7])
    N = round(hours * 3600 / ROW)
    t = ROW * (np.arange(N) + 0.5)
    part = begin + share * (1 - np.cos(ways * np.pi * np.arange(N) / N)) / 2
    temperature = LOW + part * (HIGH - LOW)
    noise = WHITE * rng.normal(size=(N, 2)) / np.sqrt(ROW)
    walk = np.cumsum(WALK * rng.normal(size=(N, 2)) * np.sqrt(ROW), axis=0)
    rows = SoakRows(t, temperature, _bias(seed, temperature) + noise + walk, np.full(N, ROW), {})
    return UnitInformation.of(f"{seed:04d}", AXES, [rows], WHITE, WALK, STEP)


@lru_cache(maxsize=1)
def _family() -> Family:
    units = [(_unit(seed), "") for seed in range(90)]
    family = fit_family(units, bias_unit="rad/s")
    return family.model_copy(update={"bands": measure_bands(family, units)})


@lru_cache(maxsize=2)
def _short(begin: float) -> list[UnitPosterior]:
    return [unit_posterior(_family(), _unit(1000 + k, begin, 0.4, 0.6)) for k in range(60)]


def _errors(found: list[UnitPosterior]) -> np.ndarray:
    grid = [known.family.knots.values(T) @ known.posterior.c.T for known in found]
    return np.stack([curve - _bias(1000 + k, T) for k, curve in enumerate(grid)])


def _truths() -> np.ndarray:
    return np.stack([_bias(1000 + k, T) for k in range(60)])


def _polynomial(known: UnitPosterior, order: int, tangent: bool) -> np.ndarray:
    """Return a unit's own polynomial, clamped or straight on beyond what it saw."""
    rows = known.soaked.recordings[0]
    low, high = rows.T.min(), rows.T.max()
    fit = np.polynomial.Chebyshev.fit
    curves = [fit(rows.T, values, order, domain=[low, high]) for values in rows.bias.T]
    inside = np.clip(T, low, high)
    more = (T - inside) if tangent else 0.0 * T
    return np.stack([curve(inside) + more * curve.deriv()(inside) for curve in curves], axis=1)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("begin", [0.0, 0.6])
def test_two_fifths_of_the_range_are_enough_with_a_family(begin: float) -> None:
    found = _short(begin)
    error = _rms(_errors(found))
    own = [
        _rms(np.stack([_polynomial(k, order, tangent) for k in found]) - _truths())
        for order in range(1, 6)
        for tangent in (False, True)
    ]  # the best polynomial in hindsight
    mean = _family().knots.values(T) @ _family().marginal().c.T - _truths()
    assert error < 0.5 * min(own)
    assert error < 0.5 * _rms(mean)


@pytest.mark.parametrize("begin", [0.0, 0.6])
def test_its_bands_hold_what_they_say(begin: float) -> None:
    found = _short(begin)
    sigma = np.stack([np.stack([np.interp(T, k.T, own) for own in k.sigma.T], axis=1) for k in found])
    inside = np.abs(_errors(found)) < 1.96 * sigma
    assert 0.91 < np.mean(inside) < 0.985  # 60 units: of some 150 independent errors
    assert _rms(_errors(found)) == pytest.approx(_rms(sigma), rel=0.25)


def test_the_file_says_the_curve_its_sigma_and_how_errors_go_together(tmp_path: Path) -> None:
    known = _short(0.0)[0]
    path = tmp_path / "map.json"
    known.map({"family": "family.json"}).save(path)
    settings = registry().classes(ThermalMap)["spline"].model_validate({"kind": "spline", "path": str(path)})
    assert isinstance(settings, ThermalMap)
    read, B = settings.load(), known.family.knots.values(known.T)
    assert read.domain == known.family.knots.domain
    np.testing.assert_allclose(read.bias(known.T), B @ known.posterior.c.T, rtol=1e-9, atol=1e-9)
    at = known.T[::4]  # where the error's grid is
    np.testing.assert_allclose(read.sigma(at), known.sigma[::4], rtol=1e-4)
    ends = np.array([LOW, HIGH])
    factor = known.band.factor(ends, STEP)
    E = known.family.knots.values(ends)
    for axis, C in enumerate(known.posterior.covariance):
        own = factor[:, axis, None] * E
        expected = np.sqrt((own[1] - own[0]) @ C @ (own[1] - own[0]))
        assert read.sigma(np.array([HIGH]), LOW)[0, axis] == pytest.approx(expected, rel=0.02)


def test_a_level_that_is_not_known_is_in_sigma_and_cancels_in_a_coast() -> None:
    family = _family()
    level = np.ones(family.knots.q)  # the splines add up to one: all coefficients alike are a level
    known = _short(0.0)[0]
    vague = replace(known.posterior, covariance=known.posterior.covariance + 100.0**2 * np.outer(level, level))
    one, other = known.map({}), replace(known, posterior=vague).map({})
    at = np.array([0.0])
    assert np.all(other.sigma(at) > 90)
    np.testing.assert_allclose(other.sigma(at, 5.0), one.sigma(at, 5.0), rtol=0.05, atol=1e-2)


def test_bands_measure_that_a_family_is_surer_than_it_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    units = [(_unit(seed), "") for seed in range(60)]
    family = fit_family(units)
    right = measure_bands(family, units)
    monkeypatch.setattr(band_calibration, "fit_some", lambda *given: _scaled(fit_some(*given), 1 / 9))
    narrow = measure_bands(family, units)
    assert right is not None
    assert narrow is not None
    part = right.parts.index((0.0, 0.4))
    ratio = np.array(narrow.factors[part][1]) / np.array(right.factors[part][1])
    assert np.all(ratio > 1.6)
    assert len(right.factors[part]) == len(LEVELS)


def test_a_part_in_which_no_unit_has_samples_is_left_out() -> None:
    """Units that were soaked at both ends of the range alone, with a hole of two thirds of it between."""
    units = [(_hole(_unit(seed)), "") for seed in range(12)]
    bands = measure_bands(fit_family(units), units)
    assert bands is not None
    assert (0.4, 0.6) not in {(round(a, 6), round(b, 6)) for a, b in bands.parts}
    assert len(bands.parts) == len(bands.factors) == len(bands.far) < len(PARTS)
    assert np.all(np.isfinite(bands.factors))
    assert np.all(np.isfinite(bands.far))


def _hole(soaked: UnitInformation) -> UnitInformation:
    pieces = []
    for rows in soaked.recordings:
        kept = (rows.T < LOW + 8) | (rows.T > HIGH - 8)
        for part in np.split(np.arange(len(kept)), np.flatnonzero(np.diff(kept)) + 1):
            if kept[part[0]]:
                pieces.append(SoakRows(rows.t[part], rows.T[part], rows.bias[part], rows.span[part], {}))
    return UnitInformation.of(soaked.unit, AXES, pieces, WHITE, WALK, STEP)


def _scaled(family: Family, by: float) -> Family:
    return family.model_copy(update={"Sigma": family.Sigma * by})


def test_too_few_units_measure_nothing() -> None:
    units = [(_unit(seed), "") for seed in range(6)]
    family = fit_family(units)
    assert measure_bands(family, units) is None
    known = unit_posterior(family, _unit(500, 0.0, 0.4))
    assert np.all(known.band.factor(T, STEP) == 1)
    assert known.far is None


def test_a_unit_with_a_bend_of_its_own_is_far_from_its_family() -> None:
    soaked = _unit(2000, 0.0, 0.5)
    rows = soaked.recordings[0]
    bump = np.outer(60 * np.exp(-(((rows.T - 5) / 3) ** 2)), [0.0, 1.0])
    bent = UnitInformation.of("bent", AXES, [replace(rows, bias=rows.bias + bump)], WHITE, WALK, STEP)
    plain, odd = unit_posterior(_family(), soaked).far, unit_posterior(_family(), bent).far
    assert plain is not None
    assert odd is not None
    assert np.all(plain < 1)
    assert odd[0] == pytest.approx(plain[0], rel=0.2)
    assert odd[1] > 3


def test_a_soak_one_way_takes_its_walk_from_the_family() -> None:
    one_way = _unit(3000, 0.0, 1.0, 0.5, ways=1)
    found = with_pooled_noise(replace(one_way, walk=10 * WALK), _family())
    np.testing.assert_allclose(found.walk, WALK, rtol=0.35)
    np.testing.assert_allclose(found.white, WHITE, rtol=0.25)


def test_the_bands_are_kept_with_the_family(tmp_path: Path) -> None:
    path = tmp_path / "family.json"
    save_family(path, _family())
    again = load_family(path)
    assert again.bands == _family().bands
