"""A device through a config while it measures: the same filter as in a run, and what it says at the moment."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from driftlab.config import Config
from driftlab.filtering.run import Run, warm_up
from driftlab.filtering.segment import RunLog, RunSegment
from driftlab.jobs.estimating import PERIOD, EstimatesWriter
from driftlab.jobs.run import RunResult, finish
from driftlab.live.growing_map import GrowingMap, GrowingMapStatus
from driftlab.live.status import Phase, Status
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import ROWS, read
from driftlab.storage.folders import output_folder
from driftlab.storage.recorder import Recorder, recorded_source
from fusion_core.chunk import Chunk
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.faults import Faults
from fusion_core.host.provenance import participants

TICK = 1.0  # s: how often the status is reported at least


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
    report : callable
        Called with the status at every chunk, and every second in which none comes: then by another thread.
    seen : callable
        Called with each stretch of estimates.
    soaking : Soaking or None
        A map that is fitted meanwhile, written at the end.
    """

    def __init__(
        self,
        config: Config,
        *,
        record: Path | None = None,
        duration: float | None = None,
        resume: bool = False,
        force: bool = False,
        report: Callable[[Status], None] = lambda status: None,
        seen: Callable[[RunSegment], None] = lambda stretch: None,
        soaking: GrowingMap | None = None,
    ) -> None:
        if config.source is None or not config.source.live:
            kind = "none" if config.source is None else config.source.kind
            raise ConfigError(f"source: a live one is needed and this is {kind}; use kind: serial, or `driftlab run`")
        if resume and record is None:
            raise ConfigError("--resume: a live run can only go on with its recording; add --record FILE")
        self.config, self.source, self.record = config, config.source, record
        self.duration, self.resume, self.force, self.report, self.seen = duration, resume, force, report, seen
        self._reporting, self._reported = threading.Lock(), 0.0
        self.stop = threading.Event()  # set it to end the run cleanly
        self.status = Status(sensor=None if config.filter is None else config.filter.tracked)
        self.recorder: Recorder | None = None
        self.soaking = soaking
        if soaking is not None:
            self._known(soaking.status)
            soaking.publish = self._known

    def to_folder(self, out: Path, *, title: str, read: Collection[Path] = ()) -> RunResult:
        """Run until stopped, and write the same files as `driftlab.jobs.run.run` into the folder `out`.

        Raises
        ------
        EmptyRecording
            If not one sample came.
        """
        record = [self.record] if self.record is not None else []
        held = output_folder(
            out,
            read=[*read, *record, *self.config.files()],
            resume=self.resume,
            force=self.force,
            recording=self.record,
            durable=True,
        )
        with held as folder, self._ticking(), ExitStack() as open:
            if self.record is not None:
                text = self.config.as_yaml()
                self.recorder = Recorder(self.record, text, resume=self.resume, force=self.force)
                open.callback(self.recorder.close)
                if self.recorder.kept is not None:
                    self.status.faults.add("recordings that could not be read, kept", 1, f"as {self.recorder.kept}")
            warm_up(self.config)
            return self._run(folder, open, title, out)

    def _run(self, folder: Path, open: ExitStack, title: str, out: Path) -> RunResult:
        journal, faults = RunLog(), self.status.faults
        estimating = EstimatesWriter(
            folder, self.config.as_yaml(), journal, more=self._before_checkpoint, recording=self.record, live=True,
            plugins=participants(self.config),
        )  # fmt: skip
        open.callback(estimating.close)
        found = estimating.look_for() if self.resume else None
        if found:
            faults.found.update(found["source_faults"])
        run = Run(self.config, journal, resume=found["run"] if found else None, settled=estimating.settled)
        self.status.sensor, self.status.axes, self.status.m = run.model.tracked, run.model.tracked.axes, run.model.m
        self.status.align, self.status.noted = run.model.align, journal.faults
        estimating.open(run.model)
        begun = time.monotonic()
        samples = read(self.config, journal.faults, stream=self._samples())
        try:
            stream = epochs(samples, run.model.update_interval)
            for stretch in run.over(stream if self.soaking is None else self.soaking.through(stream)):
                self.status.updated(stretch)
                self.seen(stretch)
                estimating.append(stretch)
        except EmptyRecording:
            if self.status.samples:
                raise
            raise EmptyRecording(
                f"{self.source.name}: not one sample came in {time.monotonic() - begun:.1f} s ({self._heard()}); check "
                "that the device is on, and source.baudrate and source.framing"
            ) from None
        open.close()
        self.status.phase = "writing the results"
        self._report()
        for what, fault in faults.found.items():
            journal.faults.add(what, fault.count, fault.first)
        self.status.faults, self.status.noted = journal.faults, Faults()  # each is said once
        return finish(folder, self.config, run.model, journal, title, out, self.record)

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
        """Report what is done after the run, until it is done."""
        self.status.phase = phase
        with self._ticking():
            yield

    def _known(self, status: GrowingMapStatus) -> None:
        """Take what is known of the map by now."""
        self.status.map = status
        if status.reached and self.soaking is not None and self.soaking.until_reached:
            self.stop.set()

    def _report(self) -> None:
        with self._reporting:
            self._reported = time.monotonic()
            self.report(self.status)

    def _heard(self) -> str:
        return self.status.cause.partition(";")[0]

    def _before_checkpoint(self) -> dict[str, Any]:
        """Make the samples safe that a checkpoint stands on, and return what else it holds."""
        if self.recorder is not None:
            self.recorder.flush()
        return {"source_faults": dict(self.status.faults.found)}

    def _samples(self) -> Iterator[Chunk]:
        """Yield what was recorded before, then what comes; record it, and end when asked to."""
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
