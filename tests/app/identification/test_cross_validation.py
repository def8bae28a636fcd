"""Parts that are left out, and the error there, against refitting by hand."""

import numpy as np
import pytest
from rows_at_rest import PLAY, VOLTAGE, dense, evidence, known, squares_of

from driftlab.identification.cross_validation import LeftOutPart, error, parts
from driftlab.identification.least_squares import Term
from driftlab.noise.local_level import LocalLevel


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
        left = error(squares, (Term(PLAY), Term(VOLTAGE)), axis, part, LocalLevel(0.1, 1e-3)) * scale
        np.testing.assert_allclose(left, e - e.mean(), atol=1e-4 * np.std(e))


def test_recordings_and_their_halves_are_left_out_and_of_a_single_one_five_parts():
    several = parts(squares_of(evidence(known)).columns)
    assert [part.record for part in several] == [0, 1, 2, 0, 0, 1, 1, 2, 2]
    single = parts(squares_of(evidence(known, (1000,))).columns)
    assert len(single) == 5
    assert all(isinstance(part, LeftOutPart) and part.refit == part.rest for part in single)
