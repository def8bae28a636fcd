"""An error in proportion to the input: its regressors, and when recordings can show it."""

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_plugins.effects.scale_factor import ScaleFactor

G = 9.80665


def placed(up, seed=0, wander=0.0, N=400):
    """Return a recording of accelerometers with an axis up, as a search has it: readings, and what is left of them."""
    rng = np.random.default_rng(seed)
    T = np.linspace(10, 40, N)
    known = np.tile(G * np.asarray(up, float), (N, 1))
    excess = 0.02 * (T - 25)[:, None] * [1, -1, 2] / 15 + 1e-3 * rng.normal(size=(N, 3))
    known = known + wander * np.sin(np.arange(N) / 20)[:, None]
    channels = {"accel": known + excess, "excess": excess, "temperature": T, "gyro": 1e-5 * rng.normal(size=(N, 3))}
    return Chunk(np.arange(float(N)), channels, sensors=frozenset({"accel", "gyro"}))


def turned(N=400, rate="rate_of_table"):
    """Return a gyro on a table whose rate is the reference."""
    u = 0.5 * np.sign(np.sin(np.arange(N) / 30))
    excess = 1e-3 * np.ones(N)
    channels = {
        "omega": (u + excess)[:, None],
        "excess": excess[:, None],
        "temperature": 20 + 0.01 * np.arange(N),
        rate: u,
    }
    return Chunk(np.arange(float(N)), channels, sensors=frozenset({"omega"}))


def test_a_scale_factor_acts_on_each_axis_with_its_own_input():
    chunk = placed([0, 0, 1])
    effect = ScaleFactor(zero=20.0)
    signature, _ = effect.signature(chunk, None)
    s, k = np.array([1e-3, -2e-3, 3e-3]), np.array([1e-5, 0.0, -4e-5])
    u, T = chunk["accel"], chunk["temperature"]
    c = np.stack([s, k], axis=1).ravel()
    np.testing.assert_allclose(signature @ c, u * s + u * k * (T - 20)[:, None], rtol=1e-12)
    assert effect.labels == ("x_scale", "x_scale_per_K", "y_scale", "y_scale_per_K", "z_scale", "z_scale_per_K")
    assert effect.units[:2] == ("1", "1/K")
    slope, _ = ScaleFactor(zero=20.0, form="of temperature").signature(chunk, None)
    np.testing.assert_array_equal(slope, signature[:, :, 1::2])
    constant, _ = ScaleFactor(form="constant").signature(chunk, None)
    np.testing.assert_array_equal(constant, signature[:, :, ::2])


def test_it_is_proposed_where_the_input_of_the_sensor_differs():
    (one,) = ScaleFactor().proposals([placed([0, 0, 1]), placed([0, 1, 0], 1)])
    assert (one.channel, one.form, one.zero) == ("accel", "of temperature", pytest.approx(25))
    forms = [(one.channel, one.form) for one in ScaleFactor().proposals([turned(), turned()])]
    assert forms == [("rate_of_table", "constant"), ("rate_of_table", "both")]


def test_it_is_not_proposed_where_nothing_shows_it():
    still = [placed([0, 0, 1]), placed([0.01, 0, 1], 1)]  # one placement
    assert list(ScaleFactor().proposals(still)) == []
    # a gyro at rest beside accelerometers that are turned: its own input is the Earth's rate
    gyro = [
        chunk.having(gyro=chunk["gyro"] + [0, 0, 5e-5], excess=chunk["gyro"])
        for chunk in (placed([0, 0, 1]), placed([0, 1, 0], 1))
    ]
    assert all(one.channel != "accel" for one in ScaleFactor().proposals(gyro))
    unknown = [Chunk(c.t, {k: v for k, v in c.channels.items() if k != "excess"}) for c in still]
    assert list(ScaleFactor().proposals(unknown)) == []


def test_what_was_fitted_one_way_up_holds_the_other_way_up():
    domain = {"accel": ((-G, 0.0), (0.0, G), (-1.0, 2.0)), "temperature": (10.0, 40.0)}
    effect = ScaleFactor(zero=25.0, form="of temperature", domain=domain)
    up, down = (placed([0, sign, 0]) for sign in (1, -1))
    one, other = (effect.held(chunk.having(accel=chunk["accel"] - chunk["excess"]), None)[0] for chunk in (up, down))
    np.testing.assert_allclose(one, -other, atol=1e-12)
    assert np.max(np.abs(one)) == pytest.approx(15 * G)
