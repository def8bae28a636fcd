"""The filter after its alignment: state, coasting prediction, memories, and the look-out for motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from driftlab.config import Config, Filter
from driftlab.filtering.coasting import Coast, Thermometer, Uncertainty
from driftlab.filtering.stretch import Journal, Stretch, runs
from driftlab.zupt.alignment import Alignment, align, at_rest
from driftlab.zupt.model import Zupt
from driftlab.zupt.rest_detector import RestDetector
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import FittedMap, Memory, Transition
from fusion_core.host.answers import finite
from fusion_core.kalman import Method, estimate
from fusion_core.model import Estimates, Flags, Measurement, State

FEW = 16  # epochs that are filtered by the recursion at once
SPAN = 16_384  # epochs filtered at once: what motion makes it do again is bounded by that
REMEMBERED = ("alignment", "aligned_at", "usual", "state", "coast", "memories", "refused", "fresh", "detector_memory")
REGULAR = 1e-3  # epochs whose duration is this near the usual one are taken to last just as long


@dataclass(frozen=True)
class Plan:
    """What a run does, the same from its first epoch to its last.

    Attributes
    ----------
    config, settings : Config, Filter
        As the user wrote them.
    model : Zupt
        The zero-velocity model of the settings.
    calibration, followed : FittedMap or None
        The map that is subtracted from the gyro first, and the one that the bias model follows.
    gate : float
        The nis beyond which an epoch is not used.
    initial_error : float
        Added to every axis of the gyro bias at the end of the alignment, rad/s; the filter is not told.
    keep_model : bool
        Whether the stretches keep the arrays that the filter was run on.
    """

    config: Config
    settings: Filter
    model: Zupt
    calibration: FittedMap | None
    followed: FittedMap | None
    gate: float
    initial_error: float
    keep_model: bool


class Tracker:
    """A run in progress, from its first alignment on."""

    def __init__(self, plan: Plan, journal: Journal, alignment: Alignment, state: State) -> None:
        self.plan, self.model, self.settings, self.journal = plan, plan.model, plan.settings, journal
        self.alignment = alignment
        self.aligned_at, self.usual = alignment.t, alignment.dt
        self.state = state  # before the first epoch
        self.coast: Coast | None = None  # from the end of the first alignment on
        self.memories: list[Memory] = [None] * len(plan.model.triads)
        self.refused: Chunk | None = None  # the epochs refused in a row, up to now
        self.fresh = True
        self.detector = RestDetector.of(plan.settings, alignment)
        self.detector_memory = self.detector.start()
        fitted = plan.calibration or plan.followed
        resolution = 0.0 if fitted is None else fitted.record.resolution
        self.thermometer = Thermometer(resolution, plan.settings.temperature_rate.memory_s)
        self.uncertainty = Uncertainty(fitted, plan.model.triads[-1].noise)
        journal.alignments.append(alignment)

    def snapshot(self) -> dict[str, Any]:
        """Return all that the tracker has learned so far; between two calls of `advance`."""
        return {name: getattr(self, name) for name in REMEMBERED} | {
            "thermometer": self.thermometer.memory,
            "lagged": self.uncertainty.lagged,
        }

    @classmethod
    def of(cls, plan: Plan, journal: Journal, snapshot: dict[str, Any]) -> Tracker:
        """Return the tracker that goes on from a snapshot."""
        tracker = cls(plan, journal, snapshot["alignment"], snapshot["state"])
        journal.alignments.pop()  # it is noted already
        for name in REMEMBERED:
            setattr(tracker, name, snapshot[name])
        tracker.thermometer.memory, tracker.uncertainty.lagged = snapshot["thermometer"], snapshot["lagged"]
        if tracker.coast is not None:
            tracker.uncertainty.departed(tracker.coast)
        return tracker

    def advance(self, chunk: Chunk) -> Iterator[Stretch]:
        """Yield the estimates of the next epochs."""
        for piece in regular_pieces(chunk, self.usual):
            at = int(np.searchsorted(piece.t, self.aligned_at, side="right"))
            if at > 0:
                yield from self._advance(piece.part(0, at))
            if at < len(piece):
                after = piece.part(at, len(piece))
                self._depart(after)
                yield from self._advance(after)

    def _depart(self, after: Chunk) -> None:
        """End the alignment: from here on the bias is also predicted with no further measurement."""
        if self.coast is not None:
            return
        block = self.model.blocks["gyro"]
        at = after if after.previous is None else after.previous
        T_0 = float(at["temperature"][-1]) if "temperature" in at.channels else np.nan
        self.coast = Coast(self.state.x[block], self.state.P[block, block], self.aligned_at, T_0)
        self.uncertainty.departed(self.coast)
        error = np.zeros(self.model.n)
        d = len(self.settings.gyro.bias.axes)
        error[block.start : block.start + d] = self.plan.initial_error
        self.state = State(self.state.x + error, self.state.P)

    def _advance(self, piece: Chunk) -> Iterator[Stretch]:
        before = self.memories
        steps, self.memories = self.model.bias_steps(piece, before)
        calibration = self._calibration(piece)
        corrected = piece.having(gyro=piece["gyro"] - calibration)
        start = 0
        while start < len(piece):
            stop = min(len(piece), start + SPAN)
            part = corrected.part(start, stop)
            transition = self.model.transition(part, [_rows(step, start, stop) for step in steps], self.alignment)
            rows, found = self._filter(part, transition, keep_P=steps[-1].C is not None)
            began, self.state = self.state if self.fresh else None, found.state
            done = piece.part(start, start + rows)
            step = _rows(steps[-1], start, start + rows)
            kept = None
            if self.plan.keep_model:
                kept = replace(_rows(transition, 0, rows), C=step.C), self.model.measurement(rows)
            still = self._note(done, found)
            yield self._stretch(done, found, step, calibration[start : start + rows], still, began, kept)
            start += rows
            if self._look_out(done, found.used):
                _, memories = self.model.bias_steps(piece.part(0, start), before)  # as of now, not of the piece's end
                self.state, self.fresh = self.model.prior_again(memories), True

    def _note(self, done: Chunk, found: Estimates) -> Flags:
        """Note where the unit moved, and where the filter refused it while it stood still; return where it did."""
        still, out, self.detector_memory = self.detector.look(done, self.detector_memory)
        self.journal.moving.note(done.t, ~still, out, [" ".join(axis) for axis in self.detector.axes])
        refused = still & ~found.used
        causes = np.zeros(found.white.shape, dtype=np.bool_)
        size = found.white[refused] ** 2
        causes[refused] = size >= np.max(size, axis=1, keepdims=True, initial=0.0) / 2
        self.journal.refused.note(done.t, refused, causes, self.model.components)
        return still

    def _filter(self, part: Chunk, transition: Transition, *, keep_P: bool) -> tuple[int, Estimates]:
        """Run the filter up to the end, or to where the unit may be at rest anew."""
        gate = self.plan.gate * self.alignment.gate_scale

        def over(stop: int) -> Estimates:
            some = _rows(transition, 0, stop)
            measurement = self.model.measurement(stop)
            # an epoch of a live source that lasts unlike the others would ask for a steady state of its own
            method: Method = "recursive" if stop <= FEW else "auto"
            reset = self.model.reset
            return finite(
                lambda: estimate(self.state, some, measurement, gate=gate, reset=reset, method=method, keep_P=keep_P),
                part.t,
                self.journal.faults.when,
            )

        found = over(len(part))
        for start, stop in runs(~found.used):
            since = self.refused.t[0] if start == 0 and self.refused is not None else part.t[start]
            long_enough = part.t[start:stop] - since >= self.settings.rest.realign_after
            if np.any(long_enough):
                end = start + int(np.argmax(long_enough)) + 1
                return end, found if end == len(part) else over(end)
        return len(part), found

    def _look_out(self, done: Chunk, used: Flags) -> bool:
        """Align anew where the unit has been still, at another bias or attitude, for long enough; return whether."""
        refused = runs(~used)
        if not refused or refused[-1][1] < len(done):
            self.refused = None
            return False
        tail = done.part(refused[-1][0], len(done))
        self.refused = tail if self.refused is None or len(tail) < len(done) else concatenate([self.refused, tail])
        if self.refused.t[-1] - self.refused.t[0] < self.settings.rest.realign_after:
            return False
        # the onset is no part of the rest
        still = self.refused.part(len(self.refused) // 4, len(self.refused))
        if not at_rest(still, self.settings):
            self.refused = self.refused.part(len(self.refused) // 2, len(self.refused))
            return False
        self.alignment = align(still, self.plan.config, self.settings)
        self.journal.alignments.append(self.alignment)
        self.refused = None
        return True

    def _calibration(self, piece: Chunk) -> Array:
        fitted = self.plan.calibration
        return np.zeros_like(piece["gyro"]) if fitted is None else fitted.bias(piece["temperature"], piece.t)

    def _stretch(
        self,
        done: Chunk,
        found: Estimates,
        step: Transition,
        calibration: Array,
        still: Flags,
        began: State | None,
        kept: tuple[Transition, Measurement] | None,
    ) -> Stretch:
        T = done.channels.get("temperature")
        error = None if T is None else self.thermometer.look(done)
        bias, variance = _output(found, self.model.blocks["gyro"], step.C)
        sigma = self.uncertainty.of_estimate(variance, done.dt, T, error, self.alignment.tilt)
        rate = done["gyro"] - self.alignment.omega_ie
        coast = coast_sigma = np.full_like(bias, np.nan)
        if self.coast is not None:
            coast, variance = self.coast.advance(len(done), step)
            coast_sigma = self.uncertainty.of_coast(
                variance, self.coast, done.t, T, error, self.journal.alignments[0].tilt
            )
        self.fresh = False
        return Stretch(
            done, rate, bias + calibration, sigma, coast + calibration, coast_sigma, calibration, still, found, began,
            kept,
        )  # fmt: skip


def regular_pieces(chunk: Chunk, usual: float) -> Iterator[Chunk]:
    """Cut a chunk where its epochs stop or start to last as usual; those that do get the very same duration."""
    dt, tau = np.full(len(chunk), chunk.dt), chunk["tau"].copy()
    regular = (np.abs(dt / usual - 1) < REGULAR) & (np.abs(tau / usual - 1) < REGULAR)
    dt[regular] = tau[regular] = usual
    chunk = chunk.having(dt=dt, tau=tau)
    if len(chunk) == 1:
        yield chunk
        return
    cuts = [0, *(np.flatnonzero(np.diff(regular)) + 1), len(chunk)]
    for start, stop in pairwise(cuts):
        yield chunk.part(int(start), int(stop))


def _rows(step: Transition, start: int, stop: int) -> Transition:
    """Return the steps from start to stop; what is the same for every step stays so."""
    F, Q = (a if a.ndim == 2 else a[start:stop] for a in (step.F, step.Q))
    C = step.C if step.C is None or step.C.ndim == 2 else step.C[start:stop]
    return Transition(F, Q, step.u if step.u.ndim == 1 else step.u[start:stop], C)


def _output(found: Estimates, block: slice, C: Array | None) -> tuple[Array, Array]:
    """Return the bias (N, d) and its variance from the states of its block."""
    if C is None:
        return found.x[:, block], found.sigma[:, block] ** 2
    assert found.P is not None, "the deviation of an output needs P"
    variance = np.einsum("...ij,...jl,...il->...i", C, found.P[:, block, block], C)
    return np.einsum("...ij,...j->...i", C, found.x[:, block]), variance
