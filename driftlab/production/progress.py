"""Progress of a fleet: a bar where a person is looking, a line now and then where a log is written."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from driftlab.commands.console import session, terminal
from driftlab.production.summary import FleetProgress, Stage
from fusion_core.escaping import line

EVERY = 30.0  # s between lines of a log


@contextmanager
def fleet_progress() -> Iterator[FleetProgress]:
    """Show the stages of a fleet on standard error, with units done and failed, and an estimate of the end."""
    console = terminal(stderr=True)
    reporter = _Bar() if console.is_terminal and not session().quiet else _Log(quiet=session().quiet)
    try:
        yield reporter
    finally:
        reporter.close()


class _Log:
    """A line each EVERY s."""

    def __init__(self, *, quiet: bool) -> None:
        self.quiet, self.stage = quiet, Stage("")
        self.written = time.monotonic()

    def __call__(self, stage: Stage) -> None:
        if stage is not self.stage:
            self._note()
            self.stage = stage
        if not self.quiet and time.monotonic() - self.written >= EVERY:
            self.written = time.monotonic()
            sys.stderr.write(f"{line(stage.text())}\n")
            sys.stderr.flush()

    def _note(self) -> None:
        """Note how long the stage took, for -v."""
        if self.stage.name:
            session().stages.append((self.stage.name, time.monotonic() - self.stage.begun))

    def close(self) -> None:
        """End it."""
        self._note()


class _Bar(_Log):
    """One line that is written anew, with a bar."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bars

        super().__init__(quiet=True)
        columns = (BarColumn(bar_width=24), TextColumn("{task.description}", markup=False))
        self.bars = Bars(*columns, console=terminal(stderr=True), transient=True)
        self.bar = self.bars.add_task("", total=None)
        self.bars.start()

    def __call__(self, stage: Stage) -> None:
        super().__call__(stage)
        self.bars.update(self.bar, description=stage.text(), completed=stage.done, total=stage.total or None)

    def close(self) -> None:
        """Take the bar away."""
        super().close()
        self.bars.stop()
