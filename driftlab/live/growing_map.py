"""A map that is fitted while its soak goes on: `driftlab live --fit-map`.

A second thread gathers the epochs at rest as `fit-map` does, in blocks (`driftlab.soak.blocks`), and fits them anew now
and then: the filter only hands the epochs over. A fit may take a hundredth of the time, so a sample seldom waits for
one. The status of the map is its standard deviation by now, its temperatures, and the ranges that are missing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from driftlab.config import Config
from driftlab.maps.assessment import memory_sentence
from driftlab.maps.fit import GatheredSoak, axes_of, fit_gathered, map_settings
from driftlab.maps.hysteresis.memory import MemoryVerdict
from driftlab.maps.kind_selection import TURN
from driftlab.planning.request import read_range
from driftlab.soak.blocks import GrowingSoak
from driftlab.soak.rest import Used, at_rest
from driftlab.soak.temperature import between_steps, soak_temperature
from driftlab.storage.map_file import check_place, save
from driftlab.units import RATE, BiasUnit, tracked_unit
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.errors import ConfigError, EmptyRecording, FusionError
from fusion_core.faults import Faults
from fusion_core.thermal.curve_uncertainty import HOLE
from fusion_core.thermal.sweeps import sweeps_of
from fusion_core.thermal.thermometer import steps_of
from fusion_core.units import to_si

MAX_BLOCKS = 4096
DRAIN = 0.5  # s between looks at what came
SHARE = 100  # times what a fit took is waited before the next
PAUSE = (1.0, 60.0)  # s, at least and at most
READINGS = 1 << 16  # that show the steps of the thermometer: twice as many at most, evenly over the soak


class GrowingMap:
    """The map of a soak that goes on, written to `path` at the end.

    `wanted` is the sigma to be reached in SI, over the temperatures `asked` (degC; None: those so far), after which the
    run is to end if `until_reached`. A second thread calls `publish` with the status, whenever there is a new one.
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
        publish: Callable[[GrowingMapStatus], None] = lambda status: None,
    ) -> None:
        self.config, self.settings, self.path, self.publish = config, settings, path, publish
        self.until_reached = until_reached
        model = config.filter
        self.status = GrowingMapStatus(settings.kind, asked=asked, wanted=wanted, unit=tracked_unit(model),
                                axes=model.tracked.axes if model else ("x", "y", "z"))  # fmt: skip
        self.faults = Faults()
        self.blocks, self.used = GrowingSoak(MAX_BLOCKS), Used()
        self._soak: GatheredSoak | None = None  # of the last fit
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
        save(fitted, self.path, "live")
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
        """Load the libraries of a fit, so that the time that one takes is known from the first one on."""
        T, d = np.linspace(0, 50, 300), len(self.status.axes)
        with suppress(FusionError):
            self.settings.fit(T, np.tile(T[:, None] * 1e-6, d), {})

    def _drained(self) -> Iterator[Chunk]:
        """Yield the epochs that came, joined, until there are no more."""
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
        """Publish the status, and fit where there are more samples than at the last fit and it is time."""
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
        blocks, n = self.blocks.rows(), self.blocks.n
        T, steps = soak_temperature(blocks.t, blocks.T, steps_of(self._readings), n)
        off = between_steps(blocks.t, T, blocks.T, steps) if steps.size else None
        interval = n * (self.config.filter.update_interval if self.config.filter else 1.0)
        domain = Used(low=self.used.low, high=self.used.high)
        name = self.config.source.name if self.config.source else ""
        soak = GatheredSoak(blocks.t, T, blocks.bias, [name], [0], interval, used=domain, steps=steps, off=off)
        fitted = fit_gathered(self.config, self.settings, soak, of_both_ways=True)
        update: dict[str, object] = {"samples": self.blocks.samples}
        if fitted.record.residual is not None:
            # of a thermometer with steps, what readings do within a block is rounding and not temperature
            within = self.blocks.within(fitted.slope(T) if steps.size == 0.0 else np.zeros_like(blocks.bias))
            update["residual"] = tuple(np.sqrt(np.square(fitted.record.residual) + within).tolist())
        self._soak = soak
        return fitted.noting(**update)

    def _publish(self, fitted: FittedMap) -> None:
        assert self._soak is not None, "the map was fitted on it"
        self.status = with_curve(self._with(why="", axes=axes_of(fitted), memory=self._soak.memory), fitted)
        self.publish(self.status)

    def _with(self, **changes: Any) -> GrowingMapStatus:
        """Return the status with changes and the samples so far, which is the status from then on."""
        blocks, soak = self.blocks, self._soak
        unused = {"unused": self.used.sentence(), "unused_share": self.used.share}
        self.status = replace(self.status, **{**unused, **changes})
        if blocks.samples:
            # readings with steps show no temperature between two levels; the last fit knows of those
            T = blocks.rows().T if soak is None or soak.steps.size == 0.0 else soak.T
            self.status = with_coverage(self.status, T, blocks.ends, blocks.samples)
        return self.status


