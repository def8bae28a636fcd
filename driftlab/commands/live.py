"""A device through a config while it measures: `driftlab live`, the filter of a run, and its state on the way."""

from __future__ import annotations

import gc
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from driftlab.commands.console import print_json, say, session, terminal
from driftlab.commands.estimates import PERIOD, EstimatesWriter
from driftlab.commands.inputs import ConfigLike, Place, config_of
from driftlab.commands.run import RunResult, finish, show
from driftlab.config import Config
from driftlab.filtering.run import Run, warm_up
from driftlab.filtering.segment import RunLog, RunSegment
from driftlab.live.growing_map import GrowingMap, GrowingMapStatus, soaking
from driftlab.live.history import LiveHistory, column_names
from driftlab.live.screen import screen
from driftlab.live.server import Server, serving
from driftlab.live.status import Phase, Status
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import ROWS, read
from driftlab.reports.live import live_page
from driftlab.storage.folders import output_folder
from driftlab.storage.json import plain
from driftlab.storage.recorder import Recorder, recorded_source
from fusion_core.chunk import Chunk
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.faults import Faults
from fusion_core.units import LIMITS, to_si

TICK = 1.0  # s: how often the status is reported at least
JSON_PERIOD, SCREEN_PERIOD = 1.0, 0.25  # s


