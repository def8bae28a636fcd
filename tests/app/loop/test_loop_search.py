"""What the search stands on, against independent derivations: dense least squares, a state-space likelihood, laws."""

import numpy as np
import pytest

from driftlab.loop.columns import Columns
from driftlab.loop.evidence import Evidence, Record
from driftlab.loop.explained import explained_map, joint
from driftlab.loop.least_squares import LeastSquares, Term
from driftlab.loop.left_out import Part, error, parts
from driftlab.loop.noise import Noise, effective, fitted
from driftlab.loop.residue import structures
from driftlab.loop.state import Search, noises_of
from fusion_core.chunk import Chunk
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.g_sensitivity import GSensitivity
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.relaxation import Relaxation
from fusion_plugins.effects.thermal_lag import ThermalLag
from fusion_plugins.thermal_maps.polynomial import Polynomial

AXES = ("x", "y", "z")
STEP = 10.0  # s, of a mean; a row is of two
WHITE = 2e-6  # rad/s, of a mean
PLAY, VOLTAGE, SLIP = Hysteresis(width="6 K"), Channel(channel="voltage"), Relaxation(tau="20 min")
C_PLAY, C_VOLTAGE = np.array([4e-6, -3e-6, 5e-6]), np.array([1e-5, 2e-5, -1e-5])


def chunk_of(rng, count):
    t = 50.0 + STEP * np.arange(1, count + 1)
    T = 20 + 14 * np.sin(t / rng.uniform(700, 1500) + rng.uniform(0, 6)) + 3 * np.sin(t / 300)
    accel = np.stack([rng.normal(size=count), rng.normal(size=count), 9.8 + 0.1 * rng.normal(size=count)], axis=1)
    return Chunk(t, {"temperature": T, "voltage": 5 + rng.normal(size=count), "accel": accel})


def evidence(bias, counts=(400, 300, 350), seed=0, white=WHITE):
    """Return recordings of a curve of temperature, a level each, what `bias(k, chunk)` adds (N, 3), and white noise."""
    rng = np.random.default_rng(seed)
    records = []
    for k, count in enumerate(counts):
        chunk = chunk_of(rng, count)
        x = (chunk["temperature"] - 20) / 17
        curve = np.stack([1e-5 * x**2, -2e-5 * x, 1e-5 * x**3], axis=1)
        rate = curve + bias(k, chunk) + rng.normal(0, 3e-5, 3) + white * rng.normal(size=(count, 3))
        record = Chunk(chunk.t, {**chunk.channels, "gyro": rate})
        records.append(Record(f"{k}", k == 0, k > 0, record, np.arange(0, count, 2)))
    return Evidence(tuple(records), AXES, 2 * STEP, 300.0)


def signature(effect, chunk):
    return effect.signature(chunk, None)[0]


def known(k, chunk):
    return signature(PLAY, chunk) @ C_PLAY + signature(VOLTAGE, chunk) @ C_VOLTAGE


def squares_of(evidence):
    T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
    basis = Polynomial(order=3).basis((float(T.min()), float(T.max())))
    return LeastSquares(Columns(evidence, basis), np.zeros(3), np.ones(3))


def search_of(evidence, model):
    squares = squares_of(evidence)
    found = Search(squares, lambda text: None, (), model, parts(squares.columns))
    found.noises = noises_of(found, model)
    return found


def dense(evidence, effects, axis, rows=slice(None)):
    """Return curve (n, 3), levels (n, R) and the effects' own columns (n, p) as a textbook writes them."""
    curves, levels, own = [], [], []
    for k, record in enumerate(evidence.records):
        T = record.chunk["temperature"]
        for effect in effects:
            T = effect.input(record.chunk.having(temperature=T), None)[0] if effect.acts_on_input else T
        one = np.zeros((len(record), len(evidence.records)))
        one[:, k] = 1
        curves.append(record.rows(np.stack([T, T**2, T**3], axis=1)))
        levels.append(one)
        shown = [signature(effect, record.chunk)[:, axis] for effect in effects]
        own.append(record.rows(np.concatenate([np.zeros((len(T), 0)), *shown], axis=1)))
    return tuple(np.concatenate(part)[rows] for part in (curves, levels, own))


@pytest.mark.parametrize("effects", [(), (PLAY,), (PLAY, VOLTAGE), (ThermalLag(tau="150 s"), VOLTAGE)])
def test_a_fit_is_that_of_dense_least_squares(effects):
    found = evidence(known)
    squares = squares_of(found)
    everything = tuple(range(len(squares.columns.segments)))
    for axis in range(3):
        fit = squares.fit(tuple(map(Term, effects)), axis, everything)
        left = squares.residual(axis, fit) * squares.columns.scale[squares.columns.y[axis]]
        A, y = np.hstack(dense(found, effects, axis)), found.rate[:, axis]
        A = A / np.linalg.norm(A, axis=0).clip(1e-300)
        expected = y - A @ np.linalg.lstsq(A, y, rcond=1e-12)[0]
        np.testing.assert_allclose(left, expected, atol=1e-5 * np.std(expected))


