"""Tracker: the filter after its alignment, its state and memories, and the run of epochs through it.

Its estimates are checked to be finite. A rest at another bias or attitude, where the filter begins anew, is looked for
in what it refuses. What else is said of the epochs feeds nothing back to it, and is made after it, of what it yields:
motion, the prediction and the deviations (`Segments`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from driftlab.filtering.coasting import Prediction
from driftlab.filtering.segment import RunLog, RunSegment, runs
from driftlab.filtering.setup import RunSetup, bias_steps, prior_again, subtracted
from driftlab.units import axis_name
from fusion_core.checks import FEW, NotFinite, TooWide, all_finite
from fusion_core.chunk import Array, Chunk, Flags, concatenate, extremes, locked
from fusion_core.contracts import Alignment, Measurement, Memory, State, Transition
from fusion_core.errors import BadValue
from fusion_core.kalman import estimate
from fusion_core.model import Estimates


def check_finite(estimates: Estimates, t: Array, when: Callable[[float], str]) -> None:
    """Raise BadValue where the estimates at t (N,) in s are not finite numbers; `when` words a time."""
    x, sigma = estimates.x, estimates.sigma
    if x.size < FEW and isfinite(np.vdot(x, sigma)):
        return  # nearly always, of few
    if all_finite(x) and all_finite(sigma if sigma.strides[0] else sigma[:1]):  # one row that stands for all
        return
    good = np.all(np.isfinite(x) & np.isfinite(sigma), axis=1)
    raise not_finite(t[int(np.argmin(good))], when)


def not_finite(t: float, when: Callable[[float], str]) -> BadValue:
    """Return the error of an estimate that is not a finite number at t, s."""
    return BadValue(
        f"filter: the estimate is not a finite number at {when(t)}; check noise, walk and sigma_0 in "
        "the config, and the samples there"
    )


SPAN = 32_768  # epochs filtered at once: what motion makes it do again is bounded by that
NOTHING = locked(np.zeros(1))
REGULAR = 1e-3  # epochs whose duration is this near the usual one are taken to last just as long


Departure = tuple[State, float]
"""The end of the alignment, from which on the bias is predicted: state and temperature in degC, NaN of none."""


class Filtered(NamedTuple):
    """Epochs with their estimates."""

    epochs: Chunk
    calibration: Array  # (N, d) of the tracked sensor
    estimates: Estimates
    step: Transition  # of the tracked sensor's block
    alignment: Alignment
    departure: Departure | None  # that comes before them
    began: State | None
    equations: tuple[Transition, Measurement] | None


class _Piece(NamedTuple):
    """Epochs that last alike: as measured, what calibrations subtract, the steps of the bias blocks."""

    epochs: Chunk
    corrected: Chunk
    calibration: Array  # (N, d) of the tracked sensor
    steps: list[Transition]
    before: list[Memory]  # of the bias models

    def rows(self, start: int, stop: int) -> tuple[Chunk, list[Transition]]:
        """Return the epochs and steps from start to stop."""
        if start == 0 and stop >= len(self.epochs):
            return self.corrected, self.steps
        return self.corrected.part(start, stop), [step.part(slice(start, stop)) for step in self.steps]


class Tracker:
    """A run in progress, from its first alignment on.

    Parameters
    ----------
    plan : RunSetup
    journal : RunLog
        With the alignments so far.
    alignment : Alignment
        The last of them.
    state : State
        Before the first epoch.
    """

    def __init__(self, plan: RunSetup, journal: RunLog, alignment: Alignment, state: State) -> None:
        self.plan, self.model, self.journal = plan, plan.model, journal
        self.alignment = alignment
        self.first = journal.alignments[0]
        self.state = state
        self.fresh = True  # whether it is a prior
        self.memories: list[Memory] = [None] * len(plan.model.sensors)
        self.tracked = [sensor.channel for sensor in plan.model.sensors].index(plan.model.tracked.channel)
        self.realigning = Realigning(plan)
        self.aligning = True  # up to the end of the first alignment
        self.departure: Departure | None = None  # of the next epochs

    def snapshot(self) -> dict[str, Any]:
        """Return the tracker's state; between two calls of `advance`."""
        return {
            "alignment": self.alignment,
            "state": self.state,
            "fresh": self.fresh,
            "memories": self.memories,
            "refused": self.realigning.refused,
            "aligning": self.aligning,
        }

    @classmethod
    def of(cls, plan: RunSetup, journal: RunLog, snapshot: dict[str, Any]) -> Tracker:
        """Return the tracker that goes on from a snapshot; the journal knows the alignments already."""
        tracker = cls(plan, journal, snapshot["alignment"], snapshot["state"])
        tracker.fresh, tracker.memories = snapshot["fresh"], snapshot["memories"]
        tracker.realigning.refused, tracker.aligning = snapshot["refused"], snapshot["aligning"]
        return tracker

    def advance(self, chunk: Chunk) -> Iterator[Filtered]:
        """Yield the estimates of the next epochs."""
        for piece in self._pieces(chunk):
            start = 0
            while start < len(piece.epochs):
                part, steps = piece.rows(start, start + SPAN)
                transition, measurement = self.model.equations(part, steps, self.alignment)
                began = self.state if self.fresh else None
                estimates = self._filter(part, transition, measurement, keep_P=steps[self.tracked].C is not None)
                N = len(estimates.x)
                own = steps[self.tracked] if len(part) == N else steps[self.tracked].part(slice(N))
                equations = None
                if self.plan.keep_model:
                    equations = replace(transition.part(slice(N)), C=own.C), measurement.part(slice(N))
                done = piece.epochs.part(start, start + N)
                self.state, self.fresh = estimates.state, False
                calibration = piece.calibration[start : start + N]
                departure, self.departure = self.departure, None
                yield Filtered(done, calibration, estimates, own, self.alignment, departure, began, equations)
                start += N
                self._align_anew(done, estimates, piece, start)

    def _pieces(self, chunk: Chunk) -> Iterator[_Piece]:
        """Yield epochs that last alike, up to the end of the alignment and from there on, and their steps."""
        for regular in regular_pieces(chunk, self.first.dt):
            at = int(np.searchsorted(regular.t, self.first.t, side="right")) if self.aligning else 0
            for epochs in (regular.part(*ends) for ends in ((0, at), (at, len(regular))) if ends[0] < ends[1]):
                if self.aligning and epochs.t[0] > self.first.t:
                    self._depart(epochs)
                before = self.memories
                steps, self.memories = bias_steps(self.model, epochs, before)
                less = subtracted(epochs, self.plan.calibrations, self.plan.followed)
                parts = {channel: locked(epochs[channel] - part) for channel, part in less.items()}
                corrected = epochs.having(**parts) if parts else epochs
                tracked = self.model.tracked
                # of no calibration a row of zeros that stands for all
                none = np.ndarray((len(epochs), len(tracked.axes)), np.float64, NOTHING, strides=(0, 0))
                yield _Piece(epochs, corrected, less.get(tracked.channel, none), steps, before)

    def _filter(self, part: Chunk, transition: Transition, measurement: Measurement, *, keep_P: bool) -> Estimates:
        """Run the filter up to the end, or to where the unit may be at rest anew."""
        gate = self.plan.gate * self.alignment.gate_scale
        N = len(part)
        steps, measured = transition, measurement
        while True:
            try:
                estimates = estimate(self.state, steps, measured, gate=gate, reset=self.model.restarting, keep_P=keep_P)
            except (NotFinite, TooWide) as lost:
                raise not_finite(part.t[lost.sample], self.journal.faults.when) from None
            except np.linalg.LinAlgError:
                raise not_finite(part.t[0], self.journal.faults.when) from None
            check_finite(estimates, part.t, self.journal.faults.when)
            due = self.realigning.due(part.part(0, N), estimates.used)
            if due == N:
                return estimates
            N, steps, measured = due, transition.part(slice(due)), measurement.part(slice(due))

    def _align_anew(self, done: Chunk, estimates: Estimates, piece: _Piece, stop: int) -> None:
        """Begin with another alignment and a prior where the unit has come to rest anew."""
        alignment = self.realigning.look(done, estimates.used, self.alignment)
        if alignment is None:
            return
        self.alignment = alignment
        self.journal.alignments.append(alignment)
        _, memories = bias_steps(self.model, piece.epochs.part(0, stop), piece.before)  # as of now
        self.state, self.fresh = prior_again(self.model, memories, alignment), True

    def _depart(self, after: Chunk) -> None:
        """End the alignment with the epochs that come after it; from here on the filter has the plan's error."""
        at = after if after.previous is None else after.previous
        T = float(at["temperature"][-1]) if "temperature" in at.channels else np.nan
        self.departure, self.aligning = (self.state, T), False
        error, tracked = np.zeros(len(self.state.x)), self.model.tracked
        start = self.model.places[tracked.channel].start
        error[start : start + len(tracked.axes)] = self.plan.initial_error
        self.state = State(self.state.x + error, self.state.P)


