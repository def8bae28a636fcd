"""The law of scale factor and misalignment over units, and a unit with a short stimulus and its family."""

import json

import numpy as np
import other_families
import pytest
from turned_units import matrix_of, turntable

import driftlab
from driftlab.errors import ConfigError, MapError
from driftlab.family.file import save_family
from driftlab.family.mixed_model import fit_family
from driftlab.family.record import TermParabolas, UnitRecord
from driftlab.family.terms import TermsLaw, fit_terms
from driftlab.triad.model import polynomial

LOW, HIGH = -15.0, 55.0
SIZES = np.array([1e-3, 4e-4, 1e-4])  # of a unit's own terms, of 1, x and x^2 with x from -1 to 1
AT = np.array([LOW, 20.0, HIGH])


def own_matrix(seed, times=1.0):
    """M of unit `seed` over temperature: that of all units, and a parabola of its own."""
    own = times * np.random.default_rng([909, seed]).normal(size=(3, 3, 3)) * SIZES

    def at(T):
        x = (T - 20.0) / 35.0
        return matrix_of(T) + own @ np.array([1.0, x, x**2])

    return at


def drawn(seed, noise=3e-4):
    """A unit's record, its terms at five temperatures with noise, put through a parabola by least squares."""
    rng = np.random.default_rng([31, seed])
    ends = LOW + rng.uniform(-1, 1), HIGH + rng.uniform(-1, 1)
    T = np.linspace(*ends, 5)
    y = np.array([own_matrix(seed)(t).ravel() for t in T]) + rng.normal(0, noise, (5, 9))
    X = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, 5), 2)
    covariance = noise**2 * np.linalg.inv(X.T @ X)
    c = np.linalg.lstsq(X, y, rcond=None)[0].T
    terms = TermParabolas(T=ends, c=c, covariance=np.tile(covariance, (9, 1, 1)))
    return UnitRecord(key="", unit=str(seed), state="done", parabolas=terms)


@pytest.fixture(scope="module")
def law():
    return fit_terms(map(drawn, range(60)))


def test_the_law_is_that_of_the_units_without_their_own_noise(law):
    """The spread that units were drawn with: at the ends sqrt(1 + 0.16 + 0.01), in the middle 1, 1e-3."""
    spread = np.sqrt(np.mean(np.diagonal(law.Sigma, axis1=1, axis2=2), axis=0))
    np.testing.assert_allclose(spread, [1.08e-3, 1e-3, 1.08e-3], rtol=0.12)
    true = np.array([matrix_of(T).ravel() for T in np.linspace(*law.T, 3)]).T
    z = (law.mu - true) / np.sqrt(np.diagonal(law.mu_covariance, axis1=1, axis2=2))
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4
    again = TermsLaw.model_validate(json.loads(law.model_dump_json()))
    np.testing.assert_allclose(again.Sigma, law.Sigma, rtol=1e-12)
    assert fit_terms(map(drawn, range(4))) is None


def test_the_prior_is_the_law_at_any_temperature(law):
    prior, T = law.prior(), np.linspace(*law.T, 3)
    B = polynomial(2, prior.domain).values(T)
    np.testing.assert_allclose(prior.mean @ B.T, law.mu, atol=1e-12)
    at_nodes = B @ prior.covariance @ B.T
    student = 63 / 61  # of 60 units, and the prior of Sigma that counts as 5, in 3 dimensions
    np.testing.assert_allclose(at_nodes, student * law.Sigma + law.mu_covariance, atol=1e-12)


