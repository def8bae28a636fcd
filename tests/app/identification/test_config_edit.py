"""The model that a loop writes to is chosen by its contract."""

import types
from typing import Literal

import pytest

from driftlab.identification import config_edit
from driftlab.identification.config_edit import host_of
from fusion_core.errors import ConfigError
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Registry, registry
from fusion_plugins.bias_models import random_walk, thermal_derivative
from fusion_plugins.bias_models.constant import Constant
from fusion_plugins.bias_models.random_walk import RandomWalk
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative


class Acme(ThermalDerivative):
    """Of a third party, whose kind comes first in the alphabet."""

    kind: Literal["acme"] = "acme"


def with_plugins(monkeypatch, *modules):
    found = Registry()
    for module in modules:
        found.register(module)
    monkeypatch.setattr(config_edit, "registry", lambda: found)


def acme():
    module = types.ModuleType("acme")
    module.bias_models = hookimpl(lambda: [Acme], specname="bias_models")
    return module


WALK = RandomWalk(walk="1 deg/h/sqrt(s)")


def test_one_that_hosts_stays_itself():
    own = ThermalDerivative(walk="1 deg/h/sqrt(s)")
    assert host_of(own) is own


def test_a_random_walk_is_hosted_by_what_came_with_the_program(monkeypatch):
    assert type(host_of(WALK)) is registry().classes(config_edit.BiasModel)["thermal_derivative"]
    with_plugins(monkeypatch, acme(), thermal_derivative, random_walk)
    assert type(host_of(WALK)) is ThermalDerivative
    with_plugins(monkeypatch, acme(), random_walk)
    assert type(host_of(WALK)) is Acme


def test_what_cannot_be_hosted_is_refused_with_what_can(monkeypatch):
    with pytest.raises(ConfigError, match="bias model constant takes no effects; declare thermal_derivative or random"):
        host_of(Constant())
    with_plugins(monkeypatch, random_walk)
    with pytest.raises(ConfigError, match="bias model random_walk takes no effects; declare one that does"):
        host_of(WALK)
