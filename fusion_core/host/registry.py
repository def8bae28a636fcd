"""Discovery of the installed plugins, and their place in configurations.

Entry points are loaded one by one and registered by their value: one that fails is kept with its error and does not
stop the others, and two distributions may use the same entry-point name. The built-in ones come first, and who comes
second does not get a name that is taken.

A built-in plugin is loaded where its kind is asked for: its entry point says family and kind, as
`zupt = "fusion_plugins.measurement_models.zupt"`. Those of others are loaded at once, for they may hold any.

A class is a plugin where it is a whole class of its family, with a kind, that a config can hold.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, partial, reduce
from importlib.metadata import Distribution, EntryPoint, entry_points
from operator import or_
from pathlib import Path
from threading import RLock
from typing import Annotated, Any, Literal, cast, get_args, get_origin

from pydantic import ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError, PydanticKnownError, PydanticOmit, PydanticUseDefault, core_schema

from fusion_core.contracts.families import FAMILIES
from fusion_core.contracts.plugin import HOME, LOADERS, Family, Origin, Plugin
from fusion_core.errors import FusionError, PluginError, describe_error, quote
from fusion_core.hookspecs import PROJECT
from fusion_core.host.guard import guard
from fusion_core.settings import did_you_mean
from fusion_core.units import bias_unit, problem, unsettled

PLUGINS = "fusion_plugins"
BUILT_IN = (f"{PLUGINS}.", "driftlab.")  # modules of the distribution HOME
PRODUCTS = "products"
ANSWERS = (ValueError, AssertionError, ValidationError, PydanticCustomError, PydanticKnownError, PydanticOmit,
           PydanticUseDefault, FusionError, KeyboardInterrupt)  # fmt: skip  # what a validator may raise


@dataclass(frozen=True)
class Entry:
    """One plugin class or product, or one entry point that could not be loaded (then `error` says why)."""

    family: str
    kind: str
    distribution: str
    version: str
    module: str
    error: str | None = None
    plugin: type[Plugin] | None = None
    path: Path | None = None  # of a product


class Registry:
    """The plugins of one environment, by family and kind."""

    def __init__(self) -> None:
        self.families = {family.name: family for family in FAMILIES}
        self._entries: list[Entry] = []
        self._waiting: dict[tuple[str, str], EntryPoint] = {}  # built-in ones by family and kind
        self._lock = RLock()

    def load(self) -> None:
        """Load the entry points of the group, each on its own, but for built-in plugins."""
        points = sorted(entry_points(group=PROJECT), key=_order)
        self._waiting = {place: point for point in reversed(points) if (place := _place(point)) is not None}
        self._load([point for point in points if _place(point) is None])

    def _load(self, points: Iterable[EntryPoint]) -> None:
        """Load entry points; families before the plugins that may be of them."""
        modules: dict[str, tuple[Any, EntryPoint]] = {}
        for point in points:
            if point.value not in modules and (module := self._attempt(point, point.load)) is not None:
                modules[point.value] = module, point
        for value, (module, point) in list(modules.items()):
            if self._attempt(point, partial(self._bring_families, module)) is None:
                del modules[value]
        for module, point in modules.values():
            self._attempt(point, partial(self._register, module, point.value, point))

    def _bring(self, family: str | None = None, kind: str | None = None) -> None:
        """Load the built-in plugins of a family and kind that were not asked for before; None stands for all."""
        with self._lock:
            places = [p for p in self._waiting if family in (None, p[0]) and kind in (None, p[1])]
            self._load([self._waiting.pop(place) for place in places])

    @property
    def entries(self) -> list[Entry]:
        """Every plugin and product, and what could not be loaded."""
        self._bring()
        return self._entries

    def register(self, module: Any) -> None:
        """Register one module (or object) that implements hooks; raises PluginError where it breaks a contract."""
        self._bring_families(module)
        self._register(module, module.__name__, None)

    def family_of(self, contract: type[Plugin]) -> Family:
        """Return the family of a contract; raises PluginError where there is none."""
        for family in self.families.values():
            if family.contract is contract:
                return family
        raise PluginError(f"{contract.__name__} is the contract of no family; a hook families() adds one")

    def classes(self, contract: type[Plugin]) -> dict[str, type[Plugin]]:
        """Return the working plugins of a family by kind."""
        name = self.family_of(contract).name
        self._bring(name)
        return {e.kind: e.plugin for e in sorted(self._entries, key=lambda e: e.kind) if e.family == name and e.plugin}

    def kinds(self, contract: type[Plugin]) -> list[str]:
        """Return the kinds of a family's plugins; one that was not loaded yet may turn out to be broken."""
        name = self.family_of(contract).name
        with self._lock:  # what another thread is loading is in neither
            loaded = {e.kind for e in self._entries if e.family == name and e.plugin}
            return sorted(loaded | {kind for family, kind in self._waiting if family == name})

    def find(self, contract: type[Plugin], kind: str) -> type[Plugin] | None:
        """Return the plugin of a family and kind; None where there is none that works."""
        name = self.family_of(contract).name
        self._bring(name, kind)
        return next((e.plugin for e in self._entries if (e.family, e.kind) == (name, kind) and e.plugin), None)

    def products(self) -> dict[str, Path]:
        """Return the files of the products by name."""
        return {e.kind: e.path for e in self._entries if e.family == PRODUCTS and e.path is not None}

    def broken(self) -> dict[str, str]:
        """Return the errors of what could not be loaded, by kind or name."""
        return {e.kind: e.error for e in self.entries if e.error is not None}

    def _attempt(self, point: EntryPoint, do: Callable[[], Any]) -> Any:
        """Return the result of an action on an entry point; None, and an entry, where it raises, were it SystemExit."""
        try:
            return do()
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            self._break(point.name, point.value, error, point)
            return None

    def _bring_families(self, module: Any) -> bool:
        for family in self._answers(module, "families"):
            if not (isinstance(family, Family) and inspect.isclass(family.contract)):
                raise PluginError(f"families() returned {quote(repr(family))}; return a list of Family(...)")
            if family.name in (*self.families, PRODUCTS) or not family.name.isidentifier():
                raise PluginError(f"family '{quote(family.name)}' is taken, or is no name; give it one of its own")
            self.families[family.name] = family
        return True

    def _answers(self, module: Any, hook: str) -> Iterator[Any]:
        """Yield the items that a module's implementation of a hook returns; nothing where it has none."""
        if hook in _hooks_of(module):
            items = getattr(module, hook)()
            yield from items.items() if isinstance(items, Mapping) else items

    def _register(self, module: Any, name: str, point: EntryPoint | None) -> None:
        hooks = _hooks_of(module)
        known = (*self.families, PRODUCTS, "families")
        unknown = [hook for hook in hooks if hook not in known]
        if unknown or not (hooks or _classes_of(module)):
            have = f"an unknown hook {unknown[0]}" if unknown else "no hook"
            otherwise = f"decorate a function named like one of {', '.join(known)}"
            raise PluginError(f"{name} implements {have}; {did_you_mean(''.join(unknown[:1]), known, otherwise)}")
        for hook, item in self._items(module):
            try:
                self._add(hook, item, name, point)
            except PluginError as error:
                self._break(_called(item), name, error, point, hook)

    def _items(self, module: Any) -> Iterator[tuple[str, Any]]:
        """Yield the plugins and products of a module with their hooks: those that functions return, then classes."""
        for hook in _hooks_of(module):
            yield from () if hook == "families" else ((hook, item) for item in self._answers(module, hook))
        for item in _classes_of(module):
            yield next((name for name, family in self.families.items() if issubclass(item, family.contract)), "?"), item

    def _add(self, hook: str, item: Any, module: str, point: EntryPoint | None) -> None:
        origin = Origin(hook, *_distribution(point))
        if hook == PRODUCTS:
            kind, path = _product(*item)
            self._check_free(origin, kind)
            self._entries.append(Entry(hook, kind, *origin[1:], module, path=path))
            return
        if hook not in self.families:
            raise PluginError(f"{item.__name__} is marked as a plugin and of no family; derive it from a contract")
        family = self.families[hook]
        check_class(family, item)
        kind = kind_of(item)
        self._check_free(origin, kind)
        if not (point and _is_built_in(point)):
            check_fields(item)
        guard(item, family, origin)
        self._entries.append(Entry(hook, kind, *origin[1:], module, plugin=item))

    def _check_free(self, origin: Origin, kind: str) -> None:
        self._bring(origin.family, kind)
        other = next((e for e in self._entries if (e.family, e.kind, e.error) == (origin.family, kind, None)), None)
        if other:
            who = " ".join(filter(None, origin[1:])) or "this one"
            raise PluginError(
                f"kind '{kind}' is taken by {other.module} ({other.distribution} {other.version}), {who} came second; "
                "give it a name of its own"
            )

    def _break(self, kind: str, module: str, error: BaseException, point: EntryPoint | None, family: str = "?") -> None:
        self._entries.append(Entry(family, kind, *_distribution(point), module, error=describe_error(error, 300)))


