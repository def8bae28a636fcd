"""A bias model that hosts a map and effects is asked by its contract, whatever it is called and whoever wrote it."""

from typing import Annotated, Literal

import numpy as np
import pytest
from pydantic import ValidationError

from fusion_core.contracts import BiasModel, Effect, Prior, ThermalBias, ThermalMap, Transition
from fusion_core.errors import ConfigError
from fusion_core.host.registry import Installed
from fusion_core.units import bias_unit
from fusion_plugins.bias_models.constant import Constant
from fusion_plugins.bias_models.random_walk import RandomWalk
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative
from fusion_plugins.effects.drift import Drift
from fusion_plugins.thermal_maps.polynomial import Polynomial


class Host(ThermalBias):
    """One of a third party, with a field of its own."""

    kind: Literal["acme_host"] = "acme_host"
    map: Annotated[ThermalMap, Installed()] | None = None
    effects: tuple[Annotated[Effect, Installed()], ...] = ()
    extra: int = 3

    def prior(self):
        return Prior(np.zeros(len(self.axes)), np.diag(self.initial_sigma**2))

    def transition(self, chunk, memory):
        one = np.eye(len(self.axes))
        return Transition(one, one * chunk.dt, np.zeros(len(one))), memory


HOSTS = [ThermalDerivative, Host]


@pytest.mark.parametrize("cls", HOSTS)
def test_a_host_takes_over_what_a_random_walk_says(cls):
    walk = RandomWalk(axes=("x", "z"), walk=("2 deg/h/sqrt(s)", "3 deg/h/sqrt(s)"), sigma_0="5 deg/h")
    host = cls.from_random_walk(walk)
    assert (host.axes, host.walk, host.sigma_0) == (walk.axes, walk.walk, walk.sigma_0)
    assert (host.map, host.effects, host.fitted) == (None, (), None)
    np.testing.assert_array_equal(host.prior().P, walk.prior().P)


@pytest.mark.parametrize("cls", HOSTS)
def test_what_is_no_random_walk_is_not_taken_over(cls):
    with pytest.raises(ConfigError, match="bias model constant is no random walk"):
        cls.from_random_walk(Constant())


@pytest.mark.parametrize("cls", HOSTS)
def test_a_new_one_keeps_what_was_not_named_and_is_checked(cls):
    first = cls(walk="1 deg/h/sqrt(s)", map=Polynomial(order=2))
    new = first.having(effects=(Drift(coefficients=(1.0, 2.0, 3.0)),), walk=("4 deg/h/sqrt(s)",) * 3)
    assert isinstance(new, cls)
    assert new.map is first.map
    assert new.effects[0].coefficients == (1.0, 2.0, 3.0)
    assert new.walk[0] == pytest.approx(4 * first.walk)
    again = cls.model_validate(new.model_dump(mode="json", exclude_none=True))
    assert again == new
    for wrong in ({"nonsense": 1}, {"walk": ("1 deg/h/sqrt(s)",) * 2}, {"turn_on_bias": "1 deg/h"}):
        with pytest.raises(ValidationError):
            first.having(**wrong)
    with bias_unit("m/s^2"), pytest.raises(ValidationError, match="cannot be converted"):
        first.having(walk="1 deg/h/sqrt(s)")


def test_every_model_begins_where_it_is_told():
    """`sigma_0` is the deviation of the bias, whatever the states are called; without it one SI unit."""
    for sigma_0, expected in ((None, 1.0), ("0.5 rad/s", 0.5)):
        for cls in (Constant, RandomWalk, ThermalDerivative):
            given = {} if cls is Constant else {"walk": "1 deg/h/sqrt(s)"}
            model: BiasModel = cls(sigma_0=sigma_0, **given)
            np.testing.assert_allclose(np.sqrt(np.diag(model.prior().P)), expected)
