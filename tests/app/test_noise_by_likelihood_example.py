"""Noise by maximum likelihood against the noise that was put in, and against the likelihood's own definition."""

import sys
from pathlib import Path

import numpy as np
import pytest
from units_at_rest import unit_at_rest

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from driftlab.recordings.epochs import epochs
from fusion_core.chunk import Chunk
from fusion_core.errors import SingularFit

sys.path.insert(0, str(Path(__file__).parent.parent.parent / "examples"))
from noise_by_likelihood import fit_noise


def config(noise="3.18 deg/h/sqrt(Hz)", walk="1.5e-4 deg/s/sqrt(s)"):
    gyro = {"noise": noise, "bias": {"kind": "random_walk", "walk": walk}}
    rest = {"attitude": "1e-8 rad"}
    return Config.model_validate({"filter": {"gyro": gyro, "rest": rest, "update_interval": "1 s"}})


def stream(unit):
    return epochs([Chunk(unit.t, {"gyro": unit.gyro})], 1.0)


def test_the_noise_that_was_put_in_is_found():
    """Declared: white three times too small, walk five times too large."""
    unit = unit_at_rest(seconds=7200, rate=5, noise=3 * 1.5417e-5, walk=2.618e-6 / 5)
    found = fit_noise(config(), stream(unit))["gyro"]
    np.testing.assert_allclose(found.white, 3, rtol=0.03)
    np.testing.assert_allclose(found.walk, 1 / 5, rtol=0.35)
    assert np.all(found.log_likelihood > found.declared + 100)


def test_declared_noise_that_is_right_stays():
    found = fit_noise(config(), stream(unit_at_rest(seconds=7200, rate=5, noise=1.5417e-5, walk=2.618e-6)))["gyro"]
    np.testing.assert_allclose(found.white, 1, rtol=0.05)
    np.testing.assert_allclose(found.walk, 1, rtol=0.15)
    assert np.all(found.log_likelihood - found.declared < 8)  # chi-square / 2 with two degrees of freedom


def test_it_is_a_maximum_of_the_filters_own_likelihood():
    """The sum over axes is the log-likelihood of one run with the factors applied, up to the first epochs."""
    unit = unit_at_rest(seconds=1800, rate=5, noise=2e-5, walk=1e-6)
    found = fit_noise(config(), stream(unit))["gyro"]

    def likelihood(white, walk):
        noise = [f"{float(v) * 1.5417075059283247e-05!r} rad/s/sqrt(Hz)" for v in white]
        density = [f"{float(v) * 2.617993877991494e-06!r} rad/s/sqrt(s)" for v in walk]
        stretches = list(Run(config(noise, density), RunLog()).over(stream(unit)))
        return sum(s.estimates.log_likelihood() for s in stretches)

    best = likelihood(found.white, found.walk)
    for factor in (0.93, 1.07):
        assert likelihood(found.white * factor, found.walk) < best
        assert likelihood(found.white, found.walk * factor**4) < best


@pytest.mark.parametrize("event", ["motion", "step"])
def test_motion_and_a_step_are_not_taken_for_noise(event):
    unit = unit_at_rest(seconds=3600, rate=5, noise=1.5417e-5, walk=2.618e-6)
    if event == "motion":
        unit.gyro[9000:9010, 0] += 0.5
    else:
        unit.gyro[9000:, 0] += 3e-3
    found = fit_noise(config(), stream(unit))["gyro"]
    np.testing.assert_allclose(found.white, 1, rtol=0.07)
    np.testing.assert_allclose(found.walk, 1, rtol=0.3)


def test_too_little_data_is_refused():
    with pytest.raises(SingularFit, match="only 25 updates at rest, at least 30 are needed"):
        fit_noise(
            config().model_copy(update={"filter": config().filter.model_copy(update={"align": 20.0})}),
            stream(unit_at_rest(seconds=25, rate=5)),
        )
