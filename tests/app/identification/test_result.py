"""Worse beyond chance: with power where an effect is wrong, and rarely where it is right or noise decides."""

from types import SimpleNamespace

import numpy as np

from driftlab.identification import result
from driftlab.identification.result import Outcome, change_of, sentence
from driftlab.units import BiasUnit


def outcome(e, s, name="holdout.h5"):
    """Return what is predicted with errors e (n, d) before, changed by s (n, d)."""
    t, reference = 10.0 * np.arange(len(e)), np.zeros_like(e)
    sigma = np.ones_like(e)
    return Outcome(name, BiasUnit("rad/s", "deg/h"), t, None, reference, e, e + s, sigma, sigma, ())


def drawn(seed, slow):
    """Return noise, a slow walk in it where that is asked for, and what an effect says, of unit size."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(size=(2000, 2)), axis=0) / np.sqrt(2000)
    e = rng.normal(size=(2000, 2)) + (3 * walk if slow else 0.0)
    s = np.sin(np.arange(2000)[:, None] / rng.uniform(20, 400) + rng.uniform(0, 6, 2))
    return e, s


def test_an_effect_that_is_right_is_hardly_ever_refuted():
    """The noise is there either way; without the effect its part is in the error too."""
    wrong = [change_of([outcome(e - s, s)]).worse for e, s in (drawn(k, k % 2) for k in range(200))]
    assert np.mean(wrong) <= 0.05


def test_an_effect_of_which_there_is_half_is_refuted_at_most_as_often_as_said():
    """At half the size the error is the same on average: that is where the chance of 5 % belongs."""
    wrong = [change_of([outcome(e - 0.5 * s, s)]).worse for e, s in (drawn(k, k % 2) for k in range(400))]
    assert np.mean(wrong) <= 0.08


def test_an_effect_that_is_not_there_is_refuted():
    found = [change_of([outcome(e, s)]).worse for e, s in (drawn(k, slow=False) for k in range(100))]
    assert np.mean(found) > 0.95
    e, s = drawn(1, slow=True)
    assert change_of([outcome(0.1 * e, 3 * s), outcome(0.1 * e, 3 * s)]).worse


def test_errors_without_noise_leave_no_chance():
    s = np.sin(np.arange(300.0))[:, None]
    assert change_of([outcome(-s, s)]).confirms
    assert change_of([outcome(0 * s, s)]).worse


def test_a_test_that_is_nowhere_at_rest_is_said_to_be_none():
    moving = Outcome(**{**vars(outcome(np.ones((9, 1)), np.ones((9, 1)))), "reference": np.full((9, 1), np.nan)})
    assert "is nowhere at rest" in sentence(change_of([moving]), [moving])


def test_what_changes_nothing_is_neither_refuted_nor_tested():
    e, s = drawn(1, slow=True)
    change = change_of([outcome(e, 0 * s)])
    assert (change.worse, change.sigma, change.before) == (False, 0.0, change.after)
    assert "hardly tests the identified effects" in sentence(change, [outcome(e, 0 * s)])
    assert sentence(change_of([]), []) == ""


def test_errors_are_the_rms_of_all_axes_and_recordings():
    e = np.broadcast_to([1.0, 2.0, 2.0], (300, 3))
    change = change_of([outcome(e, 0 * e), outcome(3 * e, 0 * e)])
    assert np.isclose(change.before, np.sqrt(3 * (1 + 9) / 2))


def test_an_effect_is_confirmed_where_it_is_there_and_hardly_ever_where_it_is_not():
    pairs = [drawn(k, k % 2) for k in range(200)]
    there = [change_of([outcome(e - 2 * s, 2 * s)]).confirms for e, s in pairs]
    absent = [change_of([outcome(e, 2 * s)]).confirms for e, s in pairs]
    assert all(there[::2])
    assert np.mean(there[1::2]) > 0.6, "beside a walk that is as large"
    assert np.mean(absent) <= 0.05


def test_a_test_says_whether_it_would_have_seen_the_effect():
    """A sine of amplitude a in n rows of white noise of 1: on two axes a^2 n over 2 sqrt(a^2 n)."""
    e, s = drawn(1, slow=False)
    for a in (0.02, 0.5):
        change = change_of([outcome(e, a * s)])
        assert np.isclose(change.power, a * np.sqrt(2000) / 2, rtol=0.4)
    assert "hardly tests the identified effects" in sentence(change_of([outcome(e, 0.02 * s)]), [outcome(e, 0.02 * s)])
    half = [outcome(e - 0.05 * s, 0.1 * s)]
    change = change_of(half)
    assert not change.worse
    assert ("predicted no better" in sentence(change, half)) == (change.after >= change.before)


def test_an_effect_whose_channel_is_elsewhere_in_each_test_recording_is_not_tested():
    def outcome(supply, fan):
        journal = SimpleNamespace(beyond={("channel", "supply"): supply, ("channel", "fan"): fan})
        return SimpleNamespace(runs=(None, SimpleNamespace(journal=journal, overview=SimpleNamespace(count=100))))

    (line,) = result._untested([outcome(100, 60), outcome(70, 40)])
    assert line.startswith("channel of supply is not tested: at 70% of the updates of each test recording")
    assert result._untested([]) == []
