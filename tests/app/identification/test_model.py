"""The model fitted to all rows: coefficients, sigma, starts, and the new map."""

import numpy as np
import pytest
from rows_at_rest import C_PLAY, C_VOLTAGE, PLAY, SLIP, VOLTAGE, evidence, known, search_of, signature

from driftlab.identification.least_squares import Term
from driftlab.identification.model import explained_map, joint
from fusion_plugins.effects.g_sensitivity import GSensitivity
from fusion_plugins.thermal_maps.polynomial import Polynomial


def test_coefficients_are_within_their_sigma():
    """Over 20 draws (estimate - truth) / sigma is standard normal: rms within 4 deviations of 1."""
    off = []
    for seed in range(20):
        fit = joint(search_of(evidence(known, seed=seed), (Term(PLAY), Term(VOLTAGE))))
        for effect, truth in zip(fit.effects, (C_PLAY, C_VOLTAGE), strict=True):
            off.append((np.array(effect.coefficients) - truth) / np.array(effect.sigma))
    z = np.concatenate(off)
    # sigma is of noise that is as dense as the residual at its lowest frequencies, known to about a quarter
    assert 1 - 4 / np.sqrt(2 * len(z)) - 0.25 < np.sqrt(np.mean(z**2)) < 1 + 4 / np.sqrt(2 * len(z)) + 0.25


def test_sigma_has_the_walk_in_it():
    """A play beside a walk which no row averages out: white noise alone would give a fifth of the error."""
    off, walk = [], 3e-7
    for seed in range(20):
        rng = np.random.default_rng([seed, 3])

        def moved(k, chunk, rng=rng):
            steps = rng.normal(size=(len(chunk), 3)) * walk * np.sqrt(np.diff(chunk.t, prepend=chunk.t[0]))[:, None]
            return known(k, chunk) + np.cumsum(steps, axis=0)

        fit = joint(search_of(evidence(moved, seed=seed), (Term(PLAY), Term(VOLTAGE))))
        for effect, truth in zip(fit.effects, (C_PLAY, C_VOLTAGE), strict=True):
            off.append((np.array(effect.coefficients) - truth) / np.array(effect.sigma))
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_matrix_of_coefficients_lands_where_it_belongs():
    """The 9 coefficients of g-sensitivity: of each axis its own row."""
    truth = np.arange(1, 10) * 1e-6
    effect = GSensitivity()
    fit = joint(search_of(evidence(lambda k, chunk: signature(effect, chunk) @ truth), (Term(effect),)))
    np.testing.assert_allclose(fit.effects[0].coefficients, truth, atol=6 * np.max(fit.effects[0].sigma))


def test_the_parts_of_a_joint_fit_make_the_measured_rate():
    found = evidence(known)
    fit = joint(search_of(found, (Term(PLAY), Term(VOLTAGE))))
    shown = sum(
        found.rows([signature(effect, chunk) @ np.array(effect.coefficients) for chunk in found.chunks])
        for effect in fit.effects
    )
    levels = np.concatenate([np.tile(level, (len(r), 1)) for level, r in zip(fit.levels, found.records, strict=True)])
    np.testing.assert_allclose(fit.curve + shown + levels + fit.left, found.rate, atol=1e-12)
    for rows in found.slices:
        np.testing.assert_allclose(fit.left[rows].mean(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize("off", [-0.2, 0.2, 3.0])
def test_the_new_map_holds_where_the_declared_one_did(off):
    """Rows are means, and draw in the ends of a noisy thermometer: by so much the domain is not to shrink."""
    found = evidence(known)
    settings = Polynomial(order=3)
    T = np.concatenate([chunk["temperature"] for chunk in found.chunks])
    wide = np.linspace(T.min() - off, T.max() + off, 100)
    declared = settings.fit(wide, np.outer(wide, [1e-6, 1e-6, 1e-6]), {})
    search = search_of(found, (Term(PLAY), Term(VOLTAGE)))
    new = explained_map(search, joint(search), declared, settings, ["a"])
    rows = found.rows([chunk["temperature"] for chunk in found.chunks])
    assert new.domain == pytest.approx(declared.domain if off == 0.2 else (rows.min(), rows.max()))
    x = (rows - 20) / 17
    curve = np.stack([1e-5 * x**2, -2e-5 * x, 1e-5 * x**3], axis=1)
    error = new.bias(rows) - curve
    assert np.all(np.std(error, axis=0) < 6e-7)


def test_the_spread_of_unknown_starts_is_found():
    """30 recordings, each begun at a start of its own: their deviation within 4 of its own deviations, of each axis."""
    rng, truth = np.random.default_rng(3), np.array([2e-5, 4e-5, 1e-5])
    starts = rng.normal(size=(30, 3)) * truth

    def bias(k, chunk):
        left = np.exp(-(chunk.t - chunk.t[0]) / 1200.0)[:, None]
        return signature(SLIP, chunk) @ np.array([3e-6, -3e-6, 2e-6]) + left * starts[k]

    fit = joint(search_of(evidence(bias, (240,) * 30), (Term(SLIP, free=True),)))
    np.testing.assert_allclose(fit.effects[0].initial, np.sqrt(np.mean(starts**2, axis=0)), rtol=0.1)
    assert fit.starts
    equilibrium = joint(search_of(evidence(bias, (240,) * 30), (Term(SLIP),)))
    assert equilibrium.effects[0].initial is None
