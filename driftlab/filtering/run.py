"""One recording through one config: epochs in, estimates out, stretch by stretch.

The first rest of a recording: epochs are collected until enough of them in a row stand still.

A run on made-up samples, so that the first real one finds every loop compiled and every map loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable
from contextlib import closing, contextmanager, suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from driftlab.config import Config
from driftlab.filtering.extrapolation import beyond, with_domain
from driftlab.filtering.segment import RunLog, RunSegment
from driftlab.filtering.setup import (
    ENOUGH,
    RunSetup,
    calibrations_of,
    check_channels,
    check_map,
    followed_map,
    needed_channels,
    prior_at,
    shown_by_soak,
    too_few_updates,
)
from driftlab.filtering.tracker import Filtered, Segments, Tracker
from driftlab.recordings.epochs import epochs
from driftlab.recordings.prefetch import prefetch
from driftlab.recordings.screening import read
from driftlab.units import unit_of
from fusion_core.chunk import Chunk, concatenate
from fusion_core.consistency import gate_of
from fusion_core.contracts import Alignment, FittedMap, Sensor, ThermalBias
from fusion_core.contracts.effect import as_measured
from fusion_core.errors import ConfigError, NotAtRest, OutsideDomain
from fusion_core.faults import Faults
from fusion_core.kalman import SHORT
from fusion_core.thermal.rate_estimators import RateMemory, with_rate
from fusion_core.thermal.thermometer import NO_STEPS, sawtooth


class Moment(NamedTuple):
    """The state of the filter between two chunks of epochs: the time in s, the tracker's snapshot, its alignments."""

    t: float
    tracker: dict[str, Any]
    alignments: list[Alignment]