CONFIG = """
filter:
  gyro:
    noise: 8e-5 rad/s/sqrt(Hz)
    bias: {kind: random_walk, walk: 1e-6 rad/s/sqrt(s)}
    calibration: {kind: polynomial, path: FOLDER/bias.json}
stimulus: {kind: rate_table, segments: FOLDER/table.csv}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory, law):
    """A map of the bias, and a family with the terms, of other units' soaks as to the rest."""
    folder = tmp_path_factory.mktemp("line")
    T = np.linspace(-20, 60, 300)
    noise = np.random.default_rng(0).normal(0, 1e-6, (300, 3))
    gyro = noise + np.outer(T, [1e-6, 2e-6, 3e-6])
    soak = {"time": (np.arange(300.0), "s"), "temperature": (T, "degC"), "gyro": (gyro, "rad/s")}
    config = CONFIG.replace("FOLDER", str(folder)).partition("stimulus")[0]
    driftlab.fit_map(config, soak, out=folder / "bias.json")
    units = other_families.deal("polynomial", 12, 3, d=3)
    family = fit_family([(unit.soaked(3, ("x", "y", "z")), unit.lot) for unit in units])
    save_family(folder / "bare.json", family)
    save_family(folder / "family.json", family.model_copy(update={"terms": law}))
    return folder


def short(folder, seed, times=1.0, family="family.json", terms="scale,misalignment", **how):
    """Fit a unit that was turned at 20 °C alone."""
    t, y, T, table = turntable(seed, [20.0], hold=8.0, matrix=own_matrix(seed, times))
    (folder / "table.csv").write_text(table)
    data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    given = None if family is None else folder / family
    return driftlab.fit_map(CONFIG.replace("FOLDER", str(folder)), data, terms=terms, family=given, **how)


def test_a_short_stimulus_and_the_family_tell_m_over_temperature(folder):
    """`benchmarks/triad.py family` counts more units, and fits their family too."""
    z, errors, alone = [], [], []
    for seed in range(500, 506):
        truth = np.array([own_matrix(seed)(T).ravel() for T in AT])
        made = short(folder, seed)
        errors.append(made.fit.terms.at(AT)[:, 3:12] - truth)
        z.append(errors[-1] / made.fit.sigma(AT)[:, 3:12])
        alone.append(short(folder, seed, family=None).fit.terms.at(AT)[:, 3:12] - truth)
        assert any("and this one is like them" in line for line in made.lines())
    errors, alone, z = map(np.array, (errors, alone, z))
    for k in (0, 2):
        assert np.sqrt(np.mean(errors[:, k] ** 2)) < 0.3 * np.sqrt(np.mean(alone[:, k] ** 2))
        assert 0.7 < np.sqrt(np.mean(z[:, k] ** 2)) < 1.4
    assert np.sqrt(np.mean(errors[:, 1] ** 2)) < 3e-5  # where it was turned
    assert made.map.record.matrix.T[0] == pytest.approx(LOW, abs=0.5)
    assert made.map.record.matrix.T[-1] == pytest.approx(HIGH, abs=0.5)


def test_a_unit_that_is_not_of_the_family_is_noticed(folder):
    made = short(folder, 510, times=5.0)
    line = next(line for line in made.lines() if line.startswith("family:"))
    assert "is not like its 60 units (chi-square of the stimulus" in line
    assert "turn the unit at others too" in line
    off = made.fit.terms.at(AT)[1, 3:12] - own_matrix(510, 5.0)(20.0).ravel()
    assert np.max(np.abs(off)) < 1e-4  # where it was turned the stimulus counts


def test_a_family_that_does_not_go_with_the_terms_is_refused(folder):
    with pytest.raises(ConfigError, match="terms scale,misalignment, and name a map of the bias"):
        short(folder, 1, terms="bias,scale,misalignment")
    with pytest.raises(ConfigError, match="has no terms of scale and misalignment; name one of which five units"):
        short(folder, 1, family="bare.json")
    with pytest.raises(ConfigError, match="of no lot; leave"):
        short(folder, 1, lot="a")
    content = json.loads((folder / "family.json").read_text())
    content["terms"]["Sigma"][0][0] *= -1
    (folder / "damaged.json").write_text(json.dumps(content))
    with pytest.raises(MapError, match="is damaged or no family's file: terms"):
        short(folder, 1, family="damaged.json")
