"""The thermal derivative with calibrated effects: what is known of the bias enters as its drift."""

from typing import ClassVar, Literal

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import ConfigError
from fusion_core.filter import estimate
from fusion_core.model import Measurement, State
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.thermal_lag import ThermalLag
from fusion_plugins.thermal_maps.polynomial import Polynomial


class Voltage(Effect):
    """A bias proportional to the supply voltage, one coefficient an axis; it counts its samples in its memory."""

    kind: Literal["voltage"] = "voltage"
    requires: ClassVar = ("voltage",)
    explanation: ClassVar = "none: made for this test"

    def candidates(self):
        yield self

    def signature(self, chunk, memory):
        return chunk["voltage"][:, None, None] * np.eye(3), (memory or 0) + len(chunk)


class Offset(Voltage):
    """A map that sees a temperature 5 K too high."""

    kind: Literal["offset"] = "offset"
    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0)

    def input(self, chunk, memory):
        return chunk["temperature"] + 5, memory


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    T = np.linspace(0, 60, 300)
    path = tmp_path_factory.mktemp("map") / "map.json"
    Polynomial(order=2).fit(T, np.stack([T**2, 2 * T, -T], axis=1) * 1e-6, {}).save(path)
    return ThermalDerivative(walk="1e-4 deg/s/sqrt(s)", map={"kind": "polynomial", "path": str(path)})


def chunk():
    rng = np.random.default_rng(0)
    t = np.arange(200) * 0.5
    return Chunk(t, {"temperature": 20 + 0.1 * t, "voltage": 12 + rng.normal(size=200)})


def test_the_drift_is_the_difference_of_map_and_effects(model):
    """g = map(T + 5) + c V by hand; u is its difference, wherever the chunk is cut."""
    c = np.array([1e-5, -2e-5, 3e-5])
    with_effects = model.model_copy(update={"effects": (Offset(), Voltage(coefficients=tuple(c)))})
    whole = chunk()
    T = whole["temperature"] + 5
    g = np.stack([T**2, 2 * T, -T], axis=1) * 1e-6 + whole["voltage"][:, None] * c
    step, memory = with_effects.transition(whole, None)
    np.testing.assert_allclose(step.u, np.diff(g, axis=0, prepend=g[:1]), atol=1e-12)
    first, memory = with_effects.transition(whole.part(0, 77), None)
    second, memory = with_effects.transition(whole.part(77, 200), memory)
    np.testing.assert_array_equal(np.concatenate([first.u, second.u]), step.u)
    assert memory[2] == [200, 200]
    assert {"temperature", "voltage"} <= set(with_effects.requires)


def test_a_copy_with_another_map_reads_that_one(model, tmp_path):
    T = np.linspace(0.0, 40.0, 200)
    Polynomial(order=1).fit(T, np.stack([T, T, T], axis=1) * 1e-6, {}).save(tmp_path / "other.json")
    before = model.fitted.bias(T)
    other = model.model_copy(update={"map": Polynomial(path=tmp_path / "other.json")})
    np.testing.assert_allclose(other.fitted.bias(T), np.stack([T, T, T], axis=1) * 1e-6, atol=1e-12)
    np.testing.assert_array_equal(model.fitted.bias(T), before)


def test_an_effect_without_coefficients_is_refused(model):
    with pytest.raises(ConfigError, match="effects: voltage has no coefficients for its 3 regressors; write"):
        model.model_copy(update={"effects": (Voltage(),)}).transition(chunk(), None)


# -- coefficients that the filter estimates --------------------------------------------------------------------------

THETA, SIGMA = (1e-5, -2e-5, 3e-5), (2e-5, 2e-5, 4e-5)


def estimating(model, **update):
    known = Offset()
    states = Voltage(**{"estimate": True, "sigma": SIGMA} | update)
    return model.model_copy(update={"effects": (known, states)})


def test_estimated_coefficients_are_states_behind_the_axes(model):
    """F = I, nothing drives them, and the bias is b + S theta."""
    declared = estimating(model, coefficients=THETA)
    assert declared.labels == ("x", "y", "z", "voltage_1_x", "voltage_1_y", "voltage_1_z")
    assert declared.units("rad/s") == ("rad/s",) * 3 + (Voltage.unit,) * 3
    prior = declared.prior()
    np.testing.assert_array_equal(prior.x, [0, 0, 0, *THETA])
    np.testing.assert_allclose(prior.P, np.diag(np.square([1.0, 1.0, 1.0, *SIGMA])))
    np.testing.assert_array_equal(estimating(model).prior().x, np.zeros(6))
    whole = chunk()
    step, _ = declared.transition(whole, None)
    np.testing.assert_array_equal(step.F, np.eye(6))
    np.testing.assert_array_equal(step.Q[..., 3:, :], 0)
    np.testing.assert_array_equal(step.u[:, 3:], 0)
    np.testing.assert_array_equal(step.C[:, :, :3], np.broadcast_to(np.eye(3), (200, 3, 3)))
    np.testing.assert_array_equal(step.C[:, :, 3:], whole["voltage"][:, None, None] * np.eye(3))
    without = model.model_copy(update={"effects": (Offset(),)})
    np.testing.assert_array_equal(step.u[:, :3], without.transition(whole, None)[0].u)  # not counted twice
    assert without.transition(whole, None)[0].C is None