def _hooks_of(module: Any) -> list[str]:
    """Return the names of the functions of a module that are marked as implementations of hooks."""
    members = {name: getattr(module, name, None) for name in dir(module)}
    return [name for name, item in members.items() if inspect.isroutine(item) and hasattr(item, f"{PROJECT}_impl")]


def _classes_of(module: Any) -> list[type]:
    """Return the classes of a module itself that are marked as plugins."""
    classes = [item for item in vars(module).values() if inspect.isclass(item) and f"{PROJECT}_impl" in vars(item)]
    return [item for item in classes if item.__module__ == module.__name__]


def _product(name: Any, place: Any) -> tuple[str, Path]:
    path = Path(str(place))
    if not (isinstance(name, str) and name and name.isprintable() and "/" not in name):
        raise PluginError(f"product {quote(repr(name))}: is no name; write one like acme_x1")
    if not path.is_file():
        raise PluginError(f"product {name}: {path} is not there; products() returns names with the paths of YAML files")
    return name, path


def _called(item: Any) -> str:
    """Return the name of something that is broken: its kind or name where it has one."""
    if isinstance(item, tuple):
        return quote(item[0])
    try:
        return kind_of(item)
    except Exception:
        return str(getattr(item, "__name__", quote(repr(item))))


def _distribution(point: EntryPoint | None) -> tuple[str, str]:
    return ("", "") if point is None or point.dist is None else _release(point.dist)


