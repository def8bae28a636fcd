"""Noise and walk of a first config are within a factor of 2, or said to be unknown: a small dose of the benchmark."""

from first_noise import count


def test_noise_and_walk_are_within_a_factor_of_two_or_unknown():
    found = count([0, 1, 2, 3, 59, 83, 119])  # the last are those of steep curves under a noisy thermometer
    assert found["guessed"] == found["soaks"] == found["white noise within a factor of 2"]
    assert found["walk known"] == found["of these within a factor of 2"] > 0
    assert found["walk unknown"] == found["of these above the truth, as a bound is"] > 0
