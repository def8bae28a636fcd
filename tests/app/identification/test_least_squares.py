"""Joint fits, against dense least squares."""

import numpy as np
import pytest
from rows_at_rest import PLAY, VOLTAGE, dense, evidence, known, squares_of

from driftlab.identification.least_squares import Term
from fusion_plugins.effects.thermal_lag import ThermalLag


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
