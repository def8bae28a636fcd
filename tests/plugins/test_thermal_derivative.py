"""The thermal derivative with calibrated effects: what is known of the bias enters as its drift."""

from typing import ClassVar, Literal

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import ConfigError
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative
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


def test_an_effect_without_coefficients_is_refused(model):
    with pytest.raises(ConfigError, match="effects: voltage has no coefficients for its 3 regressors; write those that were fitted"):
        model.model_copy(update={"effects": (Voltage(),)}).transition(chunk(), None)
