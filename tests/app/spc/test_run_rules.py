"""Run rules against published run lengths and closed forms."""

import math

import numpy as np
import pytest

from driftlab.spc.run_rules import RULES


def alarms(rules, names):
    def of(z):
        return np.any([np.abs(z) > 3, *(rules[name](z) for name in names)], axis=0)

    return of


def run_length(alarm, runs, most):
    found = alarm(np.random.default_rng(5).normal(size=(runs, most)))
    found[:, -1] = True
    return float(np.mean(np.argmax(found, axis=1) + 1))


# Champ and Woodall 1987, table 1: of a line in control, with three sigma beside
@pytest.mark.parametrize(
    ("kept", "length"), [((0,), 225.44), ((1,), 166.05), ((2,), 152.73), ((0, 2), 122.05), ((0, 1, 2), 91.75)]
)
def test_western_electric_rules_run_as_long_as_published(kept, length):
    rules = RULES["western-electric"]
    names = [list(rules)[k] for k in kept]
    assert run_length(alarms(rules, names), 4000, 1200) == pytest.approx(length, rel=0.05)


WITHIN = math.erf(1 / math.sqrt(2))


def of_a_row(p, count):
    """Return the mean number of trials to so many successes of probability p in a row."""
    return (1 - p**count) / (p**count * (1 - p))


@pytest.mark.parametrize(
    ("name", "length"),
    [
        ("9 units in a row on one side", 2**9 - 1),
        ("15 units in a row within 1 sigma", of_a_row(WITHIN, 15)),
    ],
)
def test_nelsons_runs_are_as_long_as_their_closed_forms(name, length):
    assert run_length(RULES["nelson"][name], 4000, 6000) == pytest.approx(length, rel=0.06)


# of n values in any order 2 rise or fall throughout, and twice the n-th Euler number alternate
@pytest.mark.parametrize(
    ("name", "count", "orders"),
    [("6 units in a row rise, or fall", 6, 2), ("14 units in a row rise and fall in turns", 14, 2 * 199_360_981)],
)
def test_nelsons_orders_are_as_rare_as_their_closed_forms(name, count, orders):
    found = RULES["nelson"][name](np.random.default_rng(6).normal(size=(400_000, count)))
    assert not np.any(found[:, :-1])
    assert np.mean(found[:, -1]) == pytest.approx(orders / math.factorial(count), rel=0.1)


def test_a_rule_alarms_at_the_unit_that_completes_it():
    far = RULES["western-electric"]["2 of 3 units beyond 2 sigma on one side"]
    assert np.flatnonzero(far(np.array([0, 2.1, 0, 2.1, 0, 0, 2.1, -2.1, -2.1, 0.0]))).tolist() == [3, 8]
    beyond = RULES["nelson"]["8 units in a row beyond 1 sigma"]
    assert np.flatnonzero(beyond(np.array([1.1, -1.1] * 5))).tolist() == [7, 8, 9]