def soaking(
    config: Config,
    path: Path,
    *,
    kind: str | None = None,
    sigma: str | None = None,
    span: str | None = None,
    until_reached: bool = False,
    read: Collection[Path] = (),
) -> GrowingMap:
    """Return the map of a `kind` that is fitted while a config's device is run, from a user's texts.

    `sigma` (`3 deg/h`) is to be reached over `span` (`-20..50 degC`); files that are `read` must not be replaced.

    Raises
    ------
    ConfigError, UnitError
        If a text cannot be read, one is missing, or the file cannot be written.
    """
    if until_reached and (sigma is None or span is None):
        raise ConfigError("--until-reached: has no target, a sigma over a range was expected; give --sigma and --range")
    settings = map_settings(config, kind)
    unit = tracked_unit(config.filter)
    wanted = None if sigma is None else to_si(sigma, unit.si)
    if wanted is not None and not wanted > 0:
        raise ConfigError(f"--sigma '{sigma}': is not above zero; write one like '3 {unit.shown}'")
    check_place(path, [*read, *config.files_to_fit()], "live")
    asked = None if span is None else read_range(span)
    if asked is not None and not asked[0] < asked[1]:
        raise ConfigError(f"--range {span}: is no range; write the lower temperature first")
    return GrowingMap(config, settings, path, wanted=wanted, asked=asked, until_reached=until_reached)


Range = tuple[float, float]

END = 0.01  # of the range: so near is as good as reached
GRID = 121  # temperatures of the curve


