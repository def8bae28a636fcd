"""One recording through one config: epochs in, estimates out, stretch by stretch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from driftlab.alignment import Alignment, align, at_rest
from driftlab.config import Config
from driftlab.epochs import epochs
from driftlab.intake import read
from driftlab.temperature import with_rate
from driftlab.zupt import Zupt
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.consistency import gate_of
from fusion_core.contracts import FittedMap, Memory, Transition
from fusion_core.errors import ConfigError, MissingChannel, NotAtRest
from fusion_core.faults import Faults
from fusion_core.filter import estimate
from fusion_core.model import Estimates, Flags, Measurement, State

REGULAR = 1e-3  # epochs whose duration is this near the usual one are taken to last just as long


@dataclass(frozen=True)
class Stretch:
    """Estimates over consecutive epochs.

    Attributes
    ----------
    epochs : Chunk
        What the filter was given: `gyro` (N, 3) as measured, mean rates in rad/s, and the other channels.
    rate : (N, d) array
        Measured rate less Earth rate, uncorrected, rad/s: what `bias` is an estimate of.
    bias, sigma : (N, d) arrays
        Gyro bias after each update and its standard deviation, rad/s; with the calibration's part, where there is one.
    coast : (N, d) array
        Gyro bias as predicted from the end of the alignment, no measurement used since, rad/s; NaN before it.
    estimates : Estimates
        Of all n states.
    """

    epochs: Chunk
    rate: Array
    bias: Array
    sigma: Array
    coast: Array
    estimates: Estimates


@dataclass
class Journal:
    """What happened on the way, for the summary."""

    faults: Faults = field(default_factory=Faults)
    alignments: list[Alignment] = field(default_factory=list)
    moving: list[tuple[float, float]] = field(default_factory=list)  # from, to (s)


class Run:
    """A run in progress: iterate over it for stretches."""

    def __init__(self, config: Config, journal: Journal) -> None:
        if config.filter is None:
            raise ConfigError("filter: is missing; begin the config with e.g. `extends: mems_crs05`")
        self.config, self.settings, self.journal = config, config.filter, journal
        self.model = Zupt(self.settings)
        calibration = self.settings.gyro.calibration
        self.calibration: FittedMap | None = calibration.load() if calibration else None
        followed: FittedMap | None = getattr(self.settings.gyro.bias, "fitted", None)
        self.maps = [fitted for fitted in (self.calibration, followed) if fitted is not None]
        self.gate = gate_of(self.model.m, self.settings.rest.false_alarm)

    def __iter__(self) -> Iterator[Stretch]:
        """Yield the stretches of the config's source."""
        return self.over(epochs(read(self.config, self.journal.faults), self.settings.update_interval))

    def over(self, stream: Iterable[Chunk]) -> Iterator[Stretch]:
        """Yield the stretches of a stream of epochs."""
        tracker: Tracker | None = None
        waiting: Chunk | None = None
        rate_memory: Array | None = None
        for chunk in stream:
            self._check(chunk)
            chunk, rate_memory = with_rate(chunk, self.settings.temperature_rate, rate_memory)
            self._note_beyond_maps(chunk)
            if tracker is None:
                waiting = chunk if waiting is None else concatenate([waiting, chunk])
                waiting, alignment = self._first_rest(waiting)
                if alignment is None:
                    continue
                tracker, chunk = Tracker(self, alignment), waiting
            yield from tracker.advance(chunk)
        if tracker is None:
            raise NotAtRest(self._never_at_rest(waiting))

    def _check(self, chunk: Chunk) -> None:
        needs = {name for triad in self.model.triads for name in (triad.channel, *triad.model.requires)}
        if self.calibration is not None:
            needs.add("temperature")
        for name in sorted(needs - {"temperature_rate"}):
            if name == "accel" and name not in chunk.channels:
                raise MissingChannel(
                    "filter.accel is set and the recording has no channel 'accel'; name it under source.channels, "
                    "or write `accel: null` under filter"
                )
            _ = chunk[name]
        for triad in self.model.triads:
            if chunk[triad.channel].shape[1] != len(triad.model.axes):
                have = chunk[triad.channel].shape[1]
                raise ConfigError(
                    f"{triad.channel}: the recording has {have} axes and the bias model {len(triad.model.axes)}; "
                    "name as many under bias.axes"
                )

    def _note_beyond_maps(self, chunk: Chunk) -> None:
        for fitted in self.maps:
            low, high = fitted.domain
            T = chunk["temperature"]
            beyond = (low > T) | (high < T)
            if fitted.outside == "clamp" and np.any(beyond):
                k = int(np.argmax(beyond))
                where = f"at t = {chunk.t[k]:.6g} s, {T[k]:.2f} degC"
                what = f"updates beyond the {fitted.record.kind}'s domain ({low:.2f}, {high:.2f}) degC, clamped to it"
                self.journal.faults.add(what, int(np.sum(beyond)), where)

    def _first_rest(self, waiting: Chunk) -> tuple[Chunk, Alignment | None]:
        """Return the epochs from the first rest on, and its alignment once there is one."""
        t = waiting.t
        start = 0
        while (stop := int(np.searchsorted(t, t[start] + self.settings.align * (1 - 1e-9))) + 1) <= len(t):
            window = waiting.part(start, stop)
            if len(window) > 2 and at_rest(window, self.settings):
                return waiting.part(start, len(t)), align(window, self.config, self.settings)
            start += max(1, (stop - start) // 4)
            if start >= len(t):
                break
        return waiting.part(min(start, len(t) - 1), len(t)), None

    def _never_at_rest(self, waiting: Chunk | None) -> str:
        align_s = self.settings.align
        have = 0.0 if waiting is None else float(waiting.t[-1] - waiting.t[0])
        name = self.config.source.name if self.config.source else "the recording"
        return (
            f"{name}: no {align_s:g} s at rest were found for the alignment (the last {have:.1f} s were still being "
            "looked at); use a longer recording, set filter.align lower, or check filter.gyro.noise and the units"
        )


class Tracker:
    """The filter after its alignment: state, coasting prediction, memories, and the look-out for motion."""

    def __init__(self, run: Run, alignment: Alignment) -> None:
        self.run, self.model, self.settings = run, run.model, run.settings
        self.alignment = alignment
        self.aligned_at, self.usual = alignment.t, alignment.dt
        self.state = run.model.prior()
        self.coast: State | None = None
        self.memories: list[Memory] = [None] * len(run.model.triads)
        self.refused: Chunk | None = None  # the epochs refused in a row, up to now
        run.journal.alignments.append(alignment)

    def advance(self, chunk: Chunk) -> Iterator[Stretch]:
        """Yield the estimates of the next epochs."""
        for piece in regular_pieces(chunk, self.usual):
            at = int(np.searchsorted(piece.t, self.aligned_at, side="right"))
            for part in (piece.part(0, at), piece.part(at, len(piece))):
                if len(part):
                    yield from self._advance(part)

    def _advance(self, piece: Chunk) -> Iterator[Stretch]:
        steps, self.memories = self.model.bias_steps(piece, self.memories)
        calibration = self._calibration(piece)
        start = 0
        while start < len(piece):
            part = piece.part(start, len(piece))
            corrected = part if calibration is None else part.having(gyro=part["gyro"] - calibration[start:])
            part_steps = [_rows(step, start, len(piece)) for step in steps]
            transition = self.model.transition(corrected, part_steps, self.alignment)
            stop, found = self._filter(part, transition)
            self.state = found.state
            done = part.part(0, stop)
            done_steps = [_rows(step, 0, stop) for step in part_steps]
            yield self._stretch(
                done, found, done_steps, None if calibration is None else calibration[start : start + stop]
            )
            start += stop
            self._look_out(done, found.used)

    def _filter(self, part: Chunk, transition: Transition) -> tuple[int, Estimates]:
        """Run the filter up to the end, or to where the unit may be at rest anew."""
        gate = self.run.gate * self.alignment.gate_scale
        keep_P = any(triad.model.labels != triad.model.axes for triad in self.model.triads)

        def over(stop: int) -> Estimates:
            some = _rows(transition, 0, stop)
            measurement = self.model.measurement(stop)
            return estimate(self.state, some, measurement, gate=gate, volatile=self.model.volatile, keep_P=keep_P)

        found = over(len(part))
        for start, stop in _stretches(~found.used):
            since = self.refused.t[0] if start == 0 and self.refused is not None else part.t[start]
            long_enough = part.t[start:stop] - since >= self.settings.rest.realign_after
            if np.any(long_enough):
                end = start + int(np.argmax(long_enough)) + 1
                return end, found if end == len(part) else over(end)
        return len(part), found

    def _look_out(self, done: Chunk, used: Flags) -> None:
        """Note motion; align anew where the unit has been still, at another bias or attitude, for long enough."""
        refused = _stretches(~used)
        for start, stop in refused:
            self._note_motion(
                float(done.t[start]), float(done.t[stop - 1]), joined=start == 0 and self.refused is not None
            )
        if not refused or refused[-1][1] < len(done):
            self.refused = None
            return
        tail = done.part(refused[-1][0], len(done))
        self.refused = tail if self.refused is None or len(tail) < len(done) else concatenate([self.refused, tail])
        if self.refused.t[-1] - self.refused.t[0] < self.settings.rest.realign_after:
            return
        # the onset is no part of the rest
        still = self.refused.part(len(self.refused) // 4, len(self.refused))
        if at_rest(still, self.settings):
            self.alignment = align(still, self.run.config, self.settings)
            self.run.journal.alignments.append(self.alignment)
            self.state = self.model.prior()
            self.refused = None
        else:
            self.refused = self.refused.part(len(self.refused) // 2, len(self.refused))

    def _note_motion(self, start: float, stop: float, *, joined: bool) -> None:
        moving = self.run.journal.moving
        if joined and moving:
            start = moving.pop()[0]
        moving.append((start, stop))

    def _calibration(self, piece: Chunk) -> Array | None:
        fitted = self.run.calibration
        return None if fitted is None else fitted.bias(piece["temperature"], piece.t)

    def _stretch(self, done: Chunk, found: Estimates, steps: list[Transition], calibration: Array | None) -> Stretch:
        block = self.model.blocks["gyro"]
        bias, sigma = _output(found, block, steps[-1].C)
        coast = self._coast(done, steps[-1], found)
        if calibration is not None:
            bias, coast = bias + calibration, coast + calibration
        return Stretch(done, done["gyro"] - self.alignment.omega_ie, bias, sigma, coast, found)

    def _coast(self, done: Chunk, step: Transition, found: Estimates) -> Array:
        """Predict the gyro's bias block, no measurement used, from the end of the first alignment."""
        block = self.model.blocks["gyro"]
        if done.t[-1] <= self.aligned_at:
            self.coast = State(found.state.x[block], found.state.P[block, block])
            return np.full((len(done), len(self.model.triads[-1].model.axes)), np.nan)
        assert self.coast is not None
        n, N = len(self.coast.x), len(done)
        nothing = Measurement(np.zeros((N, 0)), np.zeros((0, n)), np.zeros((0, 0)), np.zeros(N, dtype=bool))
        predicted = estimate(self.coast, step, nothing)
        self.coast = predicted.state
        return _output(predicted, slice(0, n), step.C)[0]


def regular_pieces(chunk: Chunk, usual: float) -> Iterator[Chunk]:
    """Cut a chunk where its epochs stop or start to last as usual; those that do get the very same duration."""
    dt, tau = np.broadcast_to(chunk.dt, chunk.t.shape).copy(), chunk["tau"].copy()
    regular = (np.abs(dt / usual - 1) < REGULAR) & (np.abs(tau / usual - 1) < REGULAR)
    dt[regular] = tau[regular] = usual
    chunk = chunk.having(dt=dt, tau=tau)
    cuts = [0, *(np.flatnonzero(np.diff(regular)) + 1), len(chunk)]
    for start, stop in pairwise(cuts):
        yield chunk.part(int(start), int(stop))


def _rows(step: Transition, start: int, stop: int) -> Transition:
    """Return the steps from start to stop; what is the same for every step stays so."""
    F, Q = (a if a.ndim == 2 else a[start:stop] for a in (step.F, step.Q))
    C = step.C if step.C is None or step.C.ndim == 2 else step.C[start:stop]
    return Transition(F, Q, step.u if step.u.ndim == 1 else step.u[start:stop], C)


def _output(found: Estimates, block: slice, C: Array | None) -> tuple[Array, Array]:
    """Return the bias (N, d) and its standard deviation from the states of its block."""
    if C is None:
        return found.x[:, block], found.sigma[:, block]
    bias = np.einsum("...ij,...j->...i", C, found.x[:, block])
    if found.P is None:
        return bias, np.full_like(bias, np.nan)
    P = found.P[:, block, block]
    return bias, np.sqrt(
        np.einsum("...ij,kjl,...il->ki", C, P, C) if C.ndim == 2 else np.einsum("kij,kjl,kil->ki", C, P, C)
    )


def _stretches(flags: Flags) -> list[tuple[int, int]]:
    """Return start and stop of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
