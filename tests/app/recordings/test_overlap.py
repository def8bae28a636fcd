"""Samples in common: found whatever the packing, and never between recordings that are two."""

import numpy as np
import pytest

from driftlab.recordings.overlap import MAX_WORDS, _WordsOf


def content(x, rows=1000):
    words = _WordsOf()
    for part in np.array_split(x, max(len(x) // rows, 1)):
        words.take(part)
    return words.content()


def noise(seed, d, N=6000):
    rng = np.random.default_rng(seed)
    return 1e-5 * (rng.normal(size=(N, d)) + 0.05 * np.cumsum(rng.normal(size=(N, d)), axis=0))


@pytest.mark.parametrize("d", [1, 3, 6])
@pytest.mark.parametrize(
    "packed",
    [
        lambda x: x[:-1],
        lambda x: x[700:],
        lambda x: x.astype(np.float32).astype(np.float64),
        lambda x: np.vectorize(lambda v: float(f"{v:.5g}"))(x),
        lambda x: x * (np.pi / 180) * (180 / np.pi),
    ],
    ids=["last row", "later", "single precision", "five digits", "another unit"],
)
def test_one_recording_is_found_in_any_packing(d, packed):
    x = noise(0, d)
    assert content(x, 1000).share(content(packed(x), 333)) > 0.9


@pytest.mark.parametrize("steps", [0.0, 2e-5, 1e-4])
@pytest.mark.parametrize("d", [1, 3])
def test_two_recordings_are_two_however_coarse_they_are(d, steps):
    one, two = noise(1, d), noise(2, d)
    if steps:
        one, two = (np.round(x / steps) * steps for x in (one, two))
    assert content(one).share(content(two)) == 0
    assert content(one[:3000]).share(content(one[3000:])) == 0


def test_a_part_in_common_is_its_share():
    x = noise(3, 3)
    assert content(x[:4000]).share(content(x[3000:])) == pytest.approx(1000 / 3000, abs=0.03)


def test_sensors_that_stand_still_or_run_straight_say_nothing():
    still, straight = np.zeros((3000, 3)), np.outer(np.arange(3000.0), np.ones(3))
    assert content(still).share(content(still)) == content(straight).share(content(straight)) == 0


def test_long_recordings_keep_the_same_words():
    x = noise(4, 1, 5 * MAX_WORDS)
    whole, part = content(x, 65_536), content(x[len(x) // 2 :], 65_536)
    assert len(whole.words) < 2.1 * MAX_WORDS
    assert whole.share(part) > 0.99
