"""A unit that stands still on a steep curve, and one that really moves; no code of the project."""

import numpy as np
import pytest
from foreign_motion import KINDS, moved, reference, still
from foreign_soaks import DEG_H
from foreign_thermometers import G


@pytest.mark.parametrize("white", [2e-7, 1e-5, 1e-4])
def test_a_curve_is_as_steep_as_it_was_asked_to_be(white):
    rest = still(2, slope=100 * DEG_H, pace=5.0, white=white, walk=0.0)
    again = still(2, slope=100 * DEG_H, pace=5.0, white=white, walk=0.0)
    assert (rest.gyro == again.gyro).all()
    steps = np.gradient(rest.T, rest.t)
    assert 3.5 / 60 < np.abs(steps).max() <= 5 / 60
    ramp = np.abs(steps) > 0.5 / 60
    slopes = np.abs(np.gradient(rest.bias, axis=0)[ramp] / np.gradient(rest.T)[ramp, None])
    assert slopes.max() / DEG_H == pytest.approx(100, rel=0.01)
    assert (rest.gyro - rest.bias).std() == pytest.approx(white * np.sqrt(10), rel=0.02)
    assert np.linalg.norm(rest.accel.mean(axis=0)) == pytest.approx(G, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_motion_is_where_it_is_said(kind):
    rest = still(4, hours=1.5, white=2e-7, accel_white=1e-5)
    run = moved(rest, 7, (kind,), each=2)
    assert len(run.events) == 2
    change = np.abs(run.recording.gyro - rest.gyro).max(axis=1)
    assert not change[~run.moving].any()
    for event in run.events:
        rows = (rest.t >= event.begin) & (rest.t < event.end)
        assert run.moving[rows].all()
        assert np.linalg.norm(run.recording.gyro[rows] - rest.gyro[rows], axis=1).max() == pytest.approx(event.peak)
    length = np.linalg.norm(run.recording.accel, axis=1)
    assert length[~run.moving] == pytest.approx(G, abs=1e-3)
    # turned about the vertical the accelerometers see nothing, tilted they do
    turned = np.abs(run.recording.accel - rest.accel).max()
    assert turned < 1e-9 if kind in ("slow_turn", "rotation") else turned > 1e-4


def test_gravity_turns_with_the_gyro():
    rest = still(5, hours=1.0, white=0.0, walk=0.0, accel_white=0.0)
    run = moved(rest, 3, ("tilt",), each=3)
    omega, g = run.recording.gyro - rest.gyro, run.recording.accel
    # g' = -omega x g in the body's axes
    by_hand = -np.cross(omega, g)
    assert np.gradient(g, rest.t, axis=0)[5:-5] == pytest.approx(by_hand[5:-5], abs=0.02 * np.abs(by_hand).max())


def test_a_peak_is_the_callers_and_room_is_asked_for():
    run = moved(still(1, hours=2.0), 1, peak=1e-4)
    assert {e.peak for e in run.events} == {1e-4}
    assert {e.kind for e in run.events} == set(KINDS)
    with pytest.raises(ValueError, match="do not fit"):
        moved(still(1, hours=0.1), 1)


@pytest.mark.parametrize("unit", ["ppm", "V"])
def test_a_reference(unit):
    held, again = reference(3, unit), reference(3, unit)
    assert (held.x == again.x).all()
    left = (held.x - held.curve) / (7e-6 if unit == "V" else 1)
    assert np.diff(left).std() / np.sqrt(2) == pytest.approx(0.1, rel=0.03)
    assert 0.02 < left.reshape(-1, 300).mean(axis=1).std() < 0.3
