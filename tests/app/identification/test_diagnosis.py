"""The diagnosis of residuals: noise, or something that is left."""

import numpy as np
from rows_at_rest import evidence, search_of

from driftlab.identification.diagnosis import innovations, structures
from driftlab.noise.local_level import fit_local_level


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
