"""Recordings at rest under coarse thermometers, which share no code with the project."""

import numpy as np
import pytest
from foreign_thermometers import KINDS, OMEGA, PROFILES, STEPS, G, draw, read


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_is_its_bias_and_its_noise(kind, profile):
    made = draw(3, 1, kind, profile=profile, hours=0.5, rate=10.0)
    again = draw(3, 1, kind, profile=profile, hours=0.5, rate=10.0)
    assert (made.gyro == again.gyro).all()
    assert (made.temperature == again.temperature).all()
    assert made.gyro.shape == made.accel.shape == made.bias.shape == (18_000, 3)
    left = made.gyro - made.bias - OMEGA
    assert left.std() == pytest.approx(KINDS[kind].white * np.sqrt(10), rel=0.02)
    assert made.accel.mean(axis=0) == pytest.approx([0, 0, G], abs=1e-3)
    assert made.T.min() > -30
    assert made.T.max() < 60


def test_two_days_are_of_one_unit():
    one, two = (draw(5, day, "FOG", profile="soak", hours=1.0, rate=1.0) for day in (0, 1))
    assert one.bias == pytest.approx(two.bias, abs=1e-6)
    assert np.abs(one.bias - draw(6, 0, "FOG", profile="soak", hours=1.0, rate=1.0).bias).max() > 1e-5


@pytest.mark.parametrize("step", STEPS)
def test_a_thermometer_reads_in_steps(step):
    rng = np.random.default_rng(0)
    T = np.linspace(10, 20, 20_000)
    if step:
        raw = read(T, step, 0.02, rng)
        assert raw / step == pytest.approx(np.round(raw / step), abs=1e-9)
        assert np.std(read(T, step, 0.0, rng) - T) == pytest.approx(step / np.sqrt(12), rel=0.05)
    mean = read(T, step, 0.2, rng, averaged=10)
    expected = np.hypot(0.2, step / np.sqrt(12)) / np.sqrt(10)
    # where the noise spans the steps, it dithers
    assert step > 0.25 or np.std(mean - T) == pytest.approx(expected, rel=0.15)
    held = read(T, step, 0.0, rng, held=10)
    assert (held.reshape(-1, 10) == held[::10, None]).all()


def test_a_recording_is_written(tmp_path):
    import h5py

    made = draw(1, hours=0.1)
    made.save(tmp_path / "day.h5")
    with h5py.File(tmp_path / "day.h5") as file:
        assert (file["temperature"][:] == made.temperature).all()
        assert file["gyro"].attrs["unit"] == "rad/s"
