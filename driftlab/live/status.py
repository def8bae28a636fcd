"""The status of a live run."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from driftlab.filtering.segment import RunSegment
from driftlab.live.growing_map import GrowingMapStatus
from driftlab.units import RATE, BiasUnit, unit_of
from fusion_core.chunk import Array, Chunk
from fusion_core.consistency import NisTest, nis_test_of
from fusion_core.contracts import Sensor
from fusion_core.faults import LOST, NO_FRAME, Faults

RECENT = 5.0  # s over which the rate of samples is taken
UPDATES = 100  # whose nis is averaged
LEVEL = 0.95  # of the bounds of that average
SILENT = 2.0  # s without a sample that are reported, where samples come more often than that
SPACINGS = 3.0  # times the usual time between samples, where they do not

Level = Literal["good", "waiting", "warning", "bad"]
Phase = Literal["getting ready", "listening", "writing the results", "fitting the map"]


@dataclass
class Status:
    """The status of a live run."""

    phase: Phase = "getting ready"  # a run does not listen to its device before the filter is compiled
    t: float = np.nan  # time of the last sample, s
    samples: int = 0  # so far
    recorded: int = 0  # rows that are safe in the recording
    waiting: float | None = 0.0  # s of samples so far while the first alignment is waited for; None from then on
    bias: Array = field(default_factory=lambda: np.empty(0))  # (d,): of the tracked sensor, SI
    sigma: Array = field(default_factory=lambda: np.empty(0))  # (d,): its standard deviation
    temperature: float = np.nan  # degC; NaN where there is none
    temperature_rate: float = np.nan  # K/s
    moving: bool = False  # whether the unit moved at the last update, by its sensors
    refused: bool = False  # whether the filter refused that update
    faults: Faults = field(default_factory=Faults)  # that the source reported
    noted: Faults = field(default_factory=Faults)  # for which samples were left out
    align: float = 0.0  # length of the alignment, s
    axes: tuple[str, ...] = ()
    m: int = 1
    sensor: Sensor | None = None
    map: GrowingMapStatus | None = None  # of the map that is fitted meanwhile; it is replaced, never changed
    _nis: deque[float] = field(default_factory=lambda: deque(maxlen=UPDATES))
    _came: deque[tuple[float, int]] = field(default_factory=deque)
    _heard: float = np.nan  # host time of the last sample, or when it was first listened [s]
    _spacing: deque[float] = field(default_factory=lambda: deque(maxlen=5))  # of the last samples [s]
    _torn: int = 0  # bytes without a frame up to the last sample

    @property
    def nis(self) -> float:
        """Mean of the last updates, per measured component."""
        return self.nis_test.mean

    @property
    def nis_test(self) -> NisTest:
        """That mean, and the bounds that it keeps in 95 % of the time where the model is right."""
        nis = list(self._nis)
        return nis_test_of(sum(nis), len(nis), self.m, LEVEL)

    @property
    def unit(self) -> BiasUnit:
        """The unit of the bias."""
        return RATE if self.sensor is None else unit_of(self.sensor)

    @property
    def lost(self) -> int:
        """Samples lost on the way."""
        return self._count(LOST)

    @property
    def no_data(self) -> float:
        """Seconds of the host since the last sample; zero where they are no more than usual."""
        usual = SPACINGS * float(np.median(self._spacing)) if self._spacing else 0.0
        silent = time.monotonic() - self._heard
        return silent if self.phase == "listening" and silent >= max(SILENT, usual) else 0.0

    @property
    def cause(self) -> str:
        """The cause of missing samples, as far as it is known; empty where there are some."""
        if self.faults.unavailable:
            return self.faults.unavailable
        torn = self._count(NO_FRAME) - self._torn
        if torn:
            return f"{torn:,} bytes, no frame; check baudrate and sync"
        return "" if self.samples else "nothing came so far"

    @property
    def state(self) -> str:
        """The state of the run in a few words."""
        return self._state_and_level[0]

    @property
    def level(self) -> Level:
        """The level of that state."""
        return self._state_and_level[1]

    @property
    def _state_and_level(self) -> tuple[str, Level]:
        if self.phase != "listening":
            return self.phase, "waiting"
        silent, cause = self.no_data, self.cause
        if silent:
            return f"no data for {silent:,.0f} s" + (f": {cause}" if cause else ""), "bad"
        if self.faults.unavailable:
            return cause, "bad"
        if not self.samples:
            return cause, "waiting"
        if self.waiting is not None:
            return f"waiting for {self.align:g} s at rest ({self.waiting:.0f} s so far)", "waiting"
        if self.moving:
            return "moving, not used", "warning"
        if self.refused:
            return "at rest, and refused: the model does not fit", "bad"
        if self.map is None or not self.map.unused:
            return "at rest", "good"
        return f"at rest; {self.map.unused_share:.0%} of the soak is not in the map", "warning"

    def lines(self) -> list[str]:
        """Return one sentence for each kind of fault."""
        return [*self.faults.lines(), *self.noted.lines()]

    def rate(self) -> float:
        """Return the latest rate of samples, 1/s."""
        now = time.monotonic()
        while self._came and self._came[0][0] < now - RECENT:
            self._came.popleft()
        if len(self._came) < 2 or self.no_data:
            return 0.0
        return sum(n for _, n in list(self._came)[1:]) / max(now - self._came[0][0], 1e-3)

    def listen(self) -> None:
        """Begin to wait for samples."""
        self.phase, self._heard, self._torn = "listening", time.monotonic(), self._count(NO_FRAME)

    def came(self, chunk: Chunk) -> None:
        """Count samples."""
        self.samples += len(chunk)
        if len(chunk):
            self._heard, self._torn = time.monotonic(), self._count(NO_FRAME)
            if not np.isnan(self.t):
                self._spacing.append((float(chunk.t[-1]) - self.t) / len(chunk))
            if self.waiting is not None:
                self.waiting += 0.0 if np.isnan(self.t) else float(chunk.t[-1]) - self.t
            self.t = float(chunk.t[-1])
            self._came.append((time.monotonic(), len(chunk)))

    def updated(self, stretch: RunSegment) -> None:
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

    def _count(self, fault: str) -> int:
        return self.faults.found[fault].count if fault in self.faults.found else 0

    def as_json(self) -> dict[str, Any]:
        """Return the status for programs."""
        test = self.nis_test
        return {
            "state": self.state,
            "level": self.level,
            "no_data_s": self.no_data,
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
            "nis_per_component": test.mean,
            "nis_low": test.low,
            "nis_high": test.high,
            "moving": self.moving,
            "refused": self.refused,
            "faults": {w: f.count for faults in (self.faults, self.noted) for w, f in list(faults.found.items())},
            **({} if self.map is None else {"map": self.map.as_json()}),
        }
