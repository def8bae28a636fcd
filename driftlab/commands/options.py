"""Options of the command line, made from the signature and the numpydoc text of a command's function.

The function is read in its source text, and its module is imported when the command is called: help is there at once.
The first line of a parameter's text is its help.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from typer.core import TyperCommand

from driftlab.commands.compilation import watch
from driftlab.commands.console import check_limits, in_session, load, load_at_first_use, pairs, print_json, progress
from driftlab.storage.system import keep_freed_memory

TYPES: dict[str, Any] = {  # by the first word of an annotation; of what is not here there is no option
    "bool": bool, "int": int, "float": float, "str": str, "Place": Path, "ConfigLike": Path,
    "Mapping[str, ConfigLike]": list[Path], "DataLike": list[str], "Sequence[str]": list[str],
    "Mapping[str, Any]": list[str], "Mapping[str, str]": list[str],
}  # fmt: skip
ARGUMENTS = {
    "config": "CONFIG",
    "configs": "CONFIG...",
    "kind": "KIND",
    "what": "MAP|CONFIG",
    "file": "FILE",
    "logs": "LOG...",
}
FLAGS = {
    "data": "--input", "settings": "--set", "units": "--unit", "columns": "--column", "map_kind": "--kind",
}  # fmt: skip  # where the name differs
RECORDING = "PATH[::START:STOP]"
METAVARS = {
    "acknowledge": "UNIT=NOTE", "after": RECORDING, "appraiser": "COLUMN", "by": "COLUMN",
    "calibration": RECORDING, "channel": "CHANNEL", "columns": "CHANNEL=NAME,...",
    "data": RECORDING, "dates": "day|month", "decimal": "comma|point", "duration": "TIME",
    "export": "px4|ardupilot", "family": "FAMILY.json", "fit_map": "MAP", "heading": "ANGLE", "holdout": RECORDING,
    "hours": "TIME", "interval": "TIME", "lag": "TIME", "latitude": "ANGLE", "operator": "NAME", "out": "DIR",
    "pages": "NAME|GLOB|all", "range": "LOW..HIGH", "rate": "RATE", "record": "FILE.h5", "report": "DIR",
    "rules": "western-electric|nelson", "run": "DIR", "scheduler": "ADDRESS", "seed": "N", "settings": "KEY=VALUE",
    "sigma": "SIGMA", "start": "TEMPERATURE", "stimulus": "KIND",
    "table": "RATE", "terms": "TERM,...", "to": "URL", "train": RECORDING, "units": "CHANNEL=UNIT", "walk": "WALK",
    "web": "[PORT]", "without": "KIND",
}  # fmt: skip
PAIRS = {
    "settings": ("--set", "KEY=VALUE", "'step=0.5 K'"),
    "units": ("--unit", "CHANNEL=UNIT", "gyro=deg/s"),
    "columns": ("--column", "CHANNEL=NAME", "gyro=wx,wy,wz"),
    "acknowledge": ("--acknowledge", "UNIT=NOTE", "'0021=cable replaced'"),
}
HELP = {"config": "The config, a YAML file.", "json": "Print JSON for programs instead of text."}


@dataclass(frozen=True)
class Option:
    """One option or argument of the command line: its flag and metavar in one text, as `--out DIR`."""

    form: str
    help: str = ""
    kind: Any = bool
    default: Any = False
    limits: Mapping[str, Any] = field(default_factory=dict)

    def parameter(self, name: str) -> inspect.Parameter:
        """Return it as the parameter of a function that typer takes."""
        flag, _, metavar = self.form.partition(" ")
        if flag.startswith("-"):
            info = typer.Option(*flag.split(","), metavar=metavar or None, help=self.help, **self.limits)
        else:
            info = typer.Argument(metavar=self.form, help=self.help)
        kind = self.kind if self.default is not None else self.kind | None
        return inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=self.default, annotation=Annotated[kind, info]
        )


NEEDED = inspect.Parameter.empty
JSON = Option("--json", HELP["json"])
ENFORCE_LIMITS = Option(
    "--enforce-limits", "Exit with 1 where a limit fails, with 3 where one is undecided or missing."
)


SET = Option("--set KEY=VALUE", "Set a key of the config, e.g. 'filter.align=30 s'; repeatable.", list[str], None)
SAID = {
    "quiet": Option("-q,--quiet", "Say nothing but errors, and what --json asks for."),
    "verbose": Option("-v,--verbose", "Say how long each stage took, and which plugins ran."),
}


@dataclass(frozen=True)
class Command:
    """A command of the command line, and what of its function differs there.

    Attributes
    ----------
    name : str
        Of the function, and of its module in `driftlab.commands` where `module` names no other.
    doing : str
        What its progress is called; empty where it shows none.
    metavars : mapping of str to str
        Of parameters, where they are not the usual ones.
    options : mapping of str to Option
        Those that the command line alone has; one that is called as a parameter stands in its place.
    defaults : mapping of str to value
        Where they differ; `NEEDED` for what the command line cannot do without.
    several : bool
        Whether it takes several recordings.
    measuring : bool
        Whether the noise of its config is what it measures.
    kind : type, optional
        Of typer's command.
    indent : int
        Of its JSON.
    """

    name: str
    doing: str = ""
    module: str = ""
    title: str = ""
    metavars: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Option] = field(default_factory=lambda: {"json": JSON})
    defaults: Mapping[str, Any] = field(default_factory=dict)
    several: bool = False
    measuring: bool = False
    kind: type[TyperCommand] | None = None
    indent: int = 2

    def __post_init__(self) -> None:
        object.__setattr__(self, "module", self.module or f"driftlab.commands.{self.name}")

    @property
    def typed(self) -> str:
        """Its name as it is typed."""
        return self.title or self.name.replace("_", "-")

    def made(self) -> TyperCommand:
        """Return it as typer runs it."""
        declared, own = declaration(self.module, self.name)
        texts = {**declaration("driftlab.commands.run", "run")[1], **own, **HELP}
        parameters, rest = [], dict(self.options)
        for name, (annotation, default) in declared.items():
            if name in rest:
                option = rest.pop(name)
                parameters.append(replace(option, help=option.help or texts[name]).parameter(name))
            elif annotation in TYPES:
                flag = FLAGS.get(name, f"--{name.replace('_', '-')}")
                usual = f"{flag} {self.metavars.get(name) or METAVARS.get(name, '')}"
                form = ARGUMENTS.get(name, usual) if default is NEEDED else usual
                value = self.defaults.get(name, None if default == () else default)
                parameters.append(Option(form, texts[name], TYPES[annotation], value).parameter(name))
        parameters += [option.parameter(name) for name, option in rest.items()]

        options = {**({"set_": SET} if {"config", "configs"} & declared.keys() else {}), **SAID}
        parameters += [option.parameter(name) for name, option in options.items()]

        def call(*, quiet: bool, verbose: bool, set_: list[str] | None = None, **given: Any) -> None:
            keep_freed_memory()
            load_at_first_use("numpy.f2py", "numpy.testing")  # scipy takes all names of numpy: half of its own start
            with in_session(quiet, verbose, set_):
                watch(self.name)
                self._call(import_module(self.module), given)

        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        alone = typer.Typer(rich_markup_mode=None, add_completion=False)
        alone.command(self.typed, help=summary(self.module, self.name), cls=self.kind)(call)
        return cast(TyperCommand, typer.main.get_command(alone))

    def _call(self, module: Any, given: dict[str, Any]) -> None:
        """Load the config, call the function, and print its result."""
        from driftlab.storage.json import plain

        function = getattr(module, self.name)
        known, _ = declaration(self.module, self.name)
        options = {name: value for name, value in given.items() if name not in known}
        arguments = {name: value for name, value in given.items() if name in known and value is not None}
        if "config" in arguments:
            recordings = [] if self.several else arguments.pop("data", [])
            arguments["config"] = load(
                arguments["config"], recordings, arguments.get("channel"), measuring=self.measuring
            )
            check_limits(arguments["config"], options.get("enforce_limits", False))
        for name, form in PAIRS.items():
            if isinstance(arguments.get(name), list):
                arguments[name] = pairs(arguments[name], *form)
        # what the module defines of these, and does not merely import
        own = {name: item for name, item in vars(module).items() if getattr(item, "__module__", "") == module.__name__}
        if "arguments_of" in own:
            arguments = module.arguments_of(arguments, options)
        reporting = progress(self.doing) if self.doing else nullcontext()
        if "progress_of" in own:
            reporting = module.progress_of(arguments)
        with reporting as report:
            if report is not None and "progress" in known:
                arguments["progress"] = report
            result = function(**arguments)
        if result is None:  # it has printed by itself
            return
        given |= arguments
        if options.get("json"):
            content = module.content_of(result, given) if "content_of" in own else result.summary
            print_json(plain(content), self.indent)
        else:
            module.show(result, given)
        if status := getattr(result, "status", options.get("enforce_limits") and result.exit_status):
            raise typer.Exit(status)


class Deferred(TyperCommand):
    """A command of which help knows the name and the text; its options are made where it is called."""

    def __init__(self, command: Command) -> None:
        super().__init__(command.typed, help=summary(command.module, command.name), rich_markup_mode=None)
        self.command = command

    def make_context(self, *given: Any, **named: Any) -> Any:
        """Return the context of the command with its options."""
        return self.command.made().make_context(*given, **named)


@cache
def _head(module: str, name: str) -> str:
    """Return the text of a function at the top of a module, which is not imported, to the end of its docstring."""
    spec = find_spec(module)
    assert spec is not None
    source: str = spec.loader.get_source(module)  # type: ignore[union-attr]
    start = source.index(f"\ndef {name}(") + 1
    opened = source.index('"""', start)
    return source[start : source.index('"""', opened + 3) + 3]