class Run:
    """A run in progress: iterate over it for stretches.

    Parameters
    ----------
    config : Config
        With a filter, and a source unless `over` is used.
    journal : Journal
        Where what happens on the way is noted.
    initial_error : float
        Added to every axis of the tracked bias at the end of the alignment, in SI; unknown to the filter.
    keep_model : bool
        Whether the stretches keep the arrays that the filter was run on.
    resume : dict, optional
        What a checkpoint of an earlier run holds: it goes on from there. The source is read from its beginning again
        (that is the fast part), so what comes before the filter needs no checkpoint.
    settled : callable, optional
        Called with what a checkpoint holds, whenever all stretches up to a moment have been yielded.
    """

    def __init__(
        self,
        config: Config,
        journal: RunLog,
        *,
        initial_error: float = 0.0,
        keep_model: bool = False,
        resume: dict[str, Any] | None = None,
        settled: Callable[[Callable[[], dict[str, Any]]], None] | None = None,
    ) -> None:
        if config.filter is None:
            raise ConfigError("filter: is missing; begin the config with e.g. `extends: mems_crs05`")
        self.config, self.model, self.journal = config, config.filter, journal
        self.resume, self.settled = resume, settled
        loaded, followed = calibrations_of(self.model), {}
        for sensor in self.model.sensors:
            if (fitted := followed_map(sensor.bias)) is not None:
                check_map(fitted, sensor)
                followed[sensor.channel] = fitted
            if (of_sensor := fitted or loaded.get(sensor.channel)) is not None:
                _note_memory(sensor, of_sensor, journal.faults)
        self.maps = [*loaded.values(), *followed.values()]
        self.limited = [effect for sensor in self.model.sensors for effect in with_domain(sensor.bias)]
        gate = gate_of(self.model.m, self.model.patience.false_alarm)
        self.plan = RunSetup(self.model, config.site, loaded, followed, gate, initial_error, keep_model)

    def __iter__(self) -> Generator[RunSegment]:
        """Yield the stretches of the config's source; raises ConfigError where that is live."""
        if self.config.source is not None and self.config.source.live:
            raise ConfigError(
                f"source: kind {self.config.source.kind} is live; use `driftlab live`, or name a recording with --input"
            )
        stream = epochs(read(self.config, self.journal.faults), self.model.update_interval)
        return self._segments(self._prepared(_last_two_joined(stream)), prefetch)

    def over(self, stream: Iterable[Chunk]) -> Generator[RunSegment]:
        """Yield the stretches of a stream of epochs."""
        return self._segments(self._prepared(stream), lambda items: items)

    def _prepared(self, stream: Iterable[Chunk]) -> Generator[Chunk]:
        """Yield the epochs, checked and with the rate of their temperature."""
        rate_memory: RateMemory | None = None
        known: Collection[str] = ()
        steps = max((fitted.record.steps for fitted in self.maps), default=NO_STEPS)
        coarse = steps.size, float(np.sum(sawtooth(*steps)))
        low = max((fitted.domain[0] for fitted in self.maps), default=np.inf)
        high = min((fitted.domain[1] for fitted in self.maps), default=-np.inf)
        for chunk in stream:
            if chunk.channels.keys() != known:
                check_channels(self.model, chunk)
                known = chunk.channels.keys()
            chunk, rate_memory = with_rate(chunk, self.model.temperature_rate, rate_memory, coarse, (low, high))
            self._note_beyond_maps(chunk)
            self._note_beyond_effects(chunk)
            yield chunk

    def _segments(
        self, stream: Generator[Chunk], beside: Callable[[Generator[Any]], Generator[Any]]
    ) -> Generator[RunSegment]:
        """Yield the segments of a stream of epochs; `beside` has another thread make what is asked for."""
        tracker, segments = self._resumed()
        with closing(beside(self._filtered(beside(stream), tracker))) as parts:
            for part in parts:
                if isinstance(part, Moment):
                    assert self.settled is not None, "who did not ask for moments gets none"
                    assert segments is not None, "a moment comes after epochs"
                    self.settled(partial(self._snapshot, part, segments))
                else:
                    segments = segments or Segments(self.plan, self.journal)
                    yield segments.segment(part)

    def _filtered(self, stream: Generator[Chunk], tracker: Tracker | None) -> Generator[Filtered | Moment]:
        waiting, done = FirstRest(self.plan), -np.inf if self.resume is None else self.resume["t"]
        with closing(stream), self._timed_errors():
            for chunk in stream:
                if chunk.t[0] <= done:
                    chunk = chunk.part(int(np.searchsorted(chunk.t, done, side="right")), len(chunk))
                if len(chunk) and tracker is None:
                    chunk = waiting.take(chunk)
                    tracker = self._aligned(waiting, chunk)
                if len(chunk) == 0 or tracker is None:
                    continue
                yield from tracker.advance(chunk)
                done = float(chunk.t[-1])
                if self.settled is not None:
                    yield Moment(done, tracker.snapshot(), list(self.journal.alignments))
        if tracker is None:
            raise NotAtRest(self._never_at_rest(waiting))

    @contextmanager
    def _timed_errors(self) -> Generator[None]:
        """Add the time to the error of a map that is evaluated outside its domain."""
        try:
            yield
        except OutsideDomain as error:
            raise error.at(self.journal.faults.when) from None

    def _aligned(self, waiting: FirstRest, chunk: Chunk) -> Tracker | None:
        """Return the tracker of the epochs from the first rest on, once there is one."""
        if waiting.alignment is None:
            return None
        self.journal.alignments.append(waiting.alignment)
        for text in (*waiting.alignment.notes, *waiting.alignment.off):
            self.journal.faults.note(text)
        state = prior_at(self.model, chunk, waiting.alignment)
        return Tracker(self.plan, self.journal, waiting.alignment, state)

    def _resumed(self) -> tuple[Tracker, Segments] | tuple[None, None]:
        if self.resume is None:
            return None, None
        try:
            self.journal.alignments[:] = self.resume["alignments"]
            self.journal.moving, self.journal.refused = self.resume["moving"], self.resume["refused"]
            tracker = Tracker.of(self.plan, self.journal, self.resume["tracker"])
            return tracker, Segments.of(self.plan, self.journal, self.resume["segments"])
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise ConfigError(
                f"--resume: the checkpoint is not laid out as this version of driftlab writes it ({error}); begin anew "
                "without --resume"
            ) from None

    def _snapshot(self, moment: Moment, segments: Segments) -> dict[str, Any]:
        journal = self.journal
        return {
            **moment._asdict(),
            "segments": segments.snapshot(),
            "moving": journal.moving,
            "refused": journal.refused,
        }

    def _note_beyond_maps(self, chunk: Chunk) -> None:
        for fitted in self.maps:
            if fitted.outside == "refuse":
                continue  # the map itself does
            low, high = fitted.domain
            T = chunk["temperature"]
            beyond = (low > T) | (high < T)
            if np.count_nonzero(beyond):
                k = int(np.argmax(beyond))
                where = f"at {self.journal.faults.when(chunk.t[k])}, {T[k]:.2f} °C"
                how = "clamped to it" if fitted.outside == "clamp" else "where it goes straight on"
                how += ": how the bias goes on there is not in the sigma of the bias"
                of = "" if len(self.maps) == 1 else f"{fitted.record.channel} "
                what = f"updates beyond the {of}{fitted.record.kind}'s domain ({low:.2f}, {high:.2f}) °C, {how}"
                self.journal.faults.add(what, int(np.sum(beyond)), where)

    def _note_beyond_effects(self, chunk: Chunk) -> None:
        for effect in self.limited:
            for name, outside in beyond(effect, as_measured(chunk)):
                k = int(np.argmax(outside))
                ends = " and ".join(f"({low:.5g}, {high:.5g})" for low, high in effect.ends(name))
                what = (
                    f"updates with {name} beyond {ends}, on which {effect.kind} was fitted: what it adds is held "
                    "there, and its sigma grows"
                )
                count = int(np.sum(outside))
                self.journal.beyond[effect.kind, name] += count
                self.journal.faults.add(what, count, f"at {self.journal.faults.when(chunk.t[k])}")

    def _never_at_rest(self, waiting: FirstRest) -> str:
        align_s, chunk = self.model.align, waiting.chunk
        have = 0.0 if chunk is None else float(chunk.t[-1] - chunk.t[0])
        name = self.config.source.name if self.config.source else "the recording"
        left_out = "".join(f"; {line}" for line in self.journal.faults.lines(notes=False))
        left_out = left_out.replace(";", ",")  # in a message, what comes after a semicolon is what to do
        if 0 < waiting.rows < ENOUGH:
            return f"{name}: {too_few_updates(self.model, waiting.rows, align_s / max(waiting.rows - 1, 0.5))}"
        return (
            f"{name}: no {align_s:g} s at rest were found for the alignment (the last {have:.1f} s were still being "
            f"looked at{left_out}); use a longer recording, set filter.align lower, or check "
            f"{self.model.tracked.section}.noise and the units"
        )