class Live:
    """A live run.

    Parameters
    ----------
    config : Config
        With a live source.
    record : Path or None
        Where the raw samples go.
    duration : float or None
        After which it ends, in s of the host.
    resume : bool
        Whether to go on with the recording, and where there is one with the checkpoint.
    force : bool
        Whether to replace a recording, and results that a device gave.
    soaking : GrowingMap or None
        A map that is fitted meanwhile, written at the end.

    Attributes
    ----------
    report : callable
        Called with the status at every chunk, and every second in which none comes: then by another thread.
    seen : callable
        Called with each segment of estimates.
    """

    def __init__(
        self,
        config: Config,
        *,
        record: Path | None = None,
        duration: float | None = None,
        resume: bool = False,
        force: bool = False,
        soaking: GrowingMap | None = None,
    ) -> None:
        if config.source is None or not config.source.live:
            kind = "none" if config.source is None else config.source.kind
            raise ConfigError(f"source: a live one is needed and this is {kind}; use kind: serial, or `driftlab run`")
        if resume and record is None:
            raise ConfigError("--resume: a live run can only go on with its recording; add --record FILE")
        self.config, self.source, self.record = config, config.source, record
        self.duration, self.resume, self.force = duration, resume, force
        self.report: Callable[[Status], None] = lambda status: None
        self.seen: Callable[[RunSegment], None] = lambda segment: None
        self._reporting, self._reported = threading.Lock(), 0.0
        self.stop = threading.Event()  # set it to end the run cleanly
        self.status = Status(sensor=None if config.filter is None else config.filter.tracked)
        self.recorder: Recorder | None = None
        self.soaking = soaking
        if soaking is not None:
            self._known(soaking.status)
            soaking.publish = self._known

    def to_folder(self, out: Path) -> RunResult:
        """Run until stopped, and write the same files as `driftlab.commands.run.run` into the folder `out`.

        Raises
        ------
        EmptyRecording
            If not one sample came.
        """
        record = [self.record] if self.record is not None else []
        held = output_folder(
            out,
            read=[*record, *self.config.files()],
            resume=self.resume,
            force=self.force,
            recording=self.record,
            durable=True,
        )
        with held as folder, self._ticking(), ExitStack() as open:
            if self.record is not None:
                self.recorder = Recorder(self.record, self.config.as_yaml(), resume=self.resume, force=self.force)
                open.callback(self.recorder.close)
                if self.recorder.kept is not None:
                    self.status.faults.add("recordings that could not be read, kept", 1, f"as {self.recorder.kept}")
            warm_up(self.config)
            return self._run(folder, open, out)

    def _run(self, folder: Path, open: ExitStack, out: Path) -> RunResult:
        journal, faults = RunLog(), self.status.faults
        estimates = EstimatesWriter(
            folder, self.config, journal, recording=self.record, live=True, more=self._before_checkpoint
        )
        open.callback(estimates.close)
        before = estimates.load_checkpoint() if self.resume else None
        if before:
            faults.found.update(before["source_faults"])
        run = Run(self.config, journal, resume=before["run"] if before else None, settled=estimates.write_checkpoint)
        self.status.sensor, self.status.axes, self.status.m = run.model.tracked, run.model.tracked.axes, run.model.m
        self.status.align, self.status.noted = run.model.align, journal.faults
        estimates.open(run.model)
        begun = time.monotonic()
        samples = read(self.config, journal.faults, stream=self._samples())
        try:
            stream = epochs(samples, run.model.update_interval)
            for segment in run.over(stream if self.soaking is None else self.soaking.through(stream)):
                self.status.updated(segment)
                self.seen(segment)
                estimates.append(segment)
        except EmptyRecording:
            if self.status.samples:
                raise
            cause = self.status.cause.partition(";")[0]
            raise EmptyRecording(
                f"{self.source.name}: not one sample came in {time.monotonic() - begun:.1f} s ({cause}); check "
                "that the device is on, and source.baudrate and source.framing"
            ) from None
        open.close()
        self.status.phase = "writing the results"
        self._report()
        for what, fault in faults.found.items():
            journal.faults.add(what, fault.count, fault.first)
        self.status.faults, self.status.noted = journal.faults, Faults()  # each is reported once
        return finish(estimates, run, out, self.record)

    @contextmanager
    def _ticking(self) -> Iterator[None]:
        """Report at once, then every second, also while the filter is compiled or a source keeps the run waiting."""
        done = threading.Event()

        def tick() -> None:
            while not done.wait(TICK / 4):
                if time.monotonic() - self._reported >= TICK:
                    self._report()

        self._report()
        thread = threading.Thread(target=tick, name="status", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    @contextmanager
    def doing(self, phase: Phase) -> Iterator[None]:
        """Report a phase after the run, until it is done."""
        self.status.phase = phase
        with self._ticking():
            yield

    def _known(self, status: GrowingMapStatus) -> None:
        """Take the status of the map."""
        self.status.map = status
        if status.reached and self.soaking is not None and self.soaking.until_reached:
            self.stop.set()

    def _report(self) -> None:
        with self._reporting:
            self._reported = time.monotonic()
            self.report(self.status)

    def _before_checkpoint(self) -> dict[str, Any]:
        """Make the samples safe that a checkpoint stands on, and return what else it holds."""
        if self.recorder is not None:
            self.recorder.flush()
        return {"source_faults": dict(self.status.faults.found)}

    def _samples(self) -> Iterator[Chunk]:
        """Yield the samples recorded before, then new ones; record these, and end when asked to."""
        if self.recorder is not None and self.recorder.rows:
            yield from recorded_source(self.recorder.path).chunks(ROWS, Faults())
        begun = flushed = time.monotonic()
        self.status.listen()
        for arrived in self.source.chunks(ROWS, self.status.faults):
            chunk = arrived if self.recorder is None else self.recorder.add(arrived)
            self.status.came(chunk)
            yield chunk
            now = time.monotonic()
            if self.recorder is not None and now - flushed >= PERIOD / 2:
                self.recorder.flush()
                self.status.recorded, flushed = self.recorder.rows, now
            self._report()
            if self.stop.is_set() or (self.duration is not None and now - begun >= self.duration):
                return


def live(
    config: ConfigLike,
    *,
    record: Place | None = None,
    out: Place = "driftlab_out",
    duration: str | None = None,
    channel: str | None = None,
    resume: bool = False,
    force: bool = False,
    fit_map: Place | None = None,
    kind: str | None = None,
    sigma: str | None = None,
    range: str | None = None,
    until_reached: bool = False,
    json: bool = False,
    web: int | None = None,
) -> None:
    """Filter a device while it measures.

    Ctrl-C ends it with the same files as `run`.

    Parameters
    ----------
    config : as that of `run`
        With a live source.
    record : path, optional
        Keep the raw samples.
    out : path
        Folder for the results.
    duration : str, optional
        End after, e.g. '10 min'.
    channel, resume, force : as those of `run`
    fit_map : path, optional
        Fit a thermal map meanwhile, into this file.
    kind : str, optional
        Kind of that map, instead of the config's.
    sigma : str, optional
        Say when the map is so sure, e.g. '3 deg/h'.
    range : str, optional
        Where it is to be, e.g. '-20..50 degC'.
    until_reached : bool
        End when --sigma is reached over --range.
    json : bool
        Print JSON for programs instead of text.
    web : int, optional
        Show it in a browser on this machine (port 8088; 0: any free).

    Raises
    ------
    ConfigError
        If the source is not live, or an option is wrong.
    EmptyRecording
        If not one sample came.
    """
    understood = config_of(config).tracking(channel)
    seconds = None if duration is None else _seconds(duration)
    folder, samples = Path(out), None if record is None else Path(record)
    wishes = {"kind": kind, "sigma": sigma, "span": range}
    growing = _growing_map(understood, fit_map, wishes, until_reached, [] if samples is None else [samples])
    run = Live(understood, record=samples, duration=seconds, resume=resume, force=force, soaking=growing)
    # the start-up's objects stay: looking through them again and again takes tens of milliseconds
    gc.collect()
    gc.freeze()
    with _ended_by_signals(run), served(run, web, folder) as watch, _reporting(run, json, watch):
        result = run.to_folder(folder)
        with nullcontext() if growing is None else run.doing("fitting the map"):
            known, problem = _written_map(growing)
        if watch is not None:
            watch.end([*known, *result.lines()], str(out), failed=problem is not None)
    if json:
        _write({"summary": result.summary, **({} if growing is None else {"map": growing.status.as_json()})})
    else:
        show(result, {"out": out})
        say("".join(f"{line}\n" for line in known if problem is None))
    if problem is not None:
        raise problem


def _growing_map(
    config: Config, path: Place | None, wishes: Mapping[str, str | None], until_reached: bool, read: Collection[Path]
) -> GrowingMap | None:
    """Return the map that is fitted meanwhile, if one is; raises ConfigError, also where there are wishes alone."""
    if path is not None:
        return soaking(config, Path(path), **wishes, until_reached=until_reached, read=read)
    for name, value in {**wishes, "until-reached": until_reached or None}.items():
        if value is not None:
            option = "range" if name == "span" else name
            raise ConfigError(f"--{option}: is of a map that is fitted meanwhile; add --fit-map MAP")
    return None


def _written_map(growing: GrowingMap | None) -> tuple[list[str], Exception | None]:
    """Write the map, where there is one; return the notes on it, and why it was not written, if so."""
    if growing is None:
        return [], None
    try:
        growing.finish()
    except Exception as problem:  # raised when the results of the run have been shown
        return [str(problem)], problem
    known = [*growing.status.lines(), *growing.faults.lines()]
    return [*(f"map {growing.status.kind}: {line}" for line in known), f"map written to {growing.path}"], None


@contextmanager
def served(run: Live, port: int | None, out: Path) -> Iterator[LiveHistory | None]:
    """Serve the page of a run, if it is asked for; at the end it says how the run ended.

    Raises
    ------
    ConfigError
        If the port cannot be had.
    """
    config = run.config
    if port is None or config.filter is None:
        yield None
        return
    sensor, title = config.filter.tracked, config.file.stem if config.file else config.name
    watch = LiveHistory(sensor.axes, str(run.record or ""))
    run.seen = watch.seen
    names = column_names(sensor.axes)
    html = live_page(title, sensor, names, device=config.recording, results=str(out), serial=config.serial)
    with serving(Server(port, html, watch)) as server:
        terminal(stderr=True).print(f"page: {server.url}")
        try:
            yield watch
        except BaseException as error:
            watch.end([str(error) or type(error).__name__], str(out), failed=True)
            raise


def _seconds(duration: str) -> float:
    """Return the duration in s; raises ConfigError where it is no time to measure."""
    seconds = to_si(duration, "s")
    if not 0 < seconds <= LIMITS["s"][1]:
        raise ConfigError(f"--duration '{duration}': is not a time to measure; write one like '10 min'")
    return seconds


@contextmanager
def _ended_by_signals(run: Live) -> Iterator[None]:
    """Let SIGINT, SIGTERM and a terminal that is closed end the run cleanly; a second signal ends it at once."""

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
    known = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]  # Windows has none
    numbers = [number for number in known if not _ignored(number)]
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _ignored(number: int) -> bool:
    """Tell whether a signal is ignored, as nohup asks for."""
    return signal.getsignal(number) is signal.SIG_IGN