def test_an_estimated_coefficient_needs_its_deviation(model):
    for update in ({"sigma": None}, {"sigma": SIGMA[:2]}, {"coefficients": (1.0,)}):
        with pytest.raises(ConfigError, match=r"effects: voltage is to be estimated; write sigma, .* 3 coeff.*x, y, z"):
            estimating(model, **update).prior()


@pytest.mark.parametrize("seed", range(4))
def test_the_filter_finds_the_coefficients(model, seed):
    """Truth drawn apart from the model: map + walk + c V, seen through white noise, against a vague prior."""
    rng = np.random.default_rng(seed)
    t = np.arange(3000) * 0.5
    V = 0.5 * np.sign(np.sin(t / 30)) + 0.1 * rng.normal(size=len(t))
    measured = Chunk(t, {"temperature": 20 + 0.01 * t, "voltage": V})
    T = measured["temperature"] + 5
    walk = np.deg2rad(1e-4) * np.sqrt(0.5) * np.cumsum(rng.normal(size=(len(t), 3)), axis=0)
    bias = np.stack([T**2, 2 * T, -T], axis=1) * 1e-6 + walk + V[:, None] * THETA + 1e-3
    declared = estimating(model)
    step, _ = declared.transition(measured, None)
    prior, r = declared.prior(), 1e-5
    z = bias + r * rng.normal(size=bias.shape)
    used = np.ones(len(t), dtype=bool)
    found = estimate(State(prior.x, prior.P), step, Measurement(z, step.C, r**2 * np.eye(3), used))
    assert np.all(np.abs(found.x[-1, 3:] - THETA) < 3 * found.sigma[-1, 3:])
    assert np.all(found.sigma[-1, 3:] < 0.1 * np.array(SIGMA))
    assert np.mean(found.nis) == pytest.approx(3, rel=0.1)


# -- the temperature that effects see --------------------------------------------------------------------------------


def test_effects_see_the_temperature_as_it_was_measured(model):
    """An application's smoothing is for the map; a signature and a lag begin with the raw one."""
    rng = np.random.default_rng(2)
    t = np.arange(300) * 1.0
    raw = 25 + 12 * np.sin(t / 40) + 0.2 * rng.normal(size=300)
    smooth = 25 + 12 * np.sin(t / 40)
    both = Chunk(t, {"temperature": smooth, "temperature_raw": raw})
    only_raw, only_smooth = Chunk(t, {"temperature": raw}), Chunk(t, {"temperature": smooth})

    loop = model.model_copy(update={"effects": (Hysteresis(width="6 K", coefficients=(1e-5, 2e-5, 3e-5)),)})
    signature, _ = loop.effects[0].signature(only_raw, None)
    g = signature @ np.array([1e-5, 2e-5, 3e-5])
    expected = model.transition(only_smooth, None)[0].u + np.diff(g, axis=0, prepend=g[:1])
    np.testing.assert_allclose(loop.transition(both, None)[0].u, expected, atol=1e-15)

    late = model.model_copy(update={"effects": (ThermalLag(tau="30 s"),)})
    np.testing.assert_array_equal(late.transition(both, None)[0].u, late.transition(only_raw, None)[0].u)

    states = model.model_copy(update={"effects": (Hysteresis(width="6 K", estimate=True, sigma=(1e-5,) * 3),)})
    np.testing.assert_array_equal(states.transition(both, None)[0].C[:, :, 3:], signature)


def test_a_map_without_effects_keeps_the_smoothed_temperature(model):
    t = np.arange(50) * 1.0
    smooth = 20 + 0.1 * t
    both = Chunk(t, {"temperature": smooth, "temperature_raw": smooth + np.sin(t)})
    g = np.stack([smooth**2, 2 * smooth, -smooth], axis=1) * 1e-6
    np.testing.assert_allclose(model.transition(both, None)[0].u, np.diff(g, axis=0, prepend=g[:1]), atol=1e-15)