class Segments:
    """Motion, bias and prediction of filtered epochs, with all parts of their deviations."""

    def __init__(self, plan: RunSetup, journal: RunLog) -> None:
        self.model = plan.model
        self.watch, self.prediction = RestMonitor(plan, journal), Prediction(plan, journal.alignments[0])

    def snapshot(self) -> dict[str, Any]:
        """Return the state so far."""
        return {"watch": self.watch.memory, "prediction": self.prediction.snapshot()}

    @classmethod
    def of(cls, plan: RunSetup, journal: RunLog, snapshot: dict[str, Any]) -> Segments:
        """Return those that go on from a snapshot; the journal knows the alignments already."""
        segments = cls(plan, journal)
        segments.watch.memory = snapshot["watch"]
        segments.prediction.restore(snapshot["prediction"])
        return segments

    def segment(self, filtered: Filtered) -> RunSegment:
        """Return the segment of the next epochs."""
        done, alignment = filtered.epochs, filtered.alignment
        still = self.watch.look(done, filtered.estimates)
        if filtered.departure is not None:
            self.prediction.depart(*filtered.departure)
        output = self.prediction.look(done, filtered.estimates, filtered.step, alignment.unsure, filtered.calibration)
        rate = done[self.model.tracked.channel] - self.model.known(done, alignment)
        kept = filtered.estimates, filtered.began, filtered.equations
        return RunSegment(done, rate, *output, filtered.calibration, still, *kept)


