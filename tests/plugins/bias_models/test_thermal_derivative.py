"""The thermal derivative with calibrated effects: what is known of the bias enters as its drift."""

from typing import ClassVar, Literal

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import ConfigError
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.relaxation import Relaxation
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
    assert declared.units("rad/s") == ("rad/s",) * 3 + ("rad/s",) * 3
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


# -- what memories began at, and what switch-ons before say ------------------------------------------------------------

START = (4e-5, 0.0, 1e-5)
LATE = Relaxation(tau="40 s", coefficients=(1e-5, 2e-5, 3e-5), initial=START)
LOOSE = Hysteresis(width="6 K", coefficients=(1e-5, 2e-5, 3e-5), initial=START)


def test_what_a_memory_began_at_is_a_state_of_each_axis_that_fades(model):
    states = Voltage(estimate=True, sigma=SIGMA)
    declared = model.model_copy(update={"effects": (LATE, states, LOOSE)})
    starts = tuple(f"{kind}_start_{axis}" for kind in ("relaxation_0", "hysteresis_2") for axis in "xyz")
    assert declared.labels == ("x", "y", "z", "voltage_1_x", "voltage_1_y", "voltage_1_z", *starts)
    assert declared.units("rad/s") == ("rad/s",) * 3 + ("rad/s",) * 3 + ("rad/s",) * 6
    np.testing.assert_allclose(np.diag(declared.prior().P), np.square([1, 1, 1, *SIGMA, *START, *START]))
    whole = chunk()
    step, memory = declared.transition(whole, None)
    crossed = whole["temperature"] - whole["temperature"][0] >= 6
    lag = np.where(np.arange(200) == 0, 1.0, np.exp(-0.5 / 40))
    for k in range(200):
        np.testing.assert_allclose(step.F[k], np.diag([*np.ones(6), *[lag[k]] * 3, *[float(not crossed[k])] * 3]))
    assert np.count_nonzero(step.Q) == 199 * 3  # the first sample has no step
    np.testing.assert_array_equal(step.u[:, 3:], 0)
    np.testing.assert_array_equal(step.C[:, :, 6:], np.broadcast_to(np.hstack([np.eye(3)] * 2), (200, 3, 6)))
    first, half = declared.transition(whole.part(0, 77), None)
    second, after = declared.transition(whole.part(77, 200), half)
    np.testing.assert_array_equal(np.concatenate([first.F, np.broadcast_to(second.F, (123, 12, 12))]), step.F)
    np.testing.assert_array_equal(declared.prior_again(after).P, declared.prior_again(memory).P)
    left = np.exp(-0.5 * 199 / 40), float(not crossed[-1])
    expected = [1, 1, 1, *SIGMA, *(left[0] * np.array(START)), *(left[1] * np.array(START))]
    np.testing.assert_allclose(np.sqrt(np.diag(declared.prior_again(memory).P)), expected, rtol=1e-12)


def test_a_start_that_is_known_is_no_state(model):
    known = LATE.model_copy(update={"initial": (0.0, 0.0, 0.0)})
    declared = model.model_copy(update={"effects": (known, Hysteresis(coefficients=(0.0, 0.0, 0.0)))})
    assert declared.labels == ("x", "y", "z")
    step, _ = declared.transition(chunk(), None)
    assert step.C is None
    np.testing.assert_array_equal(step.F, np.eye(3))


@pytest.mark.parametrize("form", ["difference", "slope"])
def test_the_prior_is_about_map_and_effects_at_the_first_sample(model, form):
    """b ~ N(map + effects + turn_on_bias, repeatability^2) at the first sample; wide, but about the same, later on."""
    c = (1e-5, -2e-5, 3e-5)
    known = {"turn_on_bias": (1e-4, 2e-4, 3e-4), "repeatability": 2e-5, "form": form, "sigma_0": 0.5}
    declared = model.model_copy(update={"effects": (Voltage(coefficients=c), LATE), **known})
    whole = chunk().having(temperature_rate=np.full(200, 0.1))
    T, V = whole["temperature"], whole["voltage"]
    behind = 0.1 * 40 * (1 - np.exp(-whole.t / 40))  # of a lag of 40 s on a ramp of 0.1 K/s
    g = np.stack([T**2, 2 * T, -T], axis=1) * 1e-6 + V[:, None] * c + behind[:, None] * LATE.coefficients
    np.testing.assert_allclose(declared.prior().x[:3], known["turn_on_bias"])
    np.testing.assert_allclose(np.diag(declared.prior().P), np.square([2e-5, 2e-5, 2e-5, *START]))
    first = declared.prior_at(whole)
    np.testing.assert_allclose(first.x, [*(g[0] + known["turn_on_bias"]), 0, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(first.P, declared.prior().P)
    step, memory = declared.transition(whole, None)
    np.testing.assert_array_equal(step.u[0, :3] if form == "difference" else 0.0, 0.0)
    again = declared.prior_again(memory)
    np.testing.assert_allclose(again.x, [*(g[-1] + known["turn_on_bias"]), 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(np.diag(again.P)[:3], 0.25)


def test_without_repeatability_the_prior_is_as_wide_as_ever(model):
    _, memory = model.transition(chunk(), None)
    for prior in (model.prior(), model.prior_at(chunk()), model.prior_again(memory)):
        np.testing.assert_array_equal(prior.x, 0)
        np.testing.assert_array_equal(prior.P, np.eye(3))


def test_a_model_needs_no_map():
    """The effects alone then; temperature is asked for by those that read it."""
    settings = {"kind": "thermal_derivative", "walk": "1e-4 deg/s/sqrt(s)"}
    bare = ThermalDerivative.model_validate(settings)
    assert bare.fitted is None
    assert bare.requires == ()
    known = bare.model_copy(update={"effects": (Voltage(coefficients=(1e-5, -2e-5, 3e-5)),)})
    assert known.requires == ("voltage",)
    V = chunk()["voltage"]
    step, _ = known.transition(Chunk(chunk().t, {"voltage": V}), None)
    np.testing.assert_allclose(step.u, np.diff(V, prepend=V[:1])[:, None] * [1e-5, -2e-5, 3e-5], atol=1e-18)
    assert set(bare.model_copy(update={"effects": (ThermalLag(),)}).requires) == {"temperature"}
    assert not bare.model_copy(update={"effects": (ThermalLag(),)}).transition(chunk(), None)[0].u.any()
    with pytest.raises(ValueError, match="form is slope and there is no map to take it of; name a map, or leave form"):
        ThermalDerivative.model_validate({**settings, "form": "slope"})
    with pytest.raises(ValueError, match="turn_on_bias is given and repeatability is not; add how far switch-ons"):
        ThermalDerivative.model_validate({**settings, "turn_on_bias": "3 deg/h"})
    given = {**settings, "turn_on_bias": ["3 deg/h", "0 deg/h", "-1 deg/h"], "repeatability": "5 deg/h"}
    again = ThermalDerivative.model_validate(ThermalDerivative.model_validate(given).model_dump(mode="json"))
    np.testing.assert_allclose(again.prior().x, np.deg2rad([3, 0, -1]) / 3600)
    np.testing.assert_allclose(again.prior().P, np.eye(3) * (np.deg2rad(5) / 3600) ** 2)


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
