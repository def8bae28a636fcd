"""The laws of every family of plugins, to be run on a plugin of your own.

In a test, one case for each law and example::

    @pytest.mark.parametrize("law", laws(WarmUp, [WarmUp(tau=600.0, walk=1e-6)]), ids=str)
    def test_laws(law):
        law()

or all at once, `check_plugin(WarmUp, [...])`. Where no examples are given, those of the class are taken
(`Plugin.examples`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from inspect import isfunction
from types import ModuleType

from fusion_core.contracts import (
    BiasModel,
    Effect,
    Exporter,
    Framing,
    MeasurementModel,
    Plugin,
    Source,
    Stimulus,
    ThermalMap,
)
from fusion_core.testing import (
    bias_models,
    effects,
    exporters,
    framings,
    measurement_models,
    samples,
    sources,
    stimuli,
    thermal_maps,
)

__all__ = ["Law", "check_plugin", "laws"]

MODULES: Mapping[type[Plugin], ModuleType] = {
    Plugin: samples,
    BiasModel: bias_models,
    ThermalMap: thermal_maps,
    Source: sources,
    Framing: framings,
    Effect: effects,
    MeasurementModel: measurement_models,
    Exporter: exporters,
    Stimulus: stimuli,
}


@dataclass(frozen=True)
class Law:
    """One law and the plugin that is held to it; to call it raises where the plugin breaks it."""

    name: str
    of: str
    check: Callable[[], None]

    def __call__(self) -> None:
        """Check the law; raises AssertionError, or what the plugin raises."""
        self.check()

    def __str__(self) -> str:
        return f"{self.of}: {self.name}"

    def broken(self) -> str | None:
        """Return the violation of the law, None where it holds."""
        try:
            self.check()
        except Exception as error:
            text = " ".join(str(error).split())
            return text if isinstance(error, AssertionError) else f"{type(error).__name__}: {text}"
        return None


def laws(cls: type[Plugin], examples: Iterable[Plugin] | None = None, *, stream: bytes = b"") -> list[Law]:
    """Return the laws of the class's family, for each example.

    Parameters
    ----------
    cls : type of Plugin
    examples : iterable of cls, or None
        Configured plugins that are held to the laws; `cls.examples()` by default.
    stream : bytes
        Of a framing: some whole frames as the device sends them, from the first byte on.
    """
    every = []
    chosen = list(cls.examples() if examples is None else examples)
    for k, plugin in enumerate(chosen):
        of = plugin.kind if len(chosen) == 1 else f"{plugin.kind}[{k}]"
        for contract, module in MODULES.items():
            for name, check in _laws_in(module, contract) if isinstance(plugin, contract) else ():
                more = {"stream": stream} if contract is Framing else {}
                every.append(Law(name, of, partial(check, plugin, **more)))
    return every


def _laws_in(module: ModuleType, contract: type[Plugin]) -> list[tuple[str, Callable[..., None]]]:
    """Return the laws of a family: the public functions of its module that take a plugin of it, named as they are.

    In the name of a function `_` stands for a space and `__` for a hyphen.
    """
    functions = {
        name: item for name, item in vars(module).items() if isfunction(item) and item.__module__ == module.__name__
    }
    return [
        (name.replace("__", "-").replace("_", " "), item)
        for name, item in functions.items()
        if not name.startswith("_") and contract.__name__ in item.__annotations__.values()
    ]


def check_plugin(cls: type[Plugin], examples: Iterable[Plugin] | None = None, *, stream: bytes = b"") -> None:
    """Check all laws of the class's family; see `laws`.

    Raises
    ------
    AssertionError
        With a line for each law that does not hold, or if there is no example to hold to them.
    """
    every = laws(cls, examples, stream=stream)
    assert every, f"{cls.__name__}: has no example; give some, or define the class method examples()"
    lines = [f"{law}: {text}" for law in every if (text := law.broken()) is not None]
    assert not lines, "\n".join(lines)
