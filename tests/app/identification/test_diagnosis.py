"""The diagnosis of residuals: noise, or something that is left."""

from dataclasses import replace

import numpy as np
from rows_at_rest import STEP, WHITE, evidence, search_of

from driftlab.identification.diagnosis import innovations, structures
from driftlab.noise.local_level import LocalLevel, fit_local_level


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
