"""Plugins are found one by one: a broken one is shown and stops nothing."""

import types
from importlib.metadata import EntryPoint
from typing import Literal

import numpy as np
import pytest

from fusion_core.contracts import BiasModel, Prior, Transition
from fusion_core.hookspecs import hookimpl
from fusion_core.host import registry as module
from fusion_core.host.registry import Registry, kind_of


class Still(BiasModel):
    kind: Literal["still"] = "still"

    def prior(self):
        return Prior(np.zeros(3), np.eye(3))

    def transition(self, chunk, memory):
        return Transition(np.eye(3), np.zeros((3, 3)), np.zeros(3)), memory


class Nameless(Still):
    kind: str = "nameless"


class Unfinished(BiasModel):
    kind: Literal["unfinished"] = "unfinished"


def plugin(name, *classes, hook="bias_models"):
    found = types.ModuleType(name)

    def implementation():
        return list(classes)

    implementation.__name__ = hook
    setattr(found, hook, hookimpl(implementation))
    return found


def test_a_class_is_found_by_its_kind():
    registry = Registry()
    registry.register(plugin("good", Still))
    assert registry.classes(BiasModel) == {"still": Still}
    assert kind_of(Still) == "still"


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ((Nameless,), "has no kind; declare"),
        ((Unfinished,), "does not define prior, transition"),
        ((int,), "is not a BiasModel"),
        ((Still, Still), "kind 'still' is taken by"),
    ],
)
def test_a_class_that_breaks_the_contract_is_shown_with_its_error(classes, message):
    registry = Registry()
    registry.register(plugin("bad", *classes))
    broken = [entry for entry in registry.entries if entry.error]
    assert len(broken) == 1
    assert message in broken[0].error


def test_broken_entry_points_stop_nothing(monkeypatch):
    """One raises on import, one implements no hook, one misspells a hook; two share a name."""
    sources = {
        "raises:x": lambda: 1 / 0,
        "empty:x": lambda: types.ModuleType("empty"),
        "misspelt:x": lambda: plugin("misspelt", Still, hook="bias_modells"),
        "good:x": lambda: plugin("good", Still),
        "other:x": lambda: plugin(
            "other", type("Other", (Still,), {"__annotations__": {"kind": Literal["o"]}, "kind": "o"})
        ),
    }

    class Point(EntryPoint):
        def load(self):
            return sources[self.value]()

    points = [Point("same_name", value, "fusion_core") for value in sources]
    monkeypatch.setattr(module, "entry_points", lambda group: points)
    registry = Registry()
    registry.load()
    assert set(registry.classes(BiasModel)) == {"still", "o"}
    errors = {entry.module: entry.error for entry in registry.entries if entry.error}
    assert errors["raises:x"].startswith("ZeroDivisionError")
    assert "implements no hook" in errors["empty:x"]
    assert "bias_modells" in errors["misspelt:x"]
