"""What the commands share: their arguments, and progress for people."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Annotated, Any

import typer

from driftlab.commands.session import session
from fusion_core.escaping import lines

if TYPE_CHECKING:
    from rich.console import Console

    from driftlab.config import Config

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="The config, a YAML file.")]
Recording = Annotated[list[str] | None, typer.Option("--input", metavar="PATH[::START:STOP]", help="The recording.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs instead of text.")]
Channel = Annotated[
    str | None,
    typer.Option(
        "--channel", metavar="CHANNEL", help="Sensor whose bias it is about, e.g. accel; default: the config's."
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace results that cannot be computed again.")]
EnforceLimits = Annotated[
    bool,
    typer.Option("--enforce-limits", help="Exit with 1 where a limit fails, with 3 where one is undecided or missing."),
]
COLOURS = {"pass": "green", "fail": "bold red", "undecided": "bold magenta", "unknown": "bold yellow"}
COMPILED = 1.0  # s of compiling, after which it is said
Resume = Annotated[bool, typer.Option("--resume", help="Go on where the same run was broken off.")]


def title(config: Config) -> str:
    """Return what the config's recording is called."""
    return config.source.name if config.source is not None else ""


def terminal(*, stderr: bool = False, width: int | None = None) -> Console:
    """Return the console for people: no text is markup (a path may look like it, `o[final]`), none acts on it."""
    from rich.console import Console
    from rich.segment import Segment

    class Plain(Console):
        def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
            for part in super().render(renderable, options):
                yield part if part.control else Segment(lines(part.text), part.style)

    return Plain(stderr=stderr, width=width, quiet=session().quiet, markup=False, emoji=False, highlight=False)


def pairs(option: str, given: list[str] | None, form: str, example: str) -> dict[str, str]:
    """Return what an option that may be repeated gives, as KEY=VALUE, by key; raises ConfigError."""
    from fusion_core.errors import ConfigError

    found = {}
    for text in given or []:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"{option} {text}: is not {form}; write e.g. {option} {example}")
        found[key.strip()] = value.strip()
    return found


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


def leave_by_limits(line: str, enforced: bool) -> None:
    """End the command with the exit status of the verdict on the limits, where they are enforced."""
    from driftlab.evaluation.limits import EXIT, outcome

    if enforced and (status := EXIT[outcome(line)]):
        raise typer.Exit(status)


def note_compiling() -> None:
    """Have it said once, on standard error, that loops are compiled: for an installation, or another processor."""
    from numba.core import event

    console = terminal(stderr=True)

    class Notice(event.Listener):  # type: ignore[misc]
        took, said = 0.0, False

        def on_start(self, event: Any) -> None:
            if self.took > COMPILED and not self.said:
                self.said = True
                console.print(
                    "compiling the filter for this processor, up to some minutes; it is kept for the next time",
                    soft_wrap=True,
                )
            self.since = time.monotonic()

        def on_end(self, event: Any) -> None:
            self.took += time.monotonic() - self.since

    event.register("numba:compile", Notice())


@contextmanager
def progress(what: str) -> Iterator[Callable[..., None]]:
    """Show progress on standard error from the first second on, where a person is looking.

    What is given is called with the seconds from the first row and the number of samples so far, or with a text.
    """
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = terminal(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    bar = Progress(*columns, console=console, transient=True)
    task = bar.add_task(what, total=None)
    stage, since = what, time.monotonic()
    # by a clock of its own: what takes long need not say so
    shown = Timer(1.0, bar.start if console.is_terminal else bool)
    shown.daemon = True
    shown.start()

    def done() -> None:
        session().stages.append((stage, time.monotonic() - since))

    def report(state: float | str, count: int = 0) -> None:
        nonlocal stage, since
        if isinstance(state, str):
            done()
            stage, since = f"{what}: {state}", time.monotonic()
        text = state if isinstance(state, str) else f"{state:,.0f} s, {count:,} samples"
        bar.update(task, description=f"{what}: {text}")

    try:
        yield report
    finally:
        done()
        shown.cancel()
        shown.join()
        if bar.live.is_started:
            bar.stop()
