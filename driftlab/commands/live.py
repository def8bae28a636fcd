"""`driftlab live`."""

from __future__ import annotations

import gc
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from driftlab.commands import live_map
from driftlab.commands.common import Channel, ConfigFile, Force, Json, Resume, note_compiling, terminal, title
from driftlab.commands.live_web import Web, served
from driftlab.commands.session import load, print_json, say, session

if TYPE_CHECKING:
    from driftlab.jobs.live import Live
    from driftlab.live.history import LiveHistory
    from driftlab.live.status import Status

JSON_PERIOD, SCREEN_PERIOD = 1.0, 0.25  # s


RecordFile = Annotated[Path | None, typer.Option("--record", metavar="FILE.h5", help="Keep the raw samples.")]
Duration = Annotated[str | None, typer.Option("--duration", metavar="TIME", help="End after, e.g. '10 min'.")]


def live(
    config: ConfigFile,
    record: RecordFile = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("driftlab_out"),
    duration: Duration = None,
    channel: Channel = None,
    resume: Resume = False,
    force: Force = False,
    fit_map: live_map.MapFile = None,
    kind: live_map.Kind = None,
    sigma: live_map.Sigma = None,
    range: live_map.Span = None,
    until_reached: live_map.UntilReached = False,
    json: Json = False,
    web: Web = None,
) -> None:
    """Filter a device while it measures.

    Ctrl-C ends it with the same files as `run`.
    """
    from driftlab.commands.run import show
    from driftlab.jobs.live import Live

    loaded = load(config, channel=channel)
    seconds = None if duration is None else _seconds(duration)
    own = [config, *([] if record is None else [record])]
    growing = live_map.soaking_of(loaded, fit_map, kind, sigma, range, until_reached, own)
    note_compiling()
    run = Live(loaded, record=record, duration=seconds, resume=resume, force=force, soaking=growing)
    _keep_what_was_made()
    name = f"{config.stem}: {title(loaded)}"
    with _ended_by_signals(run), served(run, web, loaded, config.stem, out) as watch, _reporting(run, json, watch):
        result = run.to_folder(out, title=name, read=[config])
        with nullcontext() if growing is None else run.doing("fitting the map"):
            known, problem = live_map.written(growing)
        if watch is not None:
            watch.end([*known, *result.lines()], str(out), failed=problem is not None)
    if json:
        _write({"summary": result.summary, **({} if growing is None else {"map": growing.status.as_json()})})
    else:
        show(result, config.stem, title(loaded), out)
        say("".join(f"{line}\n" for line in known if problem is None))
    if problem is not None:
        raise problem


def _keep_what_was_made() -> None:
    """Let the start-up's objects be: looking through them again and again takes tens of milliseconds."""
    gc.collect()
    gc.freeze()


def _seconds(duration: str) -> float:
    """Return how long to measure, s; raises ConfigError where it is no time to measure."""
    from fusion_core.errors import ConfigError
    from fusion_core.units import LIMITS, to_si

    seconds = to_si(duration, "s")
    if not 0 < seconds <= LIMITS["s"][1]:
        raise ConfigError(f"--duration '{duration}': is not a time to measure; write one like '10 min'")
    return seconds


@contextmanager
def _ended_by_signals(run: Live) -> Iterator[None]:
    """Let SIGINT, SIGTERM and a terminal that is closed end the run cleanly; a second signal ends it at once."""
    import signal

    def end(number: int, frame: object) -> None:
        if run.stop.is_set() and run.status.phase == "fitting the map":
            raise KeyboardInterrupt("the results are written, the map is not; fit-map makes it of the recording")
        if run.stop.is_set():
            raise KeyboardInterrupt
        run.stop.set()

    if _ignored(signal.SIGINT) and not session().quiet:
        sys.stderr.write(
            f"Ctrl-C (SIGINT) is ignored here, as a shell's background job; end it with: kill {os.getpid()}\n"
        )
    numbers = [number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if not _ignored(number)]
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _ignored(number: int) -> bool:
    """Whether a signal is ignored, as nohup asks for."""
    import signal

    return signal.getsignal(number) is signal.SIG_IGN


@contextmanager
def _reporting(run: Live, json: bool, watch: LiveHistory | None) -> Iterator[None]:
    def both(period: float, report: Callable[[Status], None]) -> Callable[[Status], None]:
        seldom = _every(period, run, report)

        def said(status: Status) -> None:
            if watch is not None:
                watch.report(status)
            seldom(status)

        return said

    if json:
        run.report = both(JSON_PERIOD, _line)
        yield
        return
    from rich.live import Live as Screen

    from driftlab.live.screen import screen

    console = terminal()
    try:
        with Screen(console=console, auto_refresh=False) as shown:
            run.report = both(SCREEN_PERIOD, lambda status: shown.update(screen(status), refresh=True))
            yield
    finally:
        if not console.is_terminal:  # a file gets the last screen, without the end of its line
            console.line()


def _every(period: float, run: Live, report: Callable[[Status], None]) -> Callable[[Status], None]:
    """Return a report that is made seldom. When no one reads it any more, the run ends: nothing measured is lost."""
    last = -period

    def seldom(status: Status) -> None:
        nonlocal last
        if time.monotonic() - last >= period:
            last = time.monotonic()
            try:
                report(status)
            except OSError:
                last = math.inf
                run.stop.set()

    return seldom


def _line(status: Status) -> None:
    _write(status.as_json())


def _write(content: dict[str, Any]) -> None:
    """Write a line of JSON."""
    from driftlab.storage.json import plain

    print_json(plain(content), None)
    sys.stdout.flush()