def test_a_fit_over_some_segments_is_that_of_their_rows():
    found = evidence(known)
    squares = squares_of(found)
    fit = squares.fit((Term(PLAY),), 1, (0, 1, 4))
    rows = np.concatenate([np.r_[squares.columns.segments[k].rows] for k in (0, 1, 4)])
    A, y = np.hstack(dense(found, (PLAY,), 1, rows)), found.rate[rows, 1]
    expected = float(np.sum((y - A @ np.linalg.lstsq(A, y, rcond=1e-12)[0]) ** 2))
    assert fit.cost * squares.columns.scale[squares.columns.y[1]] ** 2 == pytest.approx(expected, rel=1e-5)


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


@pytest.mark.parametrize("k", [0, 1, 4])
def test_a_left_out_error_is_that_of_refitting_by_hand(k):
    """Effects from the rest, then map and levels from all, the effects given; the mean of the error taken off."""
    found = evidence(known)
    squares = squares_of(found)
    part = parts(squares.columns)[k]
    rest = np.concatenate([np.r_[squares.columns.segments[s].rows] for s in part.rest])
    for axis in range(3):
        y = found.rate[:, axis]
        curve, levels, own = dense(found, (PLAY, VOLTAGE), axis)
        A = np.hstack([curve, levels, own])
        theta = np.linalg.lstsq(A[rest], y[rest], rcond=1e-12)[0][-own.shape[1] :]
        B = np.hstack([curve, levels])
        e = y - own @ theta
        e = (e - B @ np.linalg.lstsq(B, e, rcond=1e-12)[0])[part.window.stop : part.rows.stop]
        scale = squares.columns.scale[squares.columns.y[axis]]
        left = error(squares, (Term(PLAY), Term(VOLTAGE)), axis, part, Noise(0.1, 1e-3)) * scale
        np.testing.assert_allclose(left, e - e.mean(), atol=1e-4 * np.std(e))


def test_recordings_and_their_halves_are_left_out_and_of_a_single_one_five_parts():
    several = parts(squares_of(evidence(known)).columns)
    assert [part.record for part in several] == [0, 1, 2, 0, 0, 1, 1, 2, 2]
    single = parts(squares_of(evidence(known, (1000,))).columns)
    assert len(single) == 5
    assert all(isinstance(part, Part) and part.refit == part.rest for part in single)


@pytest.mark.parametrize(("walk", "white"), [(0.05, 1.0), (0.3, 1.0), (2.0, 1.0)])
def test_the_noise_is_that_of_a_local_level(walk, white):
    """statsmodels' maximum likelihood of a local level: the same steady gain and one-step variance."""
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    rng = np.random.default_rng(5)
    x = np.cumsum(walk * rng.normal(size=2000)) + white * rng.normal(size=2000)
    likelier = structural.UnobservedComponents(x, level="local level").fit(disp=False)
    r, q = likelier.params
    P = (q + np.sqrt(q**2 + 4 * q * r)) / 2  # steady prediction of the level
    found = fitted([x])
    assert found.gain == pytest.approx(P / (P + r), rel=0.1)
    assert found.variance == pytest.approx(P + r, rel=0.01)
    assert found.white == pytest.approx(r, rel=0.1)
    assert found.walk == pytest.approx(q, rel=0.25)


@pytest.mark.parametrize("walking", [False, True])
def test_white_noise_has_as_many_independent_rows_as_rows(walking):
    rng, n = np.random.default_rng(6), 4000
    ratios = [effective(rng.normal(size=n), np.sin(np.arange(n) / tau), walking=walking) / n for tau in (5, 20, 80) * 4]
    assert np.mean(ratios) == pytest.approx(1, abs=0.15)


def test_a_walk_has_few_independent_rows_for_what_is_slow():
    rng, n = np.random.default_rng(7), 4000
    walk = np.cumsum(rng.normal(size=n))
    assert effective(walk, np.sin(2 * np.pi * np.arange(n) / n), walking=False) < 10
    assert effective(walk, rng.normal(size=n), walking=False) > n / 3


def test_what_is_left_is_noise_or_is_not():
    """White noise under a walk is noise, whatever its size; a level that jumps is not, and says how long it lasts."""
    quiet, jumping, rng = [], [], np.random.default_rng(8)
    for seed in range(5):
        walk = {k: np.cumsum(rng.normal(size=(400, 3)), axis=0) * 4e-7 for k in range(3)}
        jump = rng.integers(100, 250)

        def bias(k, chunk, walk=walk):
            return walk[k][: len(chunk)]

        def step(k, chunk, walk=walk, jump=jump):
            return walk[k][: len(chunk)] + 1.5e-5 * (np.arange(len(chunk)) > jump)[:, None] * (k == 1)

        for model, into in ((bias, quiet), (step, jumping)):
            found = search_of(evidence(model, seed=seed), ())
            into.append(structures(found, np.full(3, 3e-6)))
    assert quiet == [[]] * 5
    assert all(any("jumps" in s.description for s in seen) for seen in jumping)
    assert all(s.gain > s.threshold for seen in jumping for s in seen)
