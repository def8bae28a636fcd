"""Finding the installed plugins, and putting them into configurations.

Entry points are loaded one by one and registered by their value: one that fails is kept with its error and
does not stop the others, and two distributions may use the same entry-point name.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce
from importlib.metadata import EntryPoint, entry_points
from operator import or_
from typing import Annotated, Any, Literal, get_args, get_origin

import pluggy
from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from fusion_core import hookspecs
from fusion_core.contracts import BiasModel, Effect, MeasurementModel, Plugin, Source, ThermalMap
from fusion_core.contracts.framing import Framing
from fusion_core.errors import PluginError
from fusion_core.units import bias_unit, unsettled

FAMILIES: dict[type[Plugin], str] = {
    BiasModel: "bias_models",
    ThermalMap: "thermal_maps",
    Source: "sources",
    Framing: "framings",
    Effect: "effects",
    MeasurementModel: "measurement_models",
}


@dataclass(frozen=True)
class Entry:
    """One plugin class, or one entry point that could not be loaded (then `error` says why)."""

    family: str
    kind: str
    distribution: str
    version: str
    module: str
    error: str | None = None
    plugin: type[Plugin] | None = None


class Registry:
    """The plugins of one environment, by family and kind."""

    def __init__(self) -> None:
        self._manager = pluggy.PluginManager(hookspecs.PROJECT)
        self._manager.add_hookspecs(hookspecs)
        self.entries: list[Entry] = []

    def load(self) -> None:
        """Load every entry point of the group, each on its own."""
        for entry_point in sorted(entry_points(group=hookspecs.PROJECT), key=lambda e: (e.value, e.name)):
            if self._manager.has_plugin(entry_point.value):
                continue
            try:
                self.register(entry_point.load(), entry_point)
            except Exception as error:
                self._broken(entry_point.name, entry_point.value, error, entry_point)

    def register(self, module: Any, entry_point: EntryPoint | None = None) -> None:
        """Register one module (or object) that implements hooks; raises PluginError where it breaks a contract."""
        name = entry_point.value if entry_point else module.__name__
        self._manager.register(module, name)
        try:
            self._manager.check_pending()
        except pluggy.PluginValidationError:
            self._manager.unregister(module)
            raise
        found = [
            (family, hook, plugin)
            for family, hook in FAMILIES.items()
            for implementation in getattr(self._manager.hook, hook).get_hookimpls()
            if implementation.plugin is module
            for plugin in implementation.function()
        ]
        if not found:
            raise PluginError(
                f"{name} implements no hook; decorate a function named like one of {', '.join(FAMILIES.values())}"
            )
        for family, hook, plugin in found:
            try:
                self._add(family, hook, plugin, name, entry_point)
            except PluginError as error:
                self._broken(getattr(plugin, "__name__", repr(plugin)), name, error, entry_point, hook)

    def _add(
        self, family: type[Plugin], hook: str, plugin: type[Plugin], module: str, source: EntryPoint | None
    ) -> None:
        if not (isinstance(plugin, type) and issubclass(plugin, family)):
            raise PluginError(
                f"{plugin!r} is not a {family.__name__}; the hook {hook}() returns a list of such classes"
            )
        if inspect.isabstract(plugin):
            missing = ", ".join(sorted(plugin.__abstractmethods__))
            raise PluginError(f"{plugin.__name__} does not define {missing}, which every {family.__name__} must")
        kind = kind_of(plugin)
        other = next((e for e in self.entries if e.family == hook and e.kind == kind and e.error is None), None)
        if other:
            raise PluginError(
                f"kind '{kind}' is taken by {other.module} ({other.distribution}); give it a name of its own"
            )
        self.entries.append(Entry(hook, kind, *_origin(source), module, plugin=plugin))

    def _broken(self, kind: str, module: str, error: Exception, source: EntryPoint | None, family: str = "?") -> None:
        text = f"{type(error).__name__}: {error}"
        self.entries.append(Entry(family, kind, *_origin(source), module, error=text))

    def classes(self, family: type[Plugin]) -> dict[str, type[Plugin]]:
        """Return the working plugins of a family by kind."""
        hook = FAMILIES[family]
        return {e.kind: e.plugin for e in sorted(self.entries, key=lambda e: e.kind) if e.family == hook and e.plugin}


def kind_of(plugin: type[Plugin]) -> str:
    """Return the name under which a config asks for the plugin: the literal type of its field `kind`."""
    annotation = plugin.model_fields["kind"].annotation
    if get_origin(annotation) is Literal and len(get_args(annotation)) == 1:
        return str(get_args(annotation)[0])
    raise PluginError(f'{plugin.__name__} has no kind; declare `kind: Literal["my_kind"] = "my_kind"`')


def _origin(entry_point: EntryPoint | None) -> tuple[str, str]:
    if entry_point is None or entry_point.dist is None:
        return "", ""
    return entry_point.dist.name, entry_point.dist.version


@cache
def registry() -> Registry:
    """Return the registry of this environment, loaded at first use."""
    found = Registry()
    found.load()
    return found


def _refuse(family: str) -> Callable[[Any], Any]:
    def refuse(value: Any) -> Any:
        text = f"no plugin of the family {family} is installed; `driftlab plugins` lists those that are"
        raise PydanticCustomError("no_plugin", "{text}", {"text": text})

    return refuse


class Installed:
    """Annotation of a config field that accepts any installed plugin of its family, by `kind`.

    `Annotated[BiasModel, Installed(bias="rad/s")]`; `bias` is the unit of the bias in the plugin's own fields.
    """

    def __init__(self, *, bias: str | None = None) -> None:
        self.bias = bias

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        classes = registry().classes(source)
        if not classes:
            return core_schema.no_info_before_validator_function(_refuse(FAMILIES[source]), core_schema.any_schema())
        union = reduce(or_, classes.values())
        tagged = Annotated[union, Field(discriminator="kind")] if len(classes) > 1 else union
        schema = handler.generate_schema(tagged)
        if self.bias is None:
            return schema

        def validate(value: Any, inner: core_schema.ValidatorFunctionWrapHandler) -> Any:
            with bias_unit(self.bias):
                return inner(dict(value) if isinstance(value, Plugin) and unsettled(value) else value)

        return core_schema.no_info_wrap_validator_function(validate, schema)
