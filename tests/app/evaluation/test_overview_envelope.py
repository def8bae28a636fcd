"""The envelope of a run's errors, for their figure."""

import numpy as np
import pytest

from driftlab.evaluation.overview import STRETCHES, Envelope
from driftlab.evaluation.scores import errors_of


def rows(N, seed=0):
    rng = np.random.default_rng(seed)
    block = {name: rng.normal(size=(N, 2)) for name in ("bias", "coast", "bias_sigma", "coast_sigma", "reference")}
    return {"t": np.arange(N) / 10.0, "nis": np.ones(N), **block}


def of(block, size):
    N = len(block["t"])
    found = Envelope(2)
    for start in range(0, N, size):
        part = {name: values[start : start + size] for name, values in block.items()}
        found.add(part, errors_of(part, part["reference"]), part["nis"] > 0)
    return found.curves()


@pytest.mark.parametrize("N", [1, 5, STRETCHES, 12_345])
def test_it_is_the_same_however_the_rows_come(N):
    whole = of(rows(N), N)
    for size in (1, 97, 1000) if N < 1000 else (97, 5000):
        for name, values in of(rows(N), size).items():
            np.testing.assert_array_equal(values, whole[name])
    assert np.all(np.diff(whole["t"]) >= 0)
    assert 2 * min(N, STRETCHES) <= len(whole["t"]) <= 4 * STRETCHES


@pytest.mark.parametrize("at", [0, 777, 5004, 12_344])
def test_a_spike_of_one_row_is_drawn_where_it_is(at):
    block = rows(12_345)
    block["coast"][at, 1] += 1e3
    found = of(block, 5000)
    highest = int(np.argmax(found["coast"][:, 1]))
    assert found["coast"][highest, 1] == (block["coast"] - block["reference"])[at, 1]
    assert found["t"][highest] == pytest.approx(at / 10, abs=12_345 / STRETCHES / 10)


def test_a_row_without_a_reference_has_no_error_and_hides_no_other():
    block = rows(3000)
    block["reference"][1000:2000] = np.nan
    block["reference"][0] = np.nan
    found = of(block, 700)
    inside = (found["t"] > 101) & (found["t"] < 198)
    assert np.all(np.isnan(found["bias"][inside]))
    assert np.all(np.isfinite(found["bias"][(found["t"] < 99) | (found["t"] > 201)]))


def test_deviations_are_those_of_the_rows_whose_nis_counts():
    block, found = rows(5000), Envelope(2)
    counts = np.random.default_rng(1).random(5000) < 0.3
    for part in (slice(0, 1), slice(1, 4000), slice(4000, 5000)):
        some = {name: values[part] for name, values in block.items()}
        found.add(some, errors_of(some, some["reference"]), counts[part])
    sigma = block["bias_sigma"][counts]
    np.testing.assert_array_equal(found.least, sigma.min(axis=0))
    np.testing.assert_allclose(found.squares, np.sum(sigma**2, axis=0), rtol=1e-12)