@cache
def _release(distribution: Distribution) -> tuple[str, str]:
    return distribution.name, distribution.version  # each reads its metadata anew


def _is_built_in(point: EntryPoint) -> bool:
    return _distribution(point)[0] == HOME and point.value.startswith(BUILT_IN)


def _place(point: EntryPoint) -> tuple[str, str] | None:
    """Return the family and the kind of a built-in plugin; None of what is none."""
    package, _, rest = point.value.partition(".")
    if package != PLUGINS or not _is_built_in(point):
        return None
    return rest.partition(".")[0], point.name.rpartition(".")[2]


def _order(point: EntryPoint) -> tuple[bool, str, str, str]:
    return not _is_built_in(point), _distribution(point)[0], point.value, point.name


_found: Registry | None = None


def registry() -> Registry:
    """Return the registry of this environment, loaded at first use."""
    global _found
    if _found is None:
        _found = Registry()
        _found.load()
        LOADERS.append(_found._bring)
    return _found


class Installed:
    """Annotation of a config field that accepts any installed plugin of its family, by `kind`.

    `Annotated[BiasModel, Installed(bias="rad/s")]`; `bias` is the unit of the bias in the plugin's own fields.
    """

    def __init__(self, *, bias: str | None = None) -> None:
        self.bias = bias
        self.contract: type[Plugin] = Plugin

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        self.contract = source
        if alone.get():
            return core_schema.any_schema()
        kinds = registry().kinds(source)
        if not kinds:
            text = f"no plugin of the family {registry().family_of(source).name} is installed; install one"

            def refuse(value: Any) -> Any:
                raise problem(text)

            return core_schema.no_info_before_validator_function(refuse, core_schema.any_schema())
        if len(kinds) > 1:
            choices = {kind: _choice(source, kind) for kind in kinds}
            schema: core_schema.CoreSchema = core_schema.tagged_union_schema(choices, "kind")
        else:
            schema = handler.generate_schema(registry().find(source, kinds[0]))

        def validate(value: Any, inner: core_schema.ValidatorFunctionWrapHandler) -> Any:
            value = dict(value) if isinstance(value, Plugin) and unsettled(value) else value
            try:
                if self.bias is None:
                    return inner(value)
                with bias_unit(self.bias):
                    return inner(value)
            except ANSWERS:
                raise
            except BaseException as error:
                kind = value.get("kind", "?") if isinstance(value, dict) else "?"
                raise PluginError(
                    f"{quote(kind)}: checking its settings: {describe_error(error)}; mend or remove the plugin",
                    plugin=str(kind),
                ) from error

        as_it_is = core_schema.plain_serializer_function_ser_schema(lambda plugin: plugin)
        return core_schema.no_info_wrap_validator_function(validate, schema, serialization=as_it_is)

    def __get_pydantic_json_schema__(self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        """Return the schema of all plugins of the family."""
        if alone.get() or not (classes := registry().classes(self.contract)):
            return handler(core_schema.any_schema())
        union = reduce(or_, classes.values())
        tagged = Annotated[union, Field(discriminator="kind")] if len(classes) > 1 else union
        return handler(TypeAdapter(cast(Any, tagged)).core_schema)


def _choice(contract: type[Plugin], kind: str) -> core_schema.CoreSchema:
    """Return the schema of one kind of a family: its plugin is loaded where a config names it."""

    def validate(value: Any, info: core_schema.ValidationInfo) -> Any:
        plugin = registry().find(contract, kind)
        if plugin is None:
            known = ", ".join(map(repr, registry().classes(contract)))
            raise PydanticKnownError(
                "union_tag_invalid", {"discriminator": "'kind'", "tag": kind, "expected_tags": known}
            )
        return plugin.model_validate(value, context=info.context)

    return core_schema.with_info_plain_validator_function(validate)


alone: ContextVar[bool] = ContextVar("alone", default=False)  # a class is looked at without the plugins within it


def check_class(family: Family, plugin: Any) -> None:
    """Raise PluginError where something is not a whole class of the family, or was written for another contract."""
    name = family.contract.__name__
    if not (isinstance(plugin, type) and issubclass(plugin, family.contract)):
        raise PluginError(
            f"{quote(repr(plugin))} is not a {name}; the hook {family.name}() returns a list of such classes"
        )
    if inspect.isabstract(plugin):
        missing = ", ".join(sorted(plugin.__abstractmethods__))
        raise PluginError(f"{plugin.__name__} does not define {missing}, which every {name} must")
    classes = plugin.__mro__[: plugin.__mro__.index(family.contract)]
    written = next((vars(base)["contract"] for base in classes if "contract" in vars(base)), 1)
    if written != family.contract.contract:
        raise PluginError(
            f"{plugin.__name__} was written for version {quote(written)} of the contract {name}, version "
            f"{family.contract.contract} is spoken here; install a release of the plugin for it"
        )


def kind_of(plugin: type[Plugin]) -> str:
    """Return the name under which a config asks for the plugin: the literal type of its field `kind`."""
    annotation = plugin.model_fields["kind"].annotation
    if get_origin(annotation) is Literal and len(get_args(annotation)) == 1:
        return str(get_args(annotation)[0])
    raise PluginError(f'{plugin.__name__} has no kind; declare `kind: Literal["my_kind"] = "my_kind"`')


def check_fields(plugin: type[Plugin]) -> None:
    """Raise PluginError where a config or its JSON schema cannot be made of the class: it has a field of no known type.

    Classes are built at first use. This builds another in its place, whose fields for plugins accept anything.
    """
    token = alone.set(True)
    try:
        body = {"__module__": plugin.__module__, "model_config": ConfigDict(defer_build=False)}
        make: Any = type(plugin)
        stand_in = make(plugin.__name__, (plugin,), body)
        stand_in.model_rebuild(raise_errors=True)
        stand_in.model_json_schema()
    except Exception as error:
        first = str(error).splitlines()[0].partition(". ")[0]
        raise PluginError(
            f"{plugin.__name__}: no config can hold it ({quote(first, 200)}); correct its fields"
        ) from None
    finally:
        alone.reset(token)
