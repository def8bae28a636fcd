"""Soaks of rare rows, too short, given twice: what is said is true of that recording, and of no other."""

import numpy as np
import pytest

import driftlab
from driftlab.errors import ConfigError, EmptyRecording

CONFIG = {"filter": {"kind": "held", "channel": "pressure", "noise": "2 Pa/sqrt(Hz)", "align": "60 s", "bias": {
    "kind": "thermal_derivative", "walk": "0.02 Pa/sqrt(s)", "map": {"kind": "polynomial", "order": 3}}}}  # fmt: skip


def soak(rows, apart=1.0, seed=0):
    t = np.arange(rows) * apart
    T = 20.0 - 30.0 * np.cos(2 * np.pi * t / 7200.0)
    pressure = 3.0 * T + np.random.default_rng(seed).normal(0.0, 2.0 / np.sqrt(apart), rows)
    return {"time": (t, "s"), "pressure": (pressure, "Pa"), "temperature": (T, "degC")}


@pytest.mark.parametrize(("given", "message"), [
    ([soak(400, 100.0)], "an alignment of 60 s has 1 update at most, 3 are needed; set filter.align to 300 s or more"),
    ([soak(7200), soak(400, 100.0)], r"data\[1\]: an alignment of 60 s has 1 update at most"),
    ([soak(2)], "is nowhere at rest in 1 s; record a soak of hours"),
    ([soak(1)], "is nowhere at rest in 0 s; record a soak of hours"),
])  # fmt: skip
def test_a_soak_that_cannot_be_aligned_says_why(given, message):
    with pytest.raises(EmptyRecording, match=message):
        driftlab.fit_map(CONFIG, given if len(given) > 1 else given[0])


def test_samples_that_are_given_twice_are_refused_and_others_are_not():
    one, other = soak(7200), soak(7200, seed=1)
    with pytest.raises(ConfigError, match=r"data\[1\]: has samples in common with data\[0\], and would count twice"):
        driftlab.fit_map(CONFIG, [one, dict(one)])
    cut = {name: (values[3000:], unit) for name, (values, unit) in one.items()}
    with pytest.raises(ConfigError, match=r"data\[1\]: has samples in common with data\[0\], and would count twice"):
        driftlab.fit_map(CONFIG, [one, {**cut, "time": (cut["time"][0] - 3000.0, "s")}])
    alone, both = driftlab.fit_map(CONFIG, one), driftlab.fit_map(CONFIG, [one, other])
    assert 0.5 < np.mean(both.map.sigma([20.0]) / alone.map.sigma([20.0])) < 1.0


def test_noise_on_a_slope_is_not_taken_for_more():
    """Three updates of 0.3 K each, 0.9 Pa apart, where white noise is 0.2 Pa."""
    (rare,) = [soak(900, 100.0)]
    wide = {"filter": {**CONFIG["filter"], "align": "300 s"}}
    assert not any("white noise" in line for line in driftlab.fit_map(wide, rare).lines())
