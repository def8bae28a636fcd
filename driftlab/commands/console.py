"""The console of a command: what every command takes, what it prints, and progress for people.

`-q`: nothing but errors and what a program asked for. `-v`: on standard error, how long each stage took and which
plugins took part.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from dataclasses import dataclass, field
from importlib.util import LazyLoader, find_spec, module_from_spec
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Any

from fusion_core.escaping import json_text, line, lines

if TYPE_CHECKING:
    from rich.console import Console

    from driftlab.config import Config

COLOURS = {"pass": "green", "fail": "bold red", "undecided": "bold magenta", "unknown": "bold yellow"}


@dataclass
class Session:
    """One command in progress.

    Attributes
    ----------
    quiet : bool
    settings : list of str
        Keys to set beside each config, as `KEY=VALUE`.
    configs : list of Config
        Those that were loaded.
    stages : list of (str, float)
        What was done, and for how long, s.
    """

    quiet: bool = False
    settings: list[str] = field(default_factory=list)
    configs: list[Config] = field(default_factory=list)
    stages: list[tuple[str, float]] = field(default_factory=list)
    begun: float = field(default_factory=time.monotonic)

    def lines(self) -> list[str]:
        """Return the report of `-v`: how long each stage took, and the plugins that the configs name."""
        from fusion_core.host.provenance import participants

        took = [*self.stages, ("in all", time.monotonic() - self.begun)]
        width = max(len(what) for what, _ in took)
        lines = [f"{what:<{width}}  {seconds:8.2f} s" for what, seconds in took]
        named = [item for config in self.configs for item in participants(config)]
        plugins = (f"plugin: {p['family']} {p['kind']} ({p['distribution']} {p['version']})" for p in named)
        return lines + list(dict.fromkeys(plugins))


CURRENT: ContextVar[Session] = ContextVar("session")


def session() -> Session:
    """Return the command in progress; a fresh one where none is, as in a test of a part."""
    return CURRENT.get(None) or Session()


@contextmanager
def in_session(quiet: bool, verbose: bool, settings: list[str] | None) -> Iterator[None]:
    """Let a command be the one in progress; at its end say how long the stages took, where that is asked."""
    now = Session(quiet, settings or [])
    token = CURRENT.set(now)
    try:
        yield
    finally:
        if verbose:
            sys.stderr.write("".join(f"{line(text)}\n" for text in now.lines()))
        CURRENT.reset(token)


def say(text: str) -> None:
    """Print text for people, a line or several; a name in it that is a stranger's acts on no terminal."""
    if not session().quiet:
        sys.stdout.write(lines(text))


def say_lines(texts: Iterable[str], before: str = "") -> None:
    """Print texts for people, each in a line of its own with `before` at its head."""
    for text in texts:
        say(f"{before}{text}\n")


def print_json(content: Any, indent: int | None = 2) -> None:
    """Print JSON for programs; a text is JSON already."""
    sys.stdout.write((content if isinstance(content, str) else json_text(content, indent)) + "\n")


def load(
    path: Path, recordings: list[str] | None = None, channel: str | None = None, *, measuring: bool = False
) -> Config:
    """Read a config, with recording, keys and tracked sensor of the command line in place of its own.

    Where noise is what is measured (`measuring`), it need not be declared.

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
    config = load_config(path, recordings[0] if recordings else None, now.settings, measuring=measuring)
    config = config.tracking(channel)
    now.configs.append(config)
    now.stages.append((f"reading {path.name}", time.monotonic() - begun))
    return config


def terminal(*, stderr: bool = False, width: int | None = None) -> Console:
    """Return the console for people: no text is markup (a path may look like it, `o[final]`), none acts on it."""
    from rich.console import Console
    from rich.segment import Segment

    class Plain(Console):
        def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
            for part in super().render(renderable, options):
                yield part if part.control else Segment(lines(part.text), part.style)

    return Plain(stderr=stderr, width=width, quiet=session().quiet, markup=False, emoji=False, highlight=False)


def pairs(given: list[str], option: str, form: str, example: str) -> dict[str, str]:
    """Return the values of an option that may be repeated, as KEY=VALUE, by key; raises ConfigError."""
    from fusion_core.errors import ConfigError

    values = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"{option} {text}: is not {form}; write e.g. {option} {example}")
        values[key.strip()] = value.strip()
    return values


def print_verdict(line: str, before: str = "") -> None:
    """Print whether the limits are kept, in the colour of the outcome; nothing where there are none."""
    from rich.text import Text

    from driftlab.evaluation.limits import outcome

    if line:
        text = Text.assemble(before, (line, COLOURS[outcome(line)]))
        terminal().print(text, soft_wrap=True)


def check_limits(config: Config, enforced: bool) -> None:
    """Raise ConfigError where limits are to be enforced and the config has none."""
    from fusion_core.errors import ConfigError

    if enforced and (config.limits is None or not config.limits.declared):
        raise ConfigError("--enforce-limits: the config has no limits, nothing would be enforced; set limits in it")


@contextmanager
def progress(what: str) -> Iterator[Callable[..., None]]:
    """Show progress on standard error from the first second on, where a person is looking.

    What is given is called with the seconds from the first row and the number of samples so far, or with a text.
    """
    text = stage = what
    begun, bar = time.monotonic(), None
    since = begun

    def begin() -> None:
        nonlocal bar
        if sys.stderr.isatty() and (console := terminal(stderr=True)).is_terminal:  # rich is not loaded for others
            from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

            columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
            bar = Progress(*columns, console=console, transient=True)
            bar.add_task(text, total=None)
            bar.tasks[0].start_time = begun
            bar.start()

    delayed = Timer(1.0, copy_context().run, [begin])  # by a clock of its own: what takes long need not say so
    delayed.daemon = True
    delayed.start()

    def done() -> None:
        session().stages.append((stage, time.monotonic() - since))

    def report(state: float | str, count: int = 0) -> None:
        nonlocal stage, since, text
        if isinstance(state, str):
            done()
            stage, since = f"{what}: {state}", time.monotonic()
        text = f"{what}: {state if isinstance(state, str) else f'{state:,.0f} s, {count:,} samples'}"
        if bar is not None and bar.task_ids:
            bar.update(bar.task_ids[0], description=text)

    try:
        yield report
    finally:
        done()
        delayed.cancel()
        delayed.join()
        if bar is not None:
            bar.stop()


def load_at_first_use(*names: str) -> None:
    """Let modules be loaded when something of them is asked for first."""
    for name in set(names) - sys.modules.keys():
        if (spec := find_spec(name)) is None:
            continue
        spec.loader = loader = LazyLoader(spec.loader)  # type: ignore[arg-type]
        sys.modules[name] = module = module_from_spec(spec)
        loader.exec_module(module)
        parent, _, child = name.rpartition(".")
        setattr(sys.modules[parent], child, module)
