"""The boundary about a plugin: what goes in cannot be written to, what comes out has its name on it."""

import pickle
from functools import cached_property
from typing import Literal

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_core.contracts import Family, Plugin
from fusion_core.contracts.plugin import Origin, origin_of
from fusion_core.errors import MissingChannel, PluginError
from fusion_core.host.guard import guard, guarded
from fusion_core.host.provenance import participants, upgraded

N = 5


class Tool(Plugin):
    """A contract."""

    def turn(self, x):
        """By default as it was."""
        return self.inner(x)

    def inner(self, x):
        return x

    @property
    def size(self):
        return 1

    @cached_property
    def weight(self):
        return 1

    def each(self):
        yield 1

    def save(self):
        return None


class Mine(Tool):
    kind: Literal["mine"] = "mine"
    wrong: bool = True

    def inner(self, x):
        if self.wrong:
            x += 1
        return x

    @property
    def size(self):
        raise KeyError("size")

    @cached_property
    def weight(self):
        raise KeyError("weight")

    def each(self):
        yield 1
        raise SystemExit

    def save(self):
        raise OSError(28, "No space left on device")


def positive(plugin, answer, x):
    return answer if np.all(answer > 0) else None


guard(Mine, Family("tools", Tool, "turning", {"inner": positive}), Origin("tools", "acme", "1.0"))


def test_what_is_raised_names_the_plugin_and_what_it_did():
    named = r"^mine \(acme 1\.0\): "
    with pytest.raises(PluginError, match=named + "inner: .*read-only; what a plugin is given is shared") as caught:
        Mine().turn(np.ones(3))
    assert (caught.value.plugin, caught.value.family) == ("mine", "tools")
    assert isinstance(caught.value.__cause__, ValueError)
    for name in ("size", "weight"):
        with pytest.raises(PluginError, match=f"{named}{name}: KeyError: '{name}'; mend or remove the plugin"):
            getattr(Mine(), name)
    items = Mine().each()
    assert next(items) == 1
    with pytest.raises(PluginError, match=f"{named}each: SystemExit"):
        next(items)
    with pytest.raises(OSError, match="No space left"):  # of the disk, not of the plugin
        Mine().save()
    assert pickle.loads(pickle.dumps(caught.value)).plugin == "mine"


def test_what_is_meant_for_the_user_passes_as_it_is():
    with pytest.raises(MissingChannel, match="channel 'x'"), guarded(Mine(), "asking"):
        Chunk(np.zeros(1))["x"]
    with pytest.raises(KeyboardInterrupt), guarded(Mine(), "waiting"):
        raise KeyboardInterrupt


def test_answers_are_checked_and_arguments_are_not_copied():
    x = np.ones(3)
    answer = Mine(wrong=False).turn(x)
    assert np.shares_memory(answer, x)
    assert x.flags.writeable  # it is the plugin's view that is not
    assert not answer.flags.writeable
    assert Mine(wrong=False).turn(-x) is None


def test_a_class_is_guarded_once_and_a_class_of_the_user_not_at_all():
    before = Mine.inner
    guard(Mine, Family("tools", Tool, "turning"), Origin("tools", "acme", "1.0"))
    assert Mine.inner is before
    assert origin_of(Tool) is None
    assert Tool.size.fget.__name__ == "size"
    assert not hasattr(Tool.inner, "__guarded__")


def test_nobody_can_write_to_a_chunk():
    t, x = np.arange(N, dtype=float), np.zeros((N, 2))
    chunk = Chunk(t, {"x": x}, Chunk(t[:1] - 1, {"x": x[:1]}))
    parts = (chunk, chunk.previous, chunk.part(1, 3), chunk.having(y=t.copy()), chunk.where(t > 1), chunk.last())
    for part in parts:
        for array in (part.t, *part.channels.values()):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 7
        with pytest.raises(TypeError):
            part.channels["x"] = x
    assert np.shares_memory(chunk["x"], x)
    x[:] = 1  # whose it is may
    again = pickle.loads(pickle.dumps(chunk))
    np.testing.assert_array_equal(again["x"], chunk["x"])
    with pytest.raises(ValueError, match="read-only"):
        again["x"][:] = 7


def test_participants_are_found_wherever_they_stand():
    mine = {"family": "tools", "kind": "mine", "distribution": "acme", "version": "1.0"}
    assert participants({"a": [Mine(), (Mine(wrong=False),)]}) == [mine]
    assert participants(None, Mine) == [mine]
    assert upgraded([mine], [mine]) == []
    assert upgraded([], [mine]) == []
    assert upgraded([{**mine, "version": "0.9"}], [mine]) == ["mine was of acme 0.9 and is of acme 1.0"]
