"""A family recovered from its units: mean, spread, lots, and what follows for a unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import other_families as made
import pytest
from numpy.testing import assert_allclose

from driftlab.family import mixed_model
from driftlab.family.mixed_model import Family, fit_family
from driftlab.family.unit_information import UnitInformation

SIZE = 1e-4


def soaked(units: list[made.Made], seed: int, d: int = 1) -> list[tuple[UnitInformation, str]]:
    return [(unit.soaked(seed, ("x", "y", "z")[:d]), unit.lot) for unit in units]


def spread(family: Family, axis: int = 0) -> np.ndarray:
    B = family.knots.values(made.GRID)
    return np.asarray(np.sqrt(np.einsum("ti,ij,tj->t", B, family.Sigma[axis], B)))


@pytest.fixture(scope="module")
def units() -> list[made.Made]:
    return made.deal("polynomial", 150, 11, d=2, lots=3, size=SIZE)


@pytest.fixture(scope="module")
def family(units: list[made.Made]) -> Family:
    return fit_family(soaked(units, 11, 2))


def test_mean_and_spread_are_those_of_the_curves(family: Family, units: list[made.Made]) -> None:
    curves = np.array([unit.curve for unit in units])
    B = family.knots.values(made.GRID)
    sure = np.sqrt(np.einsum("ti,aij,tj->at", B, family.mu_covariance, B)).T
    assert np.max(np.abs(B @ family.mu.T - curves.mean(axis=0)) / sure) < 1.0  # the mean of the very units
    for axis in range(2):
        ratio = spread(family, axis) / np.std(curves[:, :, axis], axis=0, ddof=1)
        assert np.all(np.abs(ratio - 1) < 2 / np.sqrt(2 * len(units)))
    assert np.all(family.moved < 2e-3)


def test_wild_units_change_little(family: Family, units: list[made.Made]) -> None:
    wild = [replace(unit, curve=unit.curve.copy()) for unit in units]
    rng = np.random.default_rng(0)
    for k in rng.choice(len(wild), round(0.05 * len(wild)), replace=False):
        wild[k].curve += SIZE * rng.normal(0, 20, size=2) * np.tanh((made.GRID[:, None] - rng.uniform(0, 40)) / 4)
    found = fit_family(soaked(wild, 11, 2))
    B = found.knots.values(made.GRID)
    sure = np.sqrt(np.einsum("ti,aij,tj->at", B, family.mu_covariance, B)).T
    assert np.max(np.abs(B @ (found.mu - family.mu).T) / sure) < 1.0
    assert np.all(np.abs(spread(found) / spread(family) - 1) < 0.15)
    assert len(found.weights) >= round(0.05 * len(wild))
    assert not family.weights


@pytest.mark.parametrize("kind", ["steps", "rough"])
def test_units_that_saw_half_of_the_range_make_the_family_of_all_of_it(kind: str) -> None:
    units = made.deal(kind, 150, 12, size=SIZE, halves=True)
    family = fit_family(soaked(units, 12))
    curves = np.array([unit.curve[:, 0] for unit in units])
    middle = np.subtract(*np.percentile(curves, [75, 25], axis=0)) / 1.349
    both = np.minimum(middle, np.std(curves, axis=0)), np.maximum(middle, np.std(curves, axis=0))
    assert np.all(spread(family) > 0.75 * both[0])
    assert np.all(spread(family) < 1.5 * both[1])


def test_a_posterior_holds_what_it_says_on_units_that_the_family_has_not_seen() -> None:
    units = made.deal("together", 90, 13, size=SIZE)
    family = fit_family(soaked(units[:60], 13))
    B = family.knots.values(made.GRID)
    off, own = [], []
    for unit in units[60:]:
        half = replace(unit, part=(0.0, 0.4))
        found = family.posterior(half.soaked(14, ("x",)), unit.lot)
        sigma = np.sqrt(np.einsum("ti,ij,tj->t", B, found.covariance[0], B))
        off.append((B @ found.c[0] - unit.curve[:, 0]) / sigma)
        own.append(np.sqrt(np.mean((B @ found.c[0] - unit.curve[:, 0]) ** 2)))
    mean = [np.sqrt(np.mean((B @ family.mu[0] - unit.curve[:, 0]) ** 2)) for unit in units[60:]]
    assert 0.85 < np.mean(np.abs(off) < 1.96) <= 1.0
    assert np.median(own) < 0.3 * np.median(mean)


def test_a_posterior_is_ridge_regression_of_the_rows(family: Family, units: list[made.Made]) -> None:
    """With the covariance of white noise and walk written down, and the root of the prior as further rows."""
    own = units[4].soaked(15, ("x", "y"))
    rows, (low, _) = own.recordings[0], family.knots.domain
    assert low == own.knots.domain[0]
    before, found = family.marginal(), family.posterior(own, "unheard of")
    for axis in range(2):
        t = rows.t - rows.t[0]
        V = own.walk[axis] ** 2 * np.minimum(t[:, None], t) + np.diag(own.white[axis] ** 2 / rows.span)
        root = np.linalg.inv(np.linalg.cholesky(V))
        values, vectors = np.linalg.eigh(before.covariance[axis])
        prior = (vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))).T
        X = np.vstack([root @ family.knots.values(rows.T), prior])
        y = np.concatenate([root @ rows.bias[:, axis], prior @ before.c[axis]])
        scale = np.linalg.norm(X, axis=0)
        c = np.linalg.lstsq(X / scale, y, rcond=None)[0] / scale
        assert_allclose(found.c[axis], c, atol=1e-4 * SIZE)


def test_what_was_not_soaked_is_the_family(family: Family) -> None:
    assert_allclose(family.posterior(None).c, family.mu)
    assert_allclose(family.posterior(None).covariance, family.Sigma + family.Lambda + family.mu_covariance)
    known = family.marginal("L1")
    assert_allclose(known.c, family.mu + family.lots["L1"].shift)


def test_a_shifted_lot_is_a_lots_matter() -> None:
    units = made.deal("polynomial", 120, 16, lots=6, size=SIZE)
    for unit in units:
        unit.curve = unit.curve + (2.0 * SIZE if unit.lot == "L2" else 0.0)
    found = fit_family(soaked(units, 16))
    B = found.knots.values(made.GRID)
    shifts = {name: float(np.mean(B @ lot.shift[0])) for name, lot in found.lots.items()}
    assert max(shifts, key=lambda name: abs(shifts[name])) == "L2"
    assert 1.0 * SIZE < shifts["L2"] - np.mean([shifts[name] for name in shifts if name != "L2"]) < 3.0 * SIZE
    new, known = found.marginal("L9"), found.marginal("L2")
    assert np.trace(new.covariance[0]) > np.trace(known.covariance[0])


def test_one_lot_has_no_shift() -> None:
    found = fit_family(soaked(made.deal("polynomial", 12, 17, size=SIZE), 17))
    assert_allclose(found.lots["L0"].shift, 0.0)
    assert_allclose(found.marginal("L0").covariance, found.marginal("other").covariance)


def test_a_temperature_that_two_units_saw_is_not_the_familys() -> None:
    units = made.deal("polynomial", 20, 18, size=SIZE)
    for unit in units[2:]:
        unit.part = (0.0, 0.6)
    found = fit_family(soaked(units, 18))
    assert found.knots.domain == (-20.0, 30.0)
    whole = found.posterior(units[0].soaked(18, ("x",)))  # what it says beyond is let go
    B = found.knots.values(made.GRID[:50])
    assert_allclose(B @ whole.c[0], units[0].curve[:50, 0], atol=0.1 * SIZE)


def test_a_sample_makes_the_same_family_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    units = soaked(made.deal("polynomial", 120, 19, lots=4, size=SIZE), 19)
    whole = fit_family(units)
    monkeypatch.setattr(mixed_model, "SAMPLE", 60)
    found, again = fit_family(units, seed=1), fit_family(units, seed=1)
    assert (whole.sampled, found.sampled, found.units) == (120, 60, 120)
    assert_allclose(found.mu, again.mu)
    B = found.knots.values(made.GRID)
    sure = np.sqrt(np.einsum("ti,ij,tj->t", B, whole.mu_covariance[0], B))
    assert np.max(np.abs(B @ (found.mu - whole.mu)[0]) / sure) < 1.0  # the mean is of all units


def test_who_cannot_be_a_family_is_told() -> None:
    units = soaked(made.deal("polynomial", 4, 20, size=SIZE), 20)
    with pytest.raises(ValueError, match="2 units to learn from; at least 3 are needed"):
        fit_family(units[:2])
    other = made.deal("polynomial", 1, 20, d=2, size=SIZE)[0].soaked(20, ("x", "y"))
    with pytest.raises(ValueError, match="unit 0000 has axes x, y and knots"):
        fit_family([*units, (other, "")])
    with pytest.raises(ValueError, match="soak units of one family alike"):
        fit_family(units).posterior(other)


def test_what_units_hardly_entered_is_not_in_the_domain():
    """Thermometers of coarse steps end a little beyond the range: no curve is known over the interval that follows."""
    units = made.deal("polynomial", 12, 3, size=SIZE)
    pairs = []
    for unit, lot in soaked(units, 3):
        (rows,) = unit.recordings
        low, high = unit.knots.domain
        wider = replace(rows, T=low - 0.2 + (high - low + 0.4) * (rows.T - rows.T.min()) / np.ptp(rows.T))
        pairs.append((UnitInformation.of(unit.unit, unit.axes, [wider], unit.white, unit.walk, 2.5), lot))
    assert pairs[0][0].knots.intervals == soaked(units, 3)[0][0].knots.intervals + 2
    family = fit_family(pairs)
    assert family.knots == soaked(units, 3)[0][0].knots
    assert np.max(np.sqrt(np.diagonal(family.mu_covariance[0]))) < 3 * SIZE


def test_units_soaked_within_less_than_an_interval_have_what_they_entered():
    units = made.deal("polynomial", 6, 4, size=SIZE)
    rows = [unit.soaked(4, ("x",)).recordings[0] for unit in units]
    short = [replace(own, T=21.5 + 2.0 * (own.T - own.T.min()) / np.ptp(own.T)) for own in rows]
    noise = np.array([SIZE]), np.array([1e-3 * SIZE])
    family = fit_family([(UnitInformation.of(f"{k}", ("x",), [own], *noise, 2.5), "") for k, own in enumerate(short)])
    assert family.knots.domain == (20.0, 25.0)