@dataclass(frozen=True, eq=False)
class GrowingMapStatus:
    """The status of a map while its soak goes on."""

    kind: str  # of the map
    samples: int = 0  # epochs at rest so far
    seen: Range = (np.nan, np.nan)  # smallest and largest temperature so far, degC
    asked: Range | None = None  # the range over which the map is wanted; None: that so far
    coverage: float = 0.0  # share of that range in which there are samples
    missing: tuple[Range, ...] = ()  # its parts that have none, degC
    sweeps: int = 1  # how often the temperature went up or down
    # (G,): temperatures of the curve, within the range and what was seen, degC; empty until there is one
    T: Array = field(default_factory=lambda: np.empty(0))
    bias: Array = field(default_factory=lambda: np.empty((0, 0)))  # (G, d), SI
    sigma: Array = field(default_factory=lambda: np.empty((0, 0)))  # (G, d): standard deviation of the curve, SI
    wanted: float | None = None  # the sigma to be reached, in SI
    reached: bool = False  # whether the whole range is covered and sigma is nowhere larger than wanted
    why: str = "no sample at rest so far"  # why there is no curve yet; empty where there is one
    # whether the bias remembers which temperatures came before; None until there is a curve
    memory: MemoryVerdict | None = None
    unused: str = ""  # how much of the soak is not used and why, in words, where it is much
    unused_share: float = 0.0  # that share
    axes: tuple[str, ...] = ()  # their names
    unit: BiasUnit = RATE  # in which a bias is shown

    @property
    def range(self) -> Range:
        """The temperatures over which sigma is looked at, degC."""
        return self.seen if self.asked is None else self.asked

    @property
    def rms(self) -> Array:
        """Rms of sigma (d,) over the range so far, in SI."""
        return np.asarray(np.sqrt(np.mean(self.sigma**2, axis=0)), dtype=np.float64)

    @property
    def worst(self) -> tuple[float, float, str]:
        """Largest sigma in SI, at which temperature, and of which axis; NaN where there is no curve."""
        if not self.sigma.size:
            return np.nan, np.nan, ""
        k, axis = np.unravel_index(int(np.argmax(self.sigma)), self.sigma.shape)
        return float(self.sigma[k, axis]), float(self.T[k]), self.axes[int(axis)]

    def lines(self) -> list[str]:
        """Return the status in sentences."""
        lines = [self.unused] if self.unused else []
        if not self.samples:
            return [*lines, self.why]
        low, high = self.range
        spans = [f"{start:.4g} to {stop:.4g}" for start, stop in self.missing]
        samples = f"{self.samples:,} epochs at rest, {self.seen[0]:.2f} to {self.seen[1]:.2f} °C"
        lines.append(samples if self.asked is None else f"{samples}; {self.coverage:.0%} of {low:g} to {high:g} °C")
        if spans:
            lines.append(f"not yet seen: {', '.join(spans)} °C")
        if self.why:
            return [*lines, self.why]
        sigma, at, axis = self.worst
        rms = ", ".join(map(self._number, self.rms))
        where = f"at {at:.1f} °C" + (f" ({axis})" if len(self.axes) > 1 else "")
        lines.append(f"sigma {rms} {self.unit.shown} rms, {self._number(sigma)} {where}")
        if self.memory is not None:
            lines.append(memory_sentence(self.memory, self.axes, self.unit))
        return [*lines, self.sentence()] if self.reached else lines

    def sentence(self) -> str:
        """Return the sentence that sigma is reached."""
        low, high = self.range
        end = "the chamber may stop" if self.asked is not None else "all that was seen so far"
        once = "; passed once: what differs on the way back is not in it" if self.sweeps < 2 else ""
        return (
            f"reached: {self._number(self.worst[0])} {self.unit.shown} between {low:.4g} and {high:.4g} °C, {end}{once}"
        )

    def as_json(self) -> dict[str, Any]:
        """Return the status for programs; biases in SI, temperatures in degC."""
        sigma, at, axis = self.worst
        key, known = self.unit.key, bool(self.sigma.size)
        curve: Mapping[str, Any] = {"temperature_degC": self.T, key("bias"): self.bias, key("sigma"): self.sigma}
        return {
            "kind": self.kind,
            "samples": self.samples,
            "unused": self.unused_share,
            "seen_degC": self.seen if self.samples else None,
            "range_degC": self.asked,
            "coverage": self.coverage,
            "missing_degC": self.missing,
            "sweeps": self.sweeps,
            key("sigma_rms"): self.rms if known else None,
            key("sigma_worst"): sigma if known else None,
            "worst_at_degC": at if known else None,
            "worst_axis": axis or None,
            key("sigma_wanted"): self.wanted,
            "reached": self.reached,
            "why": self.why,
            "memory": None if self.memory is None else self.memory.as_json(),
            "curve": curve if known else None,
        }

    def _number(self, value: float) -> str:
        return f"{value * self.unit.factor:.2g}"


def with_coverage(status: GrowingMapStatus, T: Array, seen: Range, samples: int) -> GrowingMapStatus:
    """Return the status with the coverage so far: T (K,) of blocks, the whole range, and the number of samples."""
    low, high = seen if status.asked is None else status.asked
    width = high - low
    ends, slack = np.unique(T[(low <= T) & (high >= T)]), END * width
    missing: list[Range] = []
    if not len(ends):
        missing = [(low, high)] if width else []
    else:
        gaps = np.flatnonzero(np.diff(ends) > HOLE * width)
        missing += [(low, float(ends[0]))] if ends[0] > low + slack else []
        missing += [(float(ends[k]), float(ends[k + 1])) for k in gaps]
        missing += [(float(ends[-1]), high)] if ends[-1] < high - slack else []
    share = 1 - sum(stop - start for start, stop in missing) / width if width else float(samples > 0)
    sweeps = int(sweeps_of(T, TURN * float(np.ptp(T)))[-1]) + 1
    return replace(status, samples=samples, seen=seen, coverage=share, missing=tuple(missing), sweeps=sweeps)


def with_curve(status: GrowingMapStatus, fitted: FittedMap) -> GrowingMapStatus:
    """Return the status with the curve of a map, over the covered part of the range, and whether sigma is reached."""
    low, high = max(status.range[0], status.seen[0]), min(status.range[1], status.seen[1])
    if low > high:
        empty = np.empty((0, fitted.record.d))
        return replace(status, T=np.empty(0), bias=empty, sigma=empty, reached=False)
    T = np.linspace(low, high, GRID)
    sigma = fitted.sigma(T)
    reached = status.wanted is not None and not status.missing and bool(np.max(sigma) <= status.wanted)
    return replace(status, T=T, bias=fitted.bias(T), sigma=sigma, reached=reached)
