"""A device through a config while it measures: the same filter as in a run, and what it says at the moment."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.config import Config
from driftlab.files.folders import output_folder
from driftlab.files.recorder import Recorder, recorded_source
from driftlab.filtering.run import Run
from driftlab.filtering.stretch import Journal, Stretch
from driftlab.filtering.warm_up import warm_up
from driftlab.jobs.estimating import PERIOD, Estimating
from driftlab.jobs.run import RunResult, finish
from driftlab.maps.growing import MapStatus
from driftlab.samples.epochs import epochs
from driftlab.samples.screening import ROWS, read
from driftlab.units import RATE, BiasUnit, unit_of
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Sensor
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.faults import LOST, NO_FRAME, Faults
from fusion_core.host.participants import participants

RECENT = 5.0  # s over which the rate of samples is taken
UPDATES = 100  # whose nis is averaged


@dataclass
class Status:
    """What a live run says at the moment.

    Attributes
    ----------
    t : float
        Time of the last sample, s.
    samples, recorded : int
        Samples so far, and rows of them that are safe in the recording.
    waiting : float or None
        Seconds of samples so far while the first alignment is waited for; None from then on.
    bias, sigma : (d,) arrays
        Of the tracked sensor and its standard deviation, in SI.
    temperature, temperature_rate : float
        degC and K/s; NaN where there is none.
    nis : float
        Of the last updates, per measured component: 1 where the model is right.
    moving, refused : bool
        Whether the unit moved at the last update, by its sensors, and whether the filter refused it.
    faults : Faults
        What the source reported.
    noted : Faults
        What was left out of its samples.
    align : float
        Length of the alignment, s.
    map : MapStatus or None
        Of the map that is fitted meanwhile (`--fit-map`); None where none is. It is replaced, never changed.
    """

    t: float = np.nan
    samples: int = 0
    recorded: int = 0
    waiting: float | None = 0.0
    bias: Array = field(default_factory=lambda: np.empty(0))
    sigma: Array = field(default_factory=lambda: np.empty(0))
    temperature: float = np.nan
    temperature_rate: float = np.nan
    moving: bool = False
    refused: bool = False
    faults: Faults = field(default_factory=Faults)
    noted: Faults = field(default_factory=Faults)
    align: float = 0.0
    axes: tuple[str, ...] = ()
    m: int = 1
    sensor: Sensor | None = None
    map: MapStatus | None = None
    _nis: deque[float] = field(default_factory=lambda: deque(maxlen=UPDATES))
    _came: deque[tuple[float, int]] = field(default_factory=deque)

    @property
    def nis(self) -> float:
        """Mean of the last updates, per measured component."""
        return float(np.mean(self._nis)) / self.m if self._nis else np.nan

    @property
    def unit(self) -> BiasUnit:
        """The unit of the bias."""
        return RATE if self.sensor is None else unit_of(self.sensor)

    @property
    def lost(self) -> int:
        """Samples lost on the way."""
        return self.faults.found[LOST].count if LOST in self.faults.found else 0

    @property
    def state(self) -> str:
        """What is going on, in a few words."""
        if not self.samples:
            came = self.faults.found[NO_FRAME].count if NO_FRAME in self.faults.found else 0
            return f"{came:,} bytes, no frame; check baudrate and sync" if came else "nothing came so far"
        if self.waiting is not None:
            return f"waiting for {self.align:g} s at rest ({self.waiting:.0f} s so far)"
        if self.moving:
            return "moving, not used"
        return "at rest, and refused: the model does not fit" if self.refused else "at rest"

    def lines(self) -> list[str]:
        """Return one sentence for each kind of fault."""
        return [*self.faults.lines(), *self.noted.lines()]

    def rate(self) -> float:
        """Return the samples a second that came lately."""
        now = time.monotonic()
        while self._came and self._came[0][0] < now - RECENT:
            self._came.popleft()
        if len(self._came) < 2:
            return 0.0
        return sum(n for _, n in list(self._came)[1:]) / max(now - self._came[0][0], 1e-3)

    def came(self, chunk: Chunk) -> None:
        """Count samples."""
        self.samples += len(chunk)
        if len(chunk):
            if self.waiting is not None:
                self.waiting += 0.0 if np.isnan(self.t) else float(chunk.t[-1]) - self.t
            self.t = float(chunk.t[-1])
            self._came.append((time.monotonic(), len(chunk)))

    def updated(self, stretch: Stretch) -> None:
        """Take the newest estimates."""
        self.waiting = None
        self.bias, self.sigma = stretch.bias[-1], stretch.sigma[-1]
        used = stretch.estimates.used
        self.moving, self.refused = not stretch.still[-1], not used[-1]
        self._nis.extend(stretch.estimates.nis[used][-UPDATES:])
        channels = stretch.epochs.channels
        if "temperature" in channels:
            self.temperature = float(channels["temperature"][-1])
            self.temperature_rate = float(channels["temperature_rate"][-1])

    def as_json(self) -> dict[str, Any]:
        """Return the status for programs."""
        return {
            "state": self.state,
            "t_s": self.t,
            "samples": self.samples,
            "samples_per_s": self.rate(),
            "lost": self.lost,
            "recorded": self.recorded,
            "aligned": self.waiting is None,
            **self.unit.note,
            self.unit.key("bias"): self.bias,
            self.unit.key("sigma"): self.sigma,
            "temperature_degC": self.temperature,
            "temperature_rate_K_s": self.temperature_rate,
            "nis_per_component": self.nis,
            "moving": self.moving,
            "refused": self.refused,
            "faults": {w: fault.count for found in (self.faults, self.noted) for w, fault in found.found.items()},
            **({} if self.map is None else {"map": self.map.as_json()}),
        }


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
        Called with the status, at every chunk and every second.
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
    ) -> None:
        if config.source is None or not config.source.live:
            kind = "none" if config.source is None else config.source.kind
            raise ConfigError(f"source: a live one is needed and this is {kind}; use kind: serial, or `driftlab run`")
        if resume and record is None:
            raise ConfigError("--resume: a live run can only go on with its recording; add --record FILE")
        self.config, self.source, self.record = config, config.source, record
        self.duration, self.resume, self.force, self.report = duration, resume, force, report
        self.stop = threading.Event()  # set it to end the run cleanly
        self.status = Status(sensor=None if config.filter is None else config.filter.tracked)
        self.recorder: Recorder | None = None

    def to_folder(self, out: Path, *, title: str, read: Collection[Path] = ()) -> RunResult:
        """Run until stopped, and write the same files as `driftlab.jobs.run.run` into the folder `out`.

        Raises
        ------
        EmptyRecording
            If not one sample came.
        """
        self.report(self.status)  # what follows may have to be compiled first
        record = [self.record] if self.record is not None else []
        held = output_folder(
            out,
            read=[*read, *record, *self.config.files()],
            resume=self.resume,
            force=self.force,
            recording=self.record,
            durable=True,
        )
        with held as folder, ExitStack() as open:
            if self.record is not None:
                text = self.config.as_yaml()
                self.recorder = Recorder(self.record, text, resume=self.resume, force=self.force)
                open.callback(self.recorder.close)
                if self.recorder.kept is not None:
                    self.status.faults.add("recordings that could not be read, kept", 1, f"as {self.recorder.kept}")
            warm_up(self.config)
            return self._run(folder, open, title, out)

    def _run(self, folder: Path, open: ExitStack, title: str, out: Path) -> RunResult:
        journal, faults = Journal(), self.status.faults
        estimating = Estimating(
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
            for stretch in run.over(epochs(samples, run.model.update_interval)):
                self.status.updated(stretch)
                estimating.append(stretch)
        except EmptyRecording:
            if self.status.samples:
                raise
            raise EmptyRecording(
                f"{self.source.name}: not one sample came in {time.monotonic() - begun:.1f} s ({self._heard()}); check "
                "that the device is on, and source.baudrate and source.framing"
            ) from None
        open.close()
        for what, fault in faults.found.items():
            journal.faults.add(what, fault.count, fault.first)
        return finish(folder, self.config, run.model, journal, title, out)

    def _heard(self) -> str:
        return self.status.state.partition(";")[0]

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
        for arrived in self.source.chunks(ROWS, self.status.faults):
            chunk = arrived if self.recorder is None else self.recorder.add(arrived)
            self.status.came(chunk)
            yield chunk
            now = time.monotonic()
            if self.recorder is not None and now - flushed >= PERIOD / 2:
                self.recorder.flush()
                self.status.recorded, flushed = self.recorder.rows, now
            self.report(self.status)
            if self.stop.is_set() or (self.duration is not None and now - begun >= self.duration):
                return
