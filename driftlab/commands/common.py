"""What the commands share: their arguments, and progress for people."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from driftlab.config import Config

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="The config, a YAML file.")]
Recording = Annotated[str | None, typer.Option("--input", metavar="PATH[::START:STOP]", help="The recording.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs instead of text.")]


def title(config: Config) -> str:
    """Return what the config's recording is called."""
    return config.source.name if config.source is not None else ""


@contextmanager
def progress(what: str) -> Iterator[Callable[[float, int], None]]:
    """Show progress on standard error from the first second on, where a person is looking."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    bar = Progress(
        SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=console, transient=True
    )
    task = bar.add_task(what, total=None)
    begun = time.monotonic()

    def report(t: float, count: int) -> None:
        if console.is_terminal and time.monotonic() - begun > 1.0:
            bar.start()
        bar.update(task, description=f"{what}: t = {t:,.0f} s, {count:,} samples")

    try:
        yield report
    finally:
        if bar.live.is_started:
            bar.stop()