@contextmanager
def _reporting(run: Live, json: bool, watch: LiveHistory | None) -> Iterator[None]:
    if json:
        run.report = _every(JSON_PERIOD, run, watch, lambda status: _write(status.as_json()))
        yield
        return
    from rich.live import Live as Screen

    console = terminal()
    try:
        with Screen(console=console, auto_refresh=False) as live_screen:
            run.report = _every(SCREEN_PERIOD, run, watch, lambda now: live_screen.update(screen(now), refresh=True))
            yield
    finally:
        if not console.is_terminal:  # a file gets the last screen, without the end of its line
            console.line()


def _every(
    period: float, run: Live, watch: LiveHistory | None, report: Callable[[Status], None]
) -> Callable[[Status], None]:
    """Return a report that is made seldom, and to `watch` each time.

    When no one reads it any more, the run ends: nothing measured is lost.
    """
    last = -period

    def seldom(status: Status) -> None:
        nonlocal last
        if watch is not None:
            watch.report(status)
        if time.monotonic() - last >= period:
            last = time.monotonic()
            try:
                report(status)
            except OSError:
                last = math.inf
                run.stop.set()

    return seldom


def _write(content: dict[str, Any]) -> None:
    """Write a line of JSON."""
    print_json(plain(content), None)
    sys.stdout.flush()
