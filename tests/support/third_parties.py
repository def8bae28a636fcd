"""Effects as third parties might ship them, in registries of their own."""

import types
from importlib import import_module
from typing import Literal

import numpy as np

from fusion_core.contracts import Effect, on_each_axis
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Registry


def effect(kind, **own):
    """Return a class of an effect on the voltage, with some of its members replaced."""

    def signature(self, chunk, memory):
        return on_each_axis(chunk["voltage"], len(self.axes)), None

    def candidates(self):
        yield self

    members = {
        "__module__": f"acme_{kind}",
        "__annotations__": {"kind": Literal[kind]},
        "kind": kind,
        "requires": property(lambda self: ("voltage",)),
        "explanation": property(lambda self: "made for a test"),
        "signature": signature,
        "candidates": candidates,
        **own,
    }
    return type(kind.title(), (Effect,), members)


def registry_of(*classes, kinds=()):
    """Return a registry of classes of a third party, which come first, and the built-in effects of some kinds."""
    found = Registry()
    if classes:
        acme = types.ModuleType("acme")
        acme.effects = hookimpl(lambda: list(classes), specname="effects")
        found.register(acme)
    for kind in kinds:
        found.register(import_module(f"fusion_plugins.effects.{kind}"))
    assert not [entry for entry in found.entries if entry.error]
    return found


def _raises(self, *arguments):
    raise ValueError("the licence server does not answer")


def _no_axes(self, chunk, memory):
    return np.ones((len(chunk), 2)), None


def _nan(self, chunk, memory):
    return np.full((len(chunk), 3, 3), np.nan), None


def _as_many_as_rows(self, chunk, memory):
    return np.ones((len(chunk), 3, len(chunk) % 7 + 1)), None


BROKEN = {
    "proposals_raise": (effect("proposals_raise", proposals=_raises), "proposals", "licence server"),
    "candidates_raise": (effect("candidates_raise", candidates=_raises), "", "licence server"),
    "requires_raises": (effect("requires_raises", requires=property(_raises)), "", "licence server"),
    "signature_raises": (effect("signature_raises", signature=_raises), "signature", "licence server"),
    "no_axes": (effect("no_axes", signature=_no_axes), "signature", "shape"),
    "nan": (effect("nan", signature=_nan), "signature", "finite"),
    "uneven": (effect("uneven", signature=_as_many_as_rows), "signature", ""),
    "no_pair": (effect("no_pair", signature=lambda self, chunk, memory: None), "signature", ""),
    "fading_is_short": (effect("fading_is_short", fading=lambda self, c, m: (np.ones(3), None)), "fading", "shape"),
    "fading_is_nan": (effect("fading_is_nan", fading=lambda self, c, m: (np.full(len(c), np.nan), 0)), "fading", "fin"),
    "input_is_nan": (effect("input_is_nan", input=lambda self, c, m: (np.full(len(c), np.nan), 0)), "input", "finite"),
    "input_raises": (effect("input_raises", input=_raises), "input", "licence server"),
}
