"""A benchmark has measured what it calls met."""

import numpy as np
import pytest
from common import limit, ratio
from growth import exponent

SIZES = (1_000, 10_000, 100_000, 1_000_000)


@pytest.mark.parametrize(
    ("seconds", "value", "met"),
    [
        ([0.1 + 1e-6 * N for N in SIZES], "N^1.00", True),
        ([0.1 + 1e-9 * N**1.5 for N in SIZES], "N^1.50", False),
        ([0.1 + 1e-10 * N for N in SIZES], "not measured", None),  # nothing but what every call costs
        ([1e-3, 2e-3, 0.35, 1e-4], "not measured", None),  # the time falls
    ],
)
def test_an_exponent_that_is_not_measured_is_not_met(seconds, value, met):
    row = exponent("growth", SIZES, seconds)
    assert row.value.startswith(value)
    assert row.met is met


def test_sizes_that_differ_by_other_ratios():
    sizes = (10, 30, 120)
    assert exponent("growth", sizes, [1 + 0.1 * n**1.2 for n in sizes]).value == "N^1.20"


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_what_is_no_measurement_meets_nothing(value):
    assert limit("a time", value, "s", 10).met is None
    assert ratio("a ratio", value, 1.0, 1e-3).met is not True
    assert limit("a time", 1.0, "s", 10).met is True
