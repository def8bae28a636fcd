import numpy as np
import pytest
from effect_recordings import at_temperature, on_one_axis, record
from scipy.signal import lsim

from fusion_core.chunk import Chunk
from fusion_plugins.effects.relaxation import Relaxation


def test_relaxation_is_what_a_lag_has_not_followed():
    """(tau s) / (1 + tau s) by scipy; on a ramp it settles at tau times the rate."""
    t = np.arange(0, 6000, 1.0)
    u = np.interp(t, np.arange(0, 6001, 300), 20 + np.random.default_rng(2).normal(size=21))
    _, expected, _ = lsim(([400.0, 0.0], [400.0, 1.0]), u - u[0], t)
    for channel in ("temperature", "voltage"):
        effect = Relaxation(channel=channel, tau="400 s")
        found = on_one_axis(effect, Chunk(t, {channel: u}))[:, 0]
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert effect.requires == ("voltage",)
    ramp = on_one_axis(Relaxation(tau="400 s"), at_temperature(t, 5 - 0.01 * t))[-1, 0]
    assert ramp == pytest.approx(-4.0, rel=1e-6)
    assert Relaxation().units == ("bias/K",) * 3
    assert effect.units == ("bias per SI unit of the channel",) * 3


def test_relaxation_is_proposed_up_to_half_of_the_longest_recording():
    short, long = record(N=40, steps="regular"), record(N=4000, steps="regular")  # 9997.5 s
    found = list(Relaxation().proposals([short, long]))
    assert {c.channel for c in found} == {"temperature", "voltage"}
    taus = [c.tau for c in found if c.channel == "temperature"]
    assert taus[0] == pytest.approx(20)
    assert 0.7 * 4998.75 < taus[-1] <= 4998.75
    ratios = np.diff(np.log(taus))
    np.testing.assert_allclose(ratios, np.log(36000 / 20) / 25)
    assert len(list(Relaxation().candidates())) == 26
    assert len(list(Relaxation(channel="voltage").candidates())) == 8
    assert list(Relaxation().proposals([short])) != []
    wide = Chunk(np.arange(500.0), {"field": np.zeros((500, 2)), "residual": np.zeros((500, 3))})
    assert list(Relaxation().proposals([wide])) == []
