"""A map that is fitted while its soak goes on: `driftlab live --fit-map`.

A second thread gathers the epochs at rest as `fit-map` does, in blocks (`driftlab.maps.blocks`), and fits them anew now
and then: the filter only hands the epochs over. A fit may take a hundredth of the time, so a sample seldom waits for
one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from driftlab.config import Config
from driftlab.files.map_file import check_place, save
from driftlab.maps.blocks import GrowingBlocks
from driftlab.maps.fit import Gathered, axes_of, fit_gathered, map_settings
from driftlab.maps.growing import MapStatus, Range, covered, looked_at
from driftlab.maps.hysteresis.memory import memory_of
from driftlab.maps.rest import Used, at_rest
from driftlab.maps.soak_temperature import soak_temperature
from driftlab.planning.asked import read_range
from driftlab.units import tracked_unit
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.contracts.thermometer import steps_of
from fusion_core.errors import ConfigError, EmptyRecording, FusionError
from fusion_core.faults import Faults
from fusion_core.units import to_si

MOST = 4096  # blocks
DRAIN = 0.5  # s between looks at what came
SHARE = 100  # times what a fit took is waited before the next
PAUSE = (1.0, 60.0)  # s, at least and at most
READINGS = 1 << 16  # that show the steps of the thermometer: twice as many at most, evenly over the soak


class Soaking:
    """The map of a soak that goes on.

    Parameters
    ----------
    config : Config
        Of the run.
    settings : ThermalMap
        The map to fit.
    path : Path
        Where it is written at the end.
    wanted : float or None
        The sigma to be reached, in SI.
    asked : pair of float or None
        Over which temperatures, degC; None: what was seen.
    until_reached : bool
        Whether the run is to end when it is.
    publish : callable
        Called by the second thread with what is known of the map, whenever that is more.
    """

    def __init__(
        self,
        config: Config,
        settings: ThermalMap,
        path: Path,
        *,
        wanted: float | None = None,
        asked: Range | None = None,
        until_reached: bool = False,
        publish: Callable[[MapStatus], None] = lambda status: None,
    ) -> None:
        self.config, self.settings, self.path, self.publish = config, settings, path, publish
        self.until_reached = until_reached
        model = config.filter
        self.status = MapStatus(settings.kind, asked=asked, wanted=wanted, unit=tracked_unit(model),
                                axes=model.tracked.axes if model else ("x", "y", "z"))  # fmt: skip
        self.faults = Faults()
        self.blocks, self.used = GrowingBlocks(MOST), Used()
        self.fitted: FittedMap | None = None
        self._found: Gathered | None = None  # of the last fit
        self._readings, self._each = np.empty(0), 1  # every how many-th temperature
        self._came: SimpleQueue[Chunk | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._failed: Exception | None = None
        self._next, self._of = 0.0, 0  # when the next fit may be, and of how many samples the last one was
        self._ended = False  # nothing comes any more: the next fit is the last, by `finish`

    def through(self, stream: Iterable[Chunk]) -> Iterator[Chunk]:
        """Pass epochs on, and gather them."""
        self._thread = threading.Thread(target=self._work, name="map", daemon=True)
        self._thread.start()
        try:
            for chunk in stream:
                if self._failed is None:  # else nobody takes it any more
                    self._came.put(chunk)
                yield chunk
        finally:
            self._ended = True
            self._came.put(None)

    def finish(self) -> FittedMap:
        """Fit all that was gathered, write the map and return it.

        Raises
        ------
        DataError
            If nothing was at rest, or it cannot be fitted.
        """
        if self._thread is not None:
            self._thread.join()
        if self._failed is not None:
            raise self._failed
        if not self.blocks.samples:
            raise EmptyRecording(f"map {self.path}: nothing was at rest for as long as an alignment; no map is written")
        fitted = self._fit()
        self._publish(fitted)
        save(fitted, self.path)
        return fitted

    def _work(self) -> None:
        try:
            self._warm_up()
            for t, T, bias, _, placement, window in at_rest(self.config, self._drained(), self.faults, self.used):
                if placement > 0:  # whose level nobody knows before the end
                    when = f"at {self.faults.when(t)}; fit-map on the recording takes all placements"
                    self.faults.add("epochs after the unit was turned over, left out of the map", len(T), when)
                    continue
                self._add(window.t, T, bias)
                self._look()
        except Exception as error:  # the filter goes on; `finish` raises it
            self._failed = error
            self.publish(self._with(why=str(error)))

    def _warm_up(self) -> None:
        """Load what the first fit has to, so that what a fit takes is known from the first one on."""
        T, d = np.linspace(0, 50, 300), len(self.status.axes)
        with suppress(FusionError):
            self.settings.fit(T, np.tile(T[:, None] * 1e-6, d), {})

    def _drained(self) -> Iterator[Chunk]:
        """Yield what came, joined, until there is no more."""
        while True:
            try:
                first = self._came.get(timeout=DRAIN)
            except Empty:
                self._look()
                continue
            if first is None:
                return
            time.sleep(DRAIN)
            waiting, ended = [first], False
            while not self._came.empty() and not ended:
                chunk = self._came.get()
                ended = chunk is None
                waiting += [] if chunk is None else [chunk]
            yield concatenate(waiting)
            if ended:
                return

    def _add(self, t: Array, T: Array, bias: Array) -> None:
        self._readings = np.append(self._readings, T[-self.blocks.samples % self._each :: self._each])
        self.blocks.add(t, T, bias)
        while len(self._readings) > 2 * READINGS:
            self._readings, self._each = self._readings[::2], 2 * self._each

    def _look(self) -> None:
        """Say what was gathered, and fit it where there is more than at the last fit and it is time."""
        if self._ended or self.blocks.samples == self._of:
            return
        if time.monotonic() < self._next:
            self.publish(self._with())
            return
        begun = time.thread_time()
        self._of = self.blocks.samples
        try:
            self._publish(self._fit())
        except FusionError as error:
            self.publish(self._with(why=str(error)))
        self._next = time.monotonic() + float(np.clip(SHARE * (time.thread_time() - begun), *PAUSE))

    def _fit(self) -> FittedMap:
        """Fit the blocks as `fit-map` fits samples; the record is that of the samples."""
        blocks = self.blocks.blocks()
        T, steps = soak_temperature(blocks.t, blocks.T, steps_of(self._readings), blocks.n)
        interval = blocks.n * (self.config.filter.update_interval if self.config.filter else 1.0)
        domain = Used(low=self.used.low, high=self.used.high)
        found = Gathered(T, blocks.bias, [self._name], [0], interval, used=domain, steps=steps)
        fitted = fit_gathered(self.config, self.settings, found)
        update: dict[str, object] = {"samples": self.blocks.samples}
        if fitted.record.residual is not None:
            # of a thermometer with steps, what readings do within a block is rounding and not temperature
            within = blocks.within(fitted.slope(T) if steps.size == 0.0 else np.zeros_like(blocks.bias))
            update["residual"] = tuple(np.sqrt(np.square(fitted.record.residual) + within).tolist())
        self._found = found
        return replace(fitted, record=fitted.record.model_copy(update=update))

    @property
    def _name(self) -> str:
        return self.config.source.name if self.config.source else ""

    def _publish(self, fitted: FittedMap) -> None:
        assert self._found is not None, "the map was fitted on them"
        self.fitted, memory = fitted, memory_of(self._found.brief())
        self.status = looked_at(self._with(why="", axes=axes_of(fitted), memory=memory), fitted)
        self.publish(self.status)

    def _with(self, **changes: Any) -> MapStatus:
        """Return the status with what was gathered so far, kept."""
        blocks = self.blocks
        unused = {"unused": self.used.sentence(), "unused_share": self.used.share}
        known = replace(self.status, **{**unused, **changes})
        if blocks.samples:
            found = self._found
            # readings with steps show no temperature between two levels; the last fit knows of those
            T = blocks.blocks().T if found is None or found.steps.size == 0.0 else found.T
            known = covered(known, T, blocks.seen, blocks.samples)
        self.status = known
        return known


def soaking(
    config: Config,
    path: Path,
    *,
    kind: str | None = None,
    sigma: str | None = None,
    span: str | None = None,
    until_reached: bool = False,
    read: Collection[Path] = (),
) -> Soaking:
    """Return the map that is to be fitted while a config's device is run, from what a user wrote.

    Parameters
    ----------
    config : Config
        Of the run.
    path : Path
        The map's file.
    kind : str, optional
        Of the map, in place of the config's.
    sigma : str, optional
        What is to be reached, `3 deg/h`.
    span : str, optional
        Over which temperatures, `-20..50 degC`.
    until_reached : bool
        Whether the run is to end then.
    read : collection of Path
        Files that the map must not replace.

    Raises
    ------
    ConfigError, UnitError
        If a text cannot be read, one is missing, or the file cannot be written.
    """
    if until_reached and (sigma is None or span is None):
        raise ConfigError("--until-reached: what is to be reached is not said; give --sigma and --range")
    settings = map_settings(config, kind)
    unit = tracked_unit(config.filter)
    wanted = None if sigma is None else to_si(sigma, unit.si)
    if wanted is not None and not wanted > 0:
        raise ConfigError(f"--sigma '{sigma}': is not above zero; write one like '3 {unit.shown}'")
    check_place(path, [*read, *config.files_to_fit()])
    asked = None if span is None else read_range(span)
    if asked is not None and not asked[0] < asked[1]:
        raise ConfigError(f"--range {span}: is no range; write the lower temperature first")
    return Soaking(config, settings, path, wanted=wanted, asked=asked, until_reached=until_reached)
