"""What every command takes: how much it says, and keys that are set beside its config.

`-q`: nothing but errors and what a program asked for. `-v`: on standard error, how long each stage took and which
plugins took part.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from fusion_core.escaping import json_text, line, lines

if TYPE_CHECKING:
    from driftlab.config import Config

Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Say nothing but errors, and what --json asks for.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Say how long each stage took, and which plugins ran.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set a key of the config, e.g. 'filter.align=30 s'; repeatable."),
]


@dataclass
class Session:
    """One command in progress.

    Attributes
    ----------
    quiet, verbose : bool
    settings : list of str
        Keys to set beside each config, as `KEY=VALUE`.
    configs : list of Config
        Those that were loaded.
    stages : list of (str, float)
        What was done, and for how long, s.
    """

    quiet: bool = False
    verbose: bool = False
    settings: list[str] = field(default_factory=list)
    configs: list[Config] = field(default_factory=list)
    stages: list[tuple[str, float]] = field(default_factory=list)
    begun: float = field(default_factory=time.monotonic)

    def lines(self) -> list[str]:
        """Return what `-v` says."""
        took = [*self.stages, ("in all", time.monotonic() - self.begun)]
        width = max(len(what) for what, _ in took)
        lines = [f"{what:<{width}}  {seconds:8.2f} s" for what, seconds in took]
        return lines + [f"plugin: {plugin}" for plugin in self._plugins()]

    def _plugins(self) -> list[str]:
        """Return family, kind and distribution of every plugin that the configs name."""
        from fusion_core.host.provenance import participants

        found = [item for config in self.configs for item in participants(config)]
        lines = (f"{p['family']} {p['kind']} ({p['distribution']} {p['version']})" for p in found)
        return list(dict.fromkeys(lines))


_session: ContextVar[Session] = ContextVar("session")


def session() -> Session:
    """Return the command in progress; a fresh one where none is, as in a test of a part."""
    return _session.get(None) or Session()


def say(text: str) -> None:
    """Print text for people, a line or several; a name in it that is a stranger's acts on no terminal."""
    if not session().quiet:
        sys.stdout.write(lines(text))


def print_json(content: Any, indent: int | None = 2) -> None:
    """Print JSON for programs."""
    sys.stdout.write(json_text(content, indent) + "\n")


def load(path: Path, recordings: list[str] | None = None, channel: str | None = None) -> Config:
    """Read a config, with recording, keys and tracked sensor of the command line in place of its own.

    Raises
    ------
    ConfigError
        If the config is wrong, has no sensor of that channel, or more than one recording is given.
    """
    from driftlab.config import load_config
    from fusion_core.errors import ConfigError

    if recordings and len(recordings) > 1:
        raise ConfigError(f"--input: is given {len(recordings)} times, one recording was expected; run one at a time")
    now, begun = session(), time.monotonic()
    config = load_config(path, recordings[0] if recordings else None, now.settings).tracking(channel)
    now.configs.append(config)
    now.stages.append((f"reading {path.name}", time.monotonic() - begun))
    return config


def with_session(command: Callable[..., None], *, config: bool = True) -> Callable[..., None]:
    """Return a command that also takes `-q` and `-v`, and `--set` where it has a config."""
    own: dict[str, tuple[Any, Any]] = {"quiet": (Quiet, False), "verbose": (Verbose, False)}
    if config:
        own = {"set_": (Settings, None), **own}

    @wraps(command)
    def run(**given: Any) -> None:
        now = Session(given.pop("quiet"), given.pop("verbose"), given.pop("set_", None) or [])
        token = _session.set(now)
        try:
            command(**given)
        finally:
            if now.verbose:
                sys.stderr.write("".join(f"{line(text)}\n" for text in now.lines()))
            _session.reset(token)

    hints = get_type_hints(command, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    taken = [p.replace(annotation=hints[p.name], kind=keyword) for p in inspect.signature(command).parameters.values()]
    added = [inspect.Parameter(name, keyword, default=value, annotation=kind) for name, (kind, value) in own.items()]
    run.__signature__ = inspect.Signature([*taken, *added])  # type: ignore[attr-defined]
    run.__annotations__ = hints | {name: kind for name, (kind, _) in own.items()}
    del run.__wrapped__  # its annotations are those of the command alone
    return run
