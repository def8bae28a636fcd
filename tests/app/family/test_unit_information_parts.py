"""A unit cut to a part of its range says what it would have said had it seen no more."""

from __future__ import annotations

import numpy as np

from driftlab.family.unit_information import UnitInformation
from driftlab.soak.blocks import SoakRows

AXES, WHITE, WALK = ("x",), np.array([2.0]), np.array([0.05])


def _rows(T: np.ndarray, begin: float = 5.0) -> SoakRows:
    rng = np.random.default_rng(1)
    t = begin + 10.0 * np.arange(len(T))
    return SoakRows(t, T, rng.normal(size=(len(T), 1)), np.full(len(T), 10.0), {"voltage": T + 1})


def _covariance(t: np.ndarray, walk: float, white: float) -> np.ndarray:
    return walk**2 * np.minimum.outer(t, t) + white**2 / 10 * np.eye(len(t))


def test_the_walk_goes_on_where_nothing_is_looked_at() -> None:
    T = np.concatenate([np.linspace(0, 40, 50), np.linspace(40, 0, 50)])
    rows = _rows(T)
    found = UnitInformation.of("a", AXES, [rows], WHITE, WALK, 2.5).between(10, 20)
    assert found is not None
    keep = (T >= 10) & (T <= 20)
    V = _covariance(rows.t[keep] - rows.t[0], WALK[0], WHITE[0])
    B = found.knots.values(T[keep])
    np.testing.assert_allclose(found.J[0], B.T @ np.linalg.solve(V, B), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(found.h[0], B.T @ np.linalg.solve(V, rows.bias[keep, 0]), rtol=1e-8, atol=1e-10)
    assert found.count == keep.sum()
    np.testing.assert_array_equal(found.recordings[0].channels["voltage"], T[keep] + 1)


def test_all_of_the_range_is_the_unit_itself() -> None:
    rows = _rows(np.linspace(-10, 30, 80))
    whole = UnitInformation.of("a", AXES, [rows, rows], WHITE, WALK, 2.5)
    found = whole.between(-10, 30)
    assert found is not None
    np.testing.assert_allclose(found.J, whole.J, rtol=1e-12)
    assert whole.between(50, 60) is None