def regular_pieces(chunk: Chunk, usual: float) -> Iterator[Chunk]:
    """Cut a chunk where its epochs stop or start to last as usual; those that do get the very same duration."""
    dt, tau = chunk.dt, chunk["tau"]
    ends = *extremes(dt.reshape(-1)), *extremes(tau)
    if all(abs(end / usual - 1) < REGULAR for end in ends):  # nearly always
        lasting = locked(np.full(len(tau), usual))
        yield chunk.having(dt=lasting, tau=lasting)
        return
    regular = (np.abs(dt / usual - 1) < REGULAR) & (np.abs(tau / usual - 1) < REGULAR)
    chunk = chunk.having(dt=np.where(regular, usual, dt), tau=np.where(regular, usual, tau))
    cuts = [0, *(np.flatnonzero(np.diff(regular)) + 1), len(chunk)]
    for start, stop in pairwise(cuts):
        yield chunk.part(int(start), int(stop))


class RestMonitor:
    """Notes where the unit moved, and where the filter refused it while it stood still."""

    def __init__(self, plan: RunSetup, journal: RunLog) -> None:
        self.journal = journal
        self.detector = plan.model.detector(journal.alignments[0])
        self.memory: Any = self.detector.start()
        self.axes = [" ".join(axis) for axis in self.detector.axes]
        self.components = [axis_name(channel, axis) for channel, axis, _ in plan.model.components]

    def look(self, done: Chunk, estimates: Estimates) -> Flags:
        """Return the epochs at which the unit stood still (N,)."""
        still, out, self.memory = self.detector.look(done, self.memory)
        self.journal.moving.note(done.t, ~still, out, self.axes)
        refused = still & ~estimates.used
        causes = np.zeros(estimates.white.shape, dtype=np.bool_)
        if np.count_nonzero(refused):
            size = estimates.white[refused] ** 2
            causes[refused] = size >= np.max(size, axis=1, keepdims=True, initial=0.0) / 2
        self.journal.refused.note(done.t, refused, causes, self.components)
        return still


class Realigning:
    """Finds the rest, at another bias or attitude, in what is refused for long enough."""

    def __init__(self, plan: RunSetup) -> None:
        self.plan, self.patience = plan, plan.model.patience.realign_after
        self.refused: Chunk | None = None  # the epochs refused in a row, up to now

    def due(self, part: Chunk, used: Flags) -> int:
        """Return up to which epoch to go: the first by which enough are refused in a row, or all."""
        for start, stop in runs(~used):
            since = self.refused.t[0] if start == 0 and self.refused is not None else part.t[start]
            long_enough = part.t[start:stop] - since >= self.patience
            if np.any(long_enough):
                return start + int(np.argmax(long_enough)) + 1
        return len(part)

    def look(self, done: Chunk, used: Flags, before: Alignment) -> Alignment | None:
        """Return the new alignment where the unit has been still, at another bias or attitude, for long enough."""
        if used[-1]:  # nearly always
            self.refused = None
            return None
        refused = runs(~used)
        tail = done.part(refused[-1][0], len(done))
        self.refused = tail if self.refused is None or len(tail) < len(done) else concatenate([self.refused, tail])
        if self.refused.t[-1] - self.refused.t[0] < self.patience:
            return None
        # the onset is no part of the rest
        still = self.refused.part(len(self.refused) // 4, len(self.refused))
        if not self.plan.model.still(still):
            self.refused = self.refused.part(len(self.refused) // 2, len(self.refused))
            return None
        self.refused = None
        return self.plan.aligned_again(still, before)
