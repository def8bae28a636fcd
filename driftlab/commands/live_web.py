"""A live run in a browser: `driftlab live --web [PORT]`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from driftlab.commands.common import terminal, title

if TYPE_CHECKING:
    from driftlab.config import Config
    from driftlab.jobs.live import Live
    from driftlab.live.history import LiveHistory

PORT = 8088  # of the page, where none is named
Web = Annotated[
    int | None,
    typer.Option("--web", metavar="[PORT]", help=f"Show it in a browser on this machine (port {PORT}; 0: any free)."),
]


class LiveCommand(TyperCommand):
    """A command whose `--web` may stand alone, or with a port behind it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Name the port where none is named."""
        named = [
            f"--web={PORT}" if arg == "--web" and not following.isdecimal() else arg
            for arg, following in zip(args, [*args[1:], ""], strict=True)
        ]
        return super().parse_args(ctx, named)


@contextmanager
def served(run: Live, port: int | None, config: Config, name: str, out: Path) -> Iterator[LiveHistory | None]:
    """Serve the page of a run, if it is asked for; at the end it says how the run ended.

    Raises
    ------
    ConfigError
        If the port cannot be had.
    """
    if port is None or config.filter is None:
        yield None
        return
    from driftlab.live.history import LiveHistory, column_names
    from driftlab.live.server import Server, serving
    from driftlab.reports.live import live_page

    sensor = config.filter.tracked
    watch = LiveHistory(sensor.axes, str(run.record or ""))
    run.seen = watch.seen
    names = column_names(sensor.axes)
    html = live_page(name, sensor, names, device=title(config), results=str(out), serial=config.serial)
    with serving(Server(port, html, watch)) as server:
        terminal(stderr=True).print(f"page: {server.url}")
        try:
            yield watch
        except BaseException as error:
            watch.end([str(error) or type(error).__name__], str(out), failed=True)
            raise
