"""Plugins are found one by one: a broken one is shown and stops nothing."""

import subprocess
import sys
import types
from concurrent.futures import ThreadPoolExecutor, wait
from importlib.metadata import EntryPoint
from pathlib import Path
from threading import Event
from typing import Annotated, Literal

import numpy as np
import pytest

from fusion_core.contracts import BiasModel, Prior, Transition
from fusion_core.errors import ConfigError, PluginError
from fusion_core.hookspecs import hookimpl
from fusion_core.host import registry as module
from fusion_core.host.config import Document, validate
from fusion_core.host.registry import Installed, Registry, kind_of
from fusion_core.settings import Settings


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


def test_a_marked_class_is_a_plugin_of_the_module_that_defines_it():
    own, other = types.ModuleType(Still.__module__), types.ModuleType("other")
    own.Marked = other.Marked = hookimpl(type("Marked", (Still,), {"__module__": own.__name__}))
    own.Derived = type("Derived", (own.Marked,), {"__module__": own.__name__})  # bears no mark of its own
    registry = Registry()
    registry.register(own)
    assert registry.classes(BiasModel) == {"still": own.Marked}
    with pytest.raises(PluginError, match="other implements no hook"):
        Registry().register(other)


def test_a_marked_class_of_no_family_is_shown_with_its_error():
    own = types.ModuleType(__name__)
    own.Lonely = hookimpl(type("Lonely", (), {"__module__": __name__}))
    registry = Registry()
    registry.register(own)
    (broken,) = [entry for entry in registry.entries if entry.error]
    assert "Lonely is marked as a plugin and of no family; derive it from a contract" in broken.error


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


def test_the_entry_point_of_each_built_in_plugin_says_its_family_and_kind():
    """By these it is loaded where its kind is asked for."""
    registry = module.Registry()
    registry.load()
    waiting = set(registry._waiting)
    assert len(waiting) > 30
    assert waiting == {(entry.family, entry.kind) for entry in registry.entries if entry.family != "products"}
    assert registry.broken() == {}


def test_a_built_in_plugin_is_loaded_where_its_kind_is_asked_for():
    code = (
        "import sys\n"
        "from fusion_core.contracts import Source\n"
        "from fusion_core.host.registry import registry\n"
        "def loaded(): return sorted(n.split('.')[2] for n in sys.modules if n.startswith('fusion_plugins.sources.'))\n"
        "found = registry()\n"
        "assert 'mat' in found.kinds(Source) and loaded() == [], loaded()\n"
        "assert found.find(Source, 'mat').__name__ and 'mat' in loaded() and 'ulog' not in loaded(), loaded()\n"
        "assert set(found.classes(Source)) == set(found.kinds(Source)) and 'ulog' in loaded()\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


class Home(types.SimpleNamespace):
    __hash__ = object.__hash__


class BuiltIn(EntryPoint):
    dist = Home(name="driftlab", version="0")

    def load(self):
        if self.name == "still":
            return plugin("still", Still)
        raise ImportError("libstill.so: cannot open")


def test_the_kind_of_a_built_in_plugin_is_taken_before_it_is_loaded(monkeypatch):
    class Foreign(EntryPoint):
        def load(self):
            return plugin("acme", type("Acme", (Still,), {"__annotations__": {"kind": Literal["still"]}}))

    points = [
        Foreign("acme", "acme", "fusion_core"),
        BuiltIn("still", "fusion_plugins.bias_models.still", "fusion_core"),
    ]
    monkeypatch.setattr(module, "entry_points", lambda group: points)
    registry = Registry()
    registry.load()
    assert registry.find(BiasModel, "still") is Still
    assert "is taken by fusion_plugins.bias_models.still" in registry.broken()["still"]


def test_a_config_that_names_a_built_in_plugin_which_cannot_be_loaded_says_why(monkeypatch):
    points = [
        BuiltIn(kind, f"fusion_plugins.bias_models.{kind}", "fusion_core") for kind in ("still", "missing", "gone")
    ]
    monkeypatch.setattr(module, "entry_points", lambda group: points)
    registry = Registry()
    registry.load()
    monkeypatch.setattr(module, "_found", registry)

    class Holder(Settings):
        bias: Annotated[BiasModel, Installed()]

    assert Holder.model_validate({"bias": {"kind": "still"}}).bias == Still()
    with pytest.raises(ConfigError, match=r"kind 'gone' is installed but broken \(ImportError: libstill"):
        validate(Holder, Document(Path("c.yaml"), {"bias": {"kind": "gone"}}), registry.broken)
    with pytest.raises(ConfigError, match=r"kind 'stil' is not installed; did you mean still\?"):
        validate(Holder, Document(Path("c.yaml"), {"bias": {"kind": "stil"}}), registry.broken)


def test_a_kind_that_another_thread_is_loading_is_not_missing(monkeypatch):
    begun, go_on = Event(), Event()

    class Slow(BuiltIn):
        def load(self):
            begun.set()
            go_on.wait(10)
            return super().load()

    monkeypatch.setattr(module, "entry_points", lambda group: [Slow("still", "fusion_plugins.bias_models.still", "x")])
    registry = Registry()
    registry.load()
    with ThreadPoolExecutor() as threads:
        loading = threads.submit(registry.find, BiasModel, "still")
        assert begun.wait(10)
        kinds = threads.submit(registry.kinds, BiasModel)
        wait([kinds], 0.1)
        go_on.set()
        assert kinds.result(10) == ["still"]
        assert loading.result(10) is Still
