"""One recording through one config: epochs in, estimates out, stretch by stretch."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np

from driftlab.config import Config, Filter
from driftlab.filtering.stretch import Journal, Stretch
from driftlab.filtering.tracker import Plan, Tracker
from driftlab.samples.epochs import epochs
from driftlab.samples.prefetch import ahead
from driftlab.samples.screening import RESERVED, read
from driftlab.samples.temperature_rate import RateMemory, with_rate
from driftlab.zupt.alignment import Alignment, align, at_rest, check_gravity
from driftlab.zupt.model import Zupt
from fusion_core.chunk import Chunk, concatenate
from fusion_core.consistency import gate_of
from fusion_core.contracts import BiasModel, FittedMap, ThermalBias
from fusion_core.errors import ConfigError, MapError, MissingChannel, NotAtRest, OutsideDomain
from fusion_core.settings import nearest

SI_OF_BIAS = {"gyro": "rad/s", "accel": "m/s^2"}


class Run:
    """A run in progress: iterate over it for stretches.

    Parameters
    ----------
    config : Config
        With a filter, and a source unless `over` is used.
    journal : Journal
        Where what happens on the way is noted.
    initial_error : float
        Added to every axis of the gyro bias at the end of the alignment, rad/s; the filter is not told.
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
        journal: Journal,
        *,
        initial_error: float = 0.0,
        keep_model: bool = False,
        resume: dict[str, Any] | None = None,
        settled: Callable[[Callable[[], dict[str, Any]]], None] | None = None,
    ) -> None:
        if config.filter is None:
            raise ConfigError("filter: is missing; begin the config with e.g. `extends: mems_crs05`")
        self.config, self.settings, self.journal = config, config.filter, journal
        self.resume, self.settled = resume, settled
        self.model = Zupt(self.settings)
        settings = self.settings.gyro.calibration
        calibration = settings.load() if settings else None
        followed = _followed(self.settings.gyro.bias)
        check_maps(self.settings, calibration)
        self.maps = [fitted for fitted in (calibration, followed) if fitted is not None]
        gate = gate_of(self.model.m, self.settings.rest.false_alarm)
        self.plan = Plan(config, self.settings, self.model, calibration, followed, gate, initial_error, keep_model)

    def __iter__(self) -> Generator[Stretch]:
        """Yield the stretches of the config's source; raises ConfigError where that is live."""
        if self.config.source is not None and self.config.source.live:
            raise ConfigError(
                f"source: kind {self.config.source.kind} is live; use `driftlab live`, or name a recording with --input"
            )
        stream = epochs(read(self.config, self.journal.faults), self.settings.update_interval)
        return self._read_ahead(stream)

    def _read_ahead(self, stream: Iterable[Chunk]) -> Generator[Stretch]:
        with closing(ahead(self._prepared(stream))) as prepared:
            yield from self._filtered(prepared)

    def over(self, stream: Iterable[Chunk]) -> Iterator[Stretch]:
        """Yield the stretches of a stream of epochs."""
        return self._filtered(self._prepared(stream))

    def _prepared(self, stream: Iterable[Chunk]) -> Iterator[Chunk]:
        """Yield the epochs, checked and with the rate of their temperature."""
        rate_memory: RateMemory | None = None
        known: dict[str, tuple[int, ...]] = {}
        for chunk in stream:
            if (found := {name: values.shape[1:] for name, values in chunk.channels.items()}) != known:
                check_channels(self.settings, chunk)
                known = found
            chunk, rate_memory = with_rate(chunk, self.settings.temperature_rate, rate_memory)
            self._note_beyond_maps(chunk)
            yield chunk

    def _filtered(self, stream: Iterable[Chunk]) -> Iterator[Stretch]:
        try:
            yield from self._tracked(stream)
        except OutsideDomain as error:
            raise error.at(self.journal.faults.when) from None

    def _tracked(self, stream: Iterable[Chunk]) -> Iterator[Stretch]:
        tracker = self._resumed()
        done = -np.inf if self.resume is None else self.resume["t"]
        waiting: list[Chunk] = []
        for chunk in stream:
            chunk = chunk.part(int(np.searchsorted(chunk.t, done, side="right")), len(chunk))
            if len(chunk) == 0:
                continue
            if tracker is None:
                waiting.append(chunk)
                if chunk.t[-1] - waiting[0].t[0] < self.settings.align * (1 - 1e-9):
                    continue  # joining them once, and not at every epoch of a live source
                chunk, alignment = self._first_rest(concatenate(waiting))
                waiting = [chunk]
                if alignment is None:
                    continue
                tracker = Tracker(self.plan, self.journal, alignment, self.model.prior_at(chunk))
            yield from tracker.advance(chunk)
            done = float(chunk.t[-1])
            if self.settled is not None:
                self.settled(partial(self._snapshot, tracker, done))
        if tracker is None:
            raise NotAtRest(self._never_at_rest(concatenate(waiting) if waiting else None))

    def _resumed(self) -> Tracker | None:
        if self.resume is None:
            return None
        self.journal.alignments[:] = self.resume["alignments"]
        self.journal.moving, self.journal.refused = self.resume["moving"], self.resume["refused"]
        return Tracker.of(self.plan, self.journal, self.resume["tracker"])

    def _snapshot(self, tracker: Tracker, t: float) -> dict[str, Any]:
        journal = self.journal
        return {
            "t": t,
            "tracker": tracker.snapshot(),
            "alignments": list(journal.alignments),
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
            if np.any(beyond):
                k = int(np.argmax(beyond))
                where = f"at {self.journal.faults.when(chunk.t[k])}, {T[k]:.2f} degC"
                how = "clamped to it" if fitted.outside == "clamp" else "where it goes straight on"
                what = f"updates beyond the {fitted.record.kind}'s domain ({low:.2f}, {high:.2f}) degC, {how}"
                self.journal.faults.add(what, int(np.sum(beyond)), where)

    def _first_rest(self, waiting: Chunk) -> tuple[Chunk, Alignment | None]:
        """Return the epochs from the first rest on, and its alignment once there is one."""
        t = waiting.t
        start = 0
        while (stop := int(np.searchsorted(t, t[start] + self.settings.align * (1 - 1e-9))) + 1) <= len(t):
            window = waiting.part(start, stop)
            measured = np.sum(window["tau"]) >= self.settings.align / 2  # a gap is no rest
            if measured and len(window) > 2 and at_rest(window, self.settings):
                if self.settings.accel is not None:
                    check_gravity(window, self.config)
                return waiting.part(start, len(t)), align(window, self.config, self.settings)
            start += max(1, (stop - start) // 4)
            if start >= len(t):
                break
        return waiting.part(min(start, len(t) - 1), len(t)), None

    def _never_at_rest(self, waiting: Chunk | None) -> str:
        align_s = self.settings.align
        have = 0.0 if waiting is None else float(waiting.t[-1] - waiting.t[0])
        name = self.config.source.name if self.config.source else "the recording"
        left_out = "".join(f"; {line}" for line in self.journal.faults.lines())
        left_out = left_out.replace(";", ",")  # in a message, what comes after a semicolon is what to do
        return (
            f"{name}: no {align_s:g} s at rest were found for the alignment (the last {have:.1f} s were still being "
            f"looked at{left_out}); use a longer recording, set filter.align lower, or check filter.gyro.noise and the "
            "units"
        )


def check_maps(settings: Filter, calibration: FittedMap | None) -> None:
    """Raise MapError where a map is of another channel, unit or number of axes than where the config has it.

    `calibration` is the gyro's, read already; the others are those that the bias models follow.
    """
    for channel, section in (("gyro", settings.gyro), ("accel", settings.accel)):
        if section is None:
            continue
        for fitted in (calibration if channel == "gyro" else None, _followed(section.bias)):
            if fitted is None:
                continue
            record, d = fitted.record, len(section.bias.axes)
            found = (record.channel, record.unit, len(record.residual))
            expected = (channel, SI_OF_BIAS[channel], d)
            if found != expected:
                raise MapError(
                    f"filter.{channel}: the map ({record.kind}) is of the channel {found[0]} in {found[1]} with "
                    f"{found[2]} axes, {expected[0]} in {expected[1]} with {expected[2]} was expected; "
                    "name a map that was fitted on this channel"
                )


def _followed(model: BiasModel) -> FittedMap | None:
    """Return the map that a bias model follows, if it follows one."""
    return model.fitted if isinstance(model, ThermalBias) else None


def needed_channels(settings: Filter) -> set[str]:
    """Return the names of the channels that a recording must have."""
    models = _bias_models(settings)
    needs = {name for channel, model in models.items() for name in (channel, *model.requires)}
    return (needs | ({"temperature"} if settings.gyro.calibration is not None else set())) - {"temperature_rate"}


def _bias_models(settings: Filter) -> dict[str, BiasModel]:
    return {"gyro": settings.gyro.bias, **({"accel": settings.accel.bias} if settings.accel else {})}


def check_channels(settings: Filter, chunk: Chunk) -> None:
    """Raise MissingChannel or ConfigError where the samples are not what the filter needs."""
    needed = needed_channels(settings)
    for name in sorted(needed - set(chunk.channels)):
        others = sorted(set(chunk.channels) - RESERVED)
        like = nearest(name, set(others) - needed)
        advice = ", or write `accel: null` under filter" if name == "accel" else f", as '{like}' is" if like else ""
        raise MissingChannel(
            f"channel '{name}' is needed by the filter and the recording has {', '.join(others) or 'none'}; "
            f"name it under source.channels{advice}"
        )
    for channel, model in _bias_models(settings).items():
        if chunk[channel].shape[1] != len(model.axes):
            raise ConfigError(
                f"{channel}: the recording has {chunk[channel].shape[1]} axes and the bias model {len(model.axes)}; "
                "name as many under bias.axes"
            )
