"""The diagnosis of residuals: noise, or something that is left."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rows_at_rest import STEP, WHITE, evidence, search_of, signature
from scipy.signal import lfilter
from third_parties import registry_of

from driftlab.identification import candidates
from driftlab.identification.acceptance import CandidateEvidence, fast_evidence
from driftlab.identification.diagnosis import innovations, judge, quick, structures
from driftlab.identification.least_squares import Term
from driftlab.identification.search import search
from driftlab.identification.state import Trial
from driftlab.identification.trials import difference, uncertainty, with_uncertain_map
from driftlab.noise.local_level import LocalLevel, fit_local_level
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.relaxation import Relaxation
from fusion_plugins.thermal_maps.polynomial import Polynomial


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
    assert all(s.log_likelihood_gain > s.threshold for seen in jumping for s in seen)


def test_a_tone_faster_than_any_prediction_is_no_noise():
    """White noise of 1 beside A sin: a flat spectrum but for its line, of a share A^2 / (2 + A^2) of the whole."""
    rng, t = np.random.default_rng(3), np.arange(3000) * 4.0
    noise = [rng.normal(size=(3000, 3)) for _ in range(3)]
    assert quick(noise, 4.0, "xyz") == []
    few = quick([part + 0.3 * np.sin(t / 7)[:, None] for part in noise], 4.0, "xyz")
    assert few == []  # a twentieth of what is left
    tone = 2.0 * np.sin(2 * np.pi * t / 40 + 1.0)[:, None] * [0, 1, 0]
    (found,) = quick([part + tone for part in noise], 4.0, "xyz")
    assert found.time_scale_s == pytest.approx(40, rel=0.01)
    share = float(found.description.partition("noise, ")[2].partition("%")[0])
    assert share == pytest.approx(100 * 2 / 3, abs=3)
    assert found.description.startswith("on y what is left is no noise, ")
    drifting = 3.0 * np.sin(2 * np.pi * (t / 40 + 5e-7 * t**2))[:, None] * [1, 1, 1]
    assert len(quick([part + drifting for part in noise], 4.0, "xyz")) == 1


def test_the_first_rows_of_a_recording_are_no_jump():
    """Sums of innovations over any rows are normal, those of the first rows too, whatever the walk."""
    for ratio in (0.0, 0.02, 0.3):
        first, rng = [], np.random.default_rng(3)
        for _ in range(400):
            e = rng.normal(size=500) + np.cumsum(rng.normal(0, ratio, 500))
            first.append(innovations(e, fit_local_level([e]))[:8].sum() / np.sqrt(8))
        assert np.std(first) < 1.1
        assert np.max(np.abs(first)) < 4.3


def test_a_walk_larger_than_the_declared_one_is_not_noise():
    """A bias that walks as declared is noise, beyond a gap too; one that walks six times as far is not, nor is it
    because the search takes its residual for a walk."""
    q, rng = 2e-7, np.random.default_rng(4)  # rad/s/sqrt(s)
    walks = [rng.normal(0, q * np.sqrt(STEP), (count, 3)).cumsum(axis=0) for count in (400, 300, 350)]
    for factor in (1.0, 6.0):
        rows = evidence(lambda k, chunk, factor=factor: factor * walks[k] * [1, 0, 0])
        declared = replace(rows, noise=np.full(3, WHITE * np.sqrt(STEP)), walk=np.full(3, q))
        quiet, found = (structures(search_of(one, ()), np.full(3, 3e-6)) for one in (rows, declared))
        assert quiet == []
        assert len(found) == (factor > 1)
        assert all(s.description.startswith("on x what is left wanders") for s in found)
        assert all(s.log_likelihood_gain > s.threshold for s in found)


def test_a_gap_is_as_many_steps_of_a_walk_as_it_lasts():
    """Innovations of a walk whose middle was not recorded have unit variance there as elsewhere."""
    noise, rng = LocalLevel.of(1.0, 0.04), np.random.default_rng(6)
    steps = np.where(np.arange(60) == 40, 500.0, 1.0)
    seen = []
    for _ in range(2000):
        level = np.cumsum(rng.normal(0, np.sqrt(noise.walk * steps)))
        seen.append(innovations(level + rng.normal(0, np.sqrt(noise.white), 60), noise, steps))
    assert np.all(np.abs(np.var(seen, axis=0) - 1) < 5 * np.sqrt(2 / 2000))


@pytest.mark.parametrize("seed", range(4))
def test_a_copy_of_the_temperature_is_a_rival_of_it_whatever_is_left(monkeypatch, seed):
    """A relaxation between the points of any grid under a slow cause without a channel, which moves all axes."""
    monkeypatch.setattr(candidates, "registry", lambda: registry_of(kinds=("relaxation",)))
    rng, counts = np.random.default_rng(seed), (1500, 1200, 1200)
    hidden = [lfilter([1], [1, -np.exp(-STEP / 1500)], rng.normal(0, 4e-7, n))[:, None] for n in counts]
    late, sizes = Relaxation(tau="640 s"), np.array([1.0, 0.8, -1.2])
    rows = evidence(lambda k, chunk: (signature(late, chunk) @ (2e-6 * sizes)) + hidden[k] * sizes, counts, seed)
    T = [chunk["temperature"] for chunk in rows.chunks]
    copies = [5 + 0.004 * (one + rng.normal(0, 0.01, len(one))) for one in T]
    chunks = [chunk.having(voltage=copy) for chunk, copy in zip(rows.chunks, copies, strict=True)]
    records = [replace(record, chunk=chunk) for record, chunk in zip(rows.records, chunks, strict=True)]
    rows, T = replace(rows, records=tuple(records)), np.concatenate(T)
    found = search(rows, Polynomial(order=3).basis((float(T.min()), float(T.max()))), lambda text: None)
    verdict = judge(found, np.full(3, 1e-5), lambda text: None)
    finding = verdict.findings[0]
    assert {finding.trial.name, *finding.names} == {"relaxation", "relaxation of voltage"}
    assert verdict.word == "ambiguous"


@pytest.mark.parametrize("common", [0.0, 1.0])
def test_a_difference_scatters_as_said_where_one_cause_moves_all_axes(common):
    """Left-out errors of two candidates, drawn anew many times; each row counts twice in them."""
    rng, seen = np.random.default_rng(2), []
    for _ in range(300):
        own, of_all = rng.normal(size=(3, 54)), rng.normal(size=54)
        ratio = 1 + 0.1 * (of_all * common + own * (1 - common))
        one, other = (SimpleNamespace(blocks=blocks) for blocks in (np.ones((3, 54)), ratio))
        seen.append((difference(one, other), uncertainty(one, other)))
    differences, said = np.array(seen).T
    assert np.isclose(np.sqrt(2) * np.std(differences), np.mean(said), rtol=0.15)


def walking(seed):
    """Return recordings of a curve under white noise and a walk."""
    rng, counts = np.random.default_rng(seed), (1200, 900, 900)
    walks = [rng.normal(0, 4e-7, (count, 3)).cumsum(axis=0) for count in counts]
    return evidence(lambda k, chunk: walks[k], counts, seed)


def test_a_walk_in_the_map_is_no_evidence_for_a_slow_effect():
    """The chance of what is not there is uniform, so minus its log has mean 1, and variance 1."""
    drift, nats = Term(Drift()), []
    for seed in range(25):
        found = search_of(walking(seed), ())
        nats.append(fast_evidence(found.squares, (), drift, found.noises_of((drift,)), generalised=True)[0])
    assert abs(np.mean(nats) - 1) < 3 / np.sqrt(len(nats))


@pytest.mark.parametrize("size", [0.0, 2e-6])
def test_an_effect_passes_where_it_is_seen_beside_an_uncertain_map(size):
    """One that is there keeps what it showed; what showed as much by the map of least squares alone does not pass."""
    late = Term(Relaxation(tau="20 min"))
    shown = CandidateEvidence(0.86, -3.0, 9, 0.9, beside=False, left_out=20.0, chance=60.0, gain=40.0, price=5.0)
    for seed in range(5):
        rows = walking(seed)
        records = []
        for record in rows.records:
            rate = record.chunk["gyro"] + signature(late.effect, record.chunk) @ np.full(3, size)
            records.append(replace(record, chunk=record.chunk.having(gyro=rate)))
        found = search_of(replace(rows, records=tuple(records)), ())
        trial = with_uncertain_map(found, Trial((late,), shown, np.ones((3, 9)), 0.0, passes=True, reason=""))
        assert trial.passes == (size > 0)
        assert (trial.reason == "") == trial.passes