def _note_memory(sensor: Sensor, fitted: FittedMap, faults: Faults) -> None:
    """Note that the soak of a sensor's map showed a difference between up and down which no effect of its bias has."""
    memory = fitted.record.memory or {}
    effects = sensor.bias.effects if isinstance(sensor.bias, ThermalBias) else ()
    kinds = memory.get("kinds") if memory.get("answer") == "seen" else ("turn_on", "drift")
    if isinstance(kinds, list | tuple) and any(effect.kind in kinds for effect in effects):
        return
    if text := shown_by_soak(fitted, sensor.axes, unit_of(sensor)):
        faults.note(
            f"the soak of the {sensor.channel}'s map {text}, which no effect of the config follows and no sigma has in "
            "it; `driftlab explain` looks for its cause"
        )


def _last_two_joined(chunks: Iterable[Chunk]) -> Generator[Chunk]:
    """Yield the chunks of a recording, the last two as one: its last epoch is over where it ends, and comes alone."""
    held: list[Chunk] = []
    for chunk in chunks:
        if len(held) == 2:
            yield held.pop(0)
        held.append(chunk)
    if held:
        yield concatenate(held)


class FirstRest:
    """The epochs so far, and the alignment once there is one."""

    def __init__(self, plan: RunSetup) -> None:
        self.plan = plan
        self.alignment: Alignment | None = None
        self.rows = 0  # of the longest stretch that was looked at
        self._parts: list[Chunk] = []

    @property
    def chunk(self) -> Chunk | None:
        """The epochs that are still being looked at."""
        return concatenate(self._parts) if self._parts else None

    def take(self, chunk: Chunk) -> Chunk:
        """Look at more epochs; return those from the first rest on, if there is one, else all that may belong to it."""
        self._parts.append(chunk)
        length = self.plan.model.align * (1 - 1e-9)
        if chunk.t[-1] - self._parts[0].t[0] < length:
            return chunk  # joining them once, and not at every epoch of a live source
        waiting = concatenate(self._parts)
        t, start = waiting.t, 0
        while (stop := int(np.searchsorted(t, t[start] + length)) + 1) <= len(t):
            if self._is_rest(waiting.part(start, stop)):
                break
            start += max(1, (stop - start) // 4)
            if start >= len(t):
                break
        self._parts = [waiting.part(min(start, len(t) - 1), len(t))]
        return self._parts[0]

    def _is_rest(self, window: Chunk) -> bool:
        """Return True if the unit was at rest; then it is aligned."""
        model = self.plan.model
        measured = np.sum(window["tau"]) >= model.align / 2  # a gap is no rest
        self.rows = max(self.rows, len(window))
        if not (measured and len(window) >= ENOUGH and model.still(window)):
            return False
        model.check(window, self.plan.site)
        self.alignment = self.plan.aligned(window)
        return True


def warm_up(config: Config) -> None:
    """Run a config on a unit at rest, up to and past its alignment; a device would not wait for a compiler."""
    run = Run(config, RunLog())
    model, rng = run.model, np.random.default_rng(0)
    interval = model.update_interval
    N = int(model.align / interval) + 2 * SHORT
    channels = {name: np.zeros(N) for name in needed_channels(model)}
    channels["temperature"] = np.full(N, np.mean(run.maps[0].domain) if run.maps else 20.0)
    channels.update(model.simulated(N, config.site, rng))
    whole = Chunk(np.arange(N, dtype=np.float64) * interval, channels)
    parts = [whole.part(0, N - 2), whole.part(N - 2, N - 1), whole.part(N - 1, N)]  # many at once, and one by one
    with suppress(Exception):  # what is wrong with it, a plugin's own defects too, the run itself will say
        for _ in run.over(epochs(read(config, Faults(), stream=parts), interval)):
            pass