def summary(module: str, name: str) -> str:
    """Return the docstring of a function, down to its parameters."""
    head = _head(module, name)
    text = inspect.cleandoc(ast.literal_eval(head[head.index('"""') :]))
    return text.partition("\n\nParameters\n----------\n")[0].strip()


@cache
def declaration(module: str, name: str) -> tuple[dict[str, tuple[str, Any]], dict[str, str]]:
    """Read a function at the top of a module, which is not imported: its parameters, and the texts on them.

    Of each parameter the annotation and the default.
    """
    node = ast.parse(_head(module, name)).body[0]
    assert isinstance(node, ast.FunctionDef)
    arguments = node.args
    needed = [None] * (len(arguments.args) - len(arguments.defaults))
    defaults = [*needed, *arguments.defaults, *arguments.kw_defaults]
    parameters = {
        argument.arg: (
            ast.unparse(argument.annotation).partition(" | ")[0] if argument.annotation else "",
            NEEDED if default is None else ast.literal_eval(default),
        )
        for argument, default in zip([*arguments.args, *arguments.kwonlyargs], defaults, strict=True)
    }
    _, _, rest = (ast.get_docstring(node) or "").partition("\n\nParameters\n----------\n")
    section = re.split(r"\n\n\w+\n-+\n", rest)[0]
    texts = {
        name: line.strip()
        for names, line in re.findall(r"^(\w[\w, ]*) :.*\n {4}(.*)", section, re.MULTILINE)
        for name in names.split(", ")
    }
    return parameters, texts
