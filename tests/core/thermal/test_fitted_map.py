"""A fitted map says what it was asked for that it cannot answer, and blames nobody else."""

from dataclasses import dataclass

import numpy as np
import pytest

from fusion_core.contracts import FittedMap, MapRecord
from fusion_core.errors import BadValue


@dataclass(frozen=True)
class Line(FittedMap):
    def save(self, path):
        raise NotImplementedError

    def _bias(self, T):
        return np.stack([T, 2 * T], axis=1)

    def _slope(self, T):
        return np.broadcast_to([1.0, 2.0], (len(T), 2))


LINE = Line(MapRecord(kind="line", domain=(0.0, 40.0), residual=(0.1, 0.2)))
METHODS = (LINE.bias, LINE.slope, LINE.sigma)


@pytest.mark.parametrize("T", [20.0, 20, np.float64(20)])
def test_one_temperature_is_one_row(T):
    np.testing.assert_array_equal(LINE.bias(T), [[20.0, 40.0]])
    assert [method(T).shape for method in METHODS] == [(1, 2)] * 3


@pytest.mark.parametrize("outside", ["refuse", "clamp", "tangent"])
@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.array([1.0, np.nan]), r"line: is asked at T\[1\], which is NaN or masked; leave it out"),
        (np.nan, r"line: is asked at T\[0\], which is NaN"),
        (np.ma.array([1.0, 2.0], mask=[True, False]), r"line: is asked at T\[0\], which is NaN or masked"),
        (np.zeros((3, 2)), r"line: is asked at T of float64 and shape \(3, 2\); give numbers \(N,\) in degC"),
        ("20", "line: is asked at T of <U2"),
    ],
)
def test_what_is_no_temperature_is_said_to_be_the_caller_s(T, message, outside):
    line = Line(LINE.record, outside=outside)
    for method in (line.bias, line.slope, line.sigma):
        with pytest.raises(BadValue, match=message):
            method(T)
