"""A device through a config while it measures: the same filter as in a run, and what it says at the moment."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.config import Config
from driftlab.epochs import epochs
from driftlab.filtering import PERIOD, Estimating, Result, finish
from driftlab.intake import ROWS, read
from driftlab.outputs import output_folder
from driftlab.recording import Recorder, recorded_source
from driftlab.rehearsal import rehearse
from driftlab.run import Run
from driftlab.stretch import Journal, Stretch
from fusion_core.chunk import Array, Chunk
from fusion_core.errors import ConfigError
from fusion_core.faults import LOST, Faults

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
        Gyro bias and its standard deviation, rad/s.
    temperature, temperature_rate : float
        degC and K/s; NaN where there is none.
    nis : float
        Of the last updates, per measured component: 1 where the model is right.
    moving : bool
        Whether the last update was refused.
    faults : Faults
        What the source reported.
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
    faults: Faults = field(default_factory=Faults)
    axes: tuple[str, ...] = ()
    m: int = 1
    _nis: deque[float] = field(default_factory=lambda: deque(maxlen=UPDATES))
    _came: deque[tuple[float, int]] = field(default_factory=deque)

    @property
    def nis(self) -> float:
        """Mean of the last updates, per measured component."""
        return float(np.mean(self._nis)) / self.m if self._nis else np.nan

    @property
    def lost(self) -> int:
        """Samples lost on the way."""
        return self.faults.found[LOST].count if LOST in self.faults.found else 0

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
        self.moving = not used[-1]
        self._nis.extend(stretch.estimates.nis[used][-UPDATES:])
        channels = stretch.epochs.channels
        if "temperature" in channels:
            self.temperature = float(channels["temperature"][-1])
            self.temperature_rate = float(channels["temperature_rate"][-1])

    def as_json(self) -> dict[str, Any]:
        """Return the status for programs."""
        return {
            "t_s": self.t,
            "samples": self.samples,
            "samples_per_s": self.rate(),
            "lost": self.lost,
            "recorded": self.recorded,
            "aligned": self.waiting is None,
            "bias_rad_s": self.bias,
            "sigma_rad_s": self.sigma,
            "temperature_degC": self.temperature,
            "temperature_rate_K_s": self.temperature_rate,
            "nis_per_component": self.nis,
            "moving": self.moving,
            "faults": {what: fault.count for what, fault in self.faults.found.items()},
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
        report: Callable[[Status], None] = lambda status: None,
    ) -> None:
        if config.source is None or not config.source.live:
            kind = "none" if config.source is None else config.source.kind
            raise ConfigError(f"source: a live one is needed and this is {kind}; use kind: serial, or `driftlab run`")
        if resume and record is None:
            raise ConfigError("--resume: a live run can only go on with its recording; add --record FILE")
        self.config, self.source, self.record = config, config.source, record
        self.duration, self.resume, self.report = duration, resume, report
        self.stop = threading.Event()  # set it to end the run cleanly
        self.status = Status()
        self.recorder: Recorder | None = None

    def to_folder(self, out: Path, *, title: str) -> Result:
        """Run until stopped, and write the same files as `run_to_folder` into the folder `out`."""
        rehearse(self.config)
        journal, text = Journal(), self.config.as_yaml()
        with output_folder(out, resume=self.resume) as folder:
            faults = self.status.faults
            estimating = Estimating(folder, text, journal, more=self._before_checkpoint)
            found = estimating.look_for() if self.resume else None
            if found:
                faults.found.update(found["source_faults"])
            run = Run(self.config, journal, resume=found["run"] if found else None, settled=estimating.settled)
            self.status.axes, self.status.m = run.model.axes, run.model.m
            estimating.open(run.model)
            self.recorder = Recorder(self.record, text, resume=self.resume) if self.record is not None else None
            try:
                samples = read(self.config, journal.faults, stream=self._samples())
                for stretch in run.over(epochs(samples, run.settings.update_interval)):
                    self.status.updated(stretch)
                    estimating.append(stretch)
            finally:
                estimating.close()
                if self.recorder is not None:
                    self.recorder.close()
            for what, fault in faults.found.items():
                journal.faults.add(what, fault.count, fault.first)
            return finish(folder, self.config, run.model, journal, title)

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
