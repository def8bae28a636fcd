"""Fitting a thermal map on recordings at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from driftlab import __version__
from driftlab.config import Config, with_recording
from driftlab.filtering.setup import ENOUGH, shown_by_soak, too_few_updates
from driftlab.maps.hysteresis.memory import MemoryVerdict, memory_of
from driftlab.maps.residual import residual_of
from driftlab.recordings.epochs import epochs
from driftlab.recordings.overlap import Contents
from driftlab.recordings.screening import read
from driftlab.soak.agreement import contradictions
from driftlab.soak.blocks import SoakRows, SoakSummary, brief, means
from driftlab.soak.placements import Placements, placed
from driftlab.soak.rest import RestStretch, Used, at_rest
from driftlab.soak.temperature import between_steps, of_thermometer, soak_temperatures, without_noise
from driftlab.soak.wander import Wander, fitted_jointly, wander_of
from driftlab.units import BiasUnit, duration
from fusion_core.chunk import Array, Chunk, Integers
from fusion_core.contracts import FittedMap, Sensor, ThermalMap, TriadMatrix
from fusion_core.errors import ConfigError, EmptyRecording, SingularFit, SwingTooSmall
from fusion_core.faults import Faults
from fusion_core.host.provenance import participants
from fusion_core.host.registry import registry
from fusion_core.settings import did_you_mean
from fusion_core.thermal.penalised import penalised, smooth_lines
from fusion_core.thermal.thermometer import NO_STEPS, Steps

Progress = Callable[[float, int], None]

USUAL = "spline"  # kind of a map where neither the config nor the user names one: it bends where the sensor does
ROW = 10.0  # s, of a row of a soak
MAX_ROWS = 8640  # of a recording: of one that lasts longer than a day, they are longer
LEFT_OUT = ("temperature", "tau", "dt")  # of the channels: the rows have them already, or need them no more
GRID = 400  # temperatures between which a smooth curve is straight
LITTLE = 1.0  # K: a soak that moves by less has no ways
MOST = 0.5  # of a soak that is not used: that is then the error
NOTHING = Chunk(np.zeros(0))  # in the place of a window that is not kept


def usual_settings(config: Config, faults: Faults) -> ThermalMap:
    """Return the map that the config names, or the usual one, which is then noted."""
    if config.tracked_maps():
        return map_settings(config, None)
    faults.note(f"kind of map: {USUAL}, since the config names none; --compare tells which kind predicts best")
    return map_settings(config, USUAL)


def map_settings(config: Config, kind: str | None) -> ThermalMap:
    """Return the map that the config names, or one of `kind` with its default settings.

    Raises
    ------
    ConfigError
        If there is none.
    """
    named = config.tracked_maps()
    for settings in named:
        if kind in (None, settings.kind):
            return settings
    classes = registry().classes(ThermalMap)
    if kind is None:
        section = config.filter.tracked.section if config.filter else "filter.gyro"
        known = ", ".join(classes)
        raise ConfigError(f"no thermal map is named in the config; add one under {section}, or give --kind ({known})")
    if kind not in classes:
        raise ConfigError(f"--kind {kind}: " + did_you_mean(kind, classes, f"known: {', '.join(classes)}"))
    return classes[kind].model_validate({"kind": kind})  # type: ignore[return-value]


def fit_map(config: Config, recordings: Sequence[str], kind: str | None, faults: Faults) -> FittedMap:
    """Fit a thermal map on one or more recordings (`PATH` or `PATH::START:STOP`) at rest, Earth rate removed.

    Raises
    ------
    DataError
        If a recording cannot be used, or its temperature moves too little.
    """
    return fit_gathered(config, map_settings(config, kind), gather(config, recordings, faults))


def fit_gathered(
    config: Config, settings: ThermalMap, soak: GatheredSoak, more: Mapping[str, str] | None = None, *,
    of_both_ways: bool = False,
) -> FittedMap:  # fmt: skip
    """Fit a thermal map on samples; its provenance has `more` too.

    A curve `of_both_ways` is the mean of warming and cooling at each temperature where these are seen to differ.
    """
    about = {**soak.about, **provenance(settings, soak.names), **(more or {})}
    bias = soak.of_both_ways if of_both_ways else soak.bias
    try:
        fitted = fitted_jointly(settings, _to_fit(soak), bias, about, soak.wander(bias))
    except (SingularFit, SwingTooSmall) as error:
        raise type(error)(_likelier(error, soak)) from None
    if bias is not soak.bias:
        fitted = _with_spread(fitted, soak.memory)
    if soak.used.low < soak.used.high:
        fitted = settings.over(fitted, (soak.used.low, soak.used.high))
    if soak.placements is not None:
        fitted = soak.placements.widened(fitted, settings.smoother(soak.T, bias))
    residual = residual_of(fitted, settings, soak.T, soak.bias, soak.starts, soak.interval)
    fitted = fitted.noting(**residual.as_record(soak.interval * len(soak.T)))
    return of_sensor(config, of_thermometer(fitted, soak.steps, soak.T, soak.off, soak.interval))


def _with_spread(fitted: FittedMap, memory: MemoryVerdict) -> FittedMap:
    """Return the map with what noise may hide in the difference of the ways, which was taken off."""
    error, some = fitted.record.error, np.isfinite(memory.spread[:, 0])
    if error is None:
        return fitted
    half = np.stack([np.interp(error.T, memory.T[some], column / 2) for column in memory.spread[some].T], axis=1)
    return fitted.noting(error=error.beside((half * memory.apart)[None]))


def _likelier(error: SingularFit | SwingTooSmall, soak: GatheredSoak) -> str:
    """Return the text of an error with likelier causes: most is not used, it is in doubt, the length is wrong."""
    unused, lasts = soak.used.sentence(), duration(soak.interval * len(soak.T))
    if soak.used.share > MOST:
        left = str(error).partition(";")[0]  # which says what to do about the soak, and that is not at fault
        return f"{unused}; the {lasts} that are left are too few ({left}); see why, or record again"
    text = "; ".join([str(error), *soak.doubts[-1:], *([unused] if unused else [])])
    if isinstance(error, SingularFit):
        return text
    correct = "where length or swing are not what was recorded, correct unit and path of time and temperature"
    return f"{text}; it lasts {lasts}: {correct}"


def _to_fit(soak: GatheredSoak) -> Array:
    """Return the temperatures (N,) in degC, the coldest and the warmest as they were read if smoothing drew them in.

    Of a thermometer without steps its noise is left out here: means of blocks, of which memories show, lose it anyway.
    Without the thermometer's steps they lie within half a step of their readings; a map of them would have to be
    continued by hundredths of a kelvin, over knots that no sample determines, for the readings of its own soak.
    """
    if soak.steps.size == 0.0:
        parts = [slice(*part) for part in pairwise([*soak.starts, len(soak.T)])]
        return np.concatenate([without_noise(soak.t[part], soak.T[part]) for part in parts])
    T, near = soak.T.copy(), soak.steps.size / 2 + 3 * soak.steps.noise
    coldest, warmest = int(np.argmin(T)), int(np.argmax(T))
    if 0 < T[coldest] - soak.used.low <= near:
        T[coldest] = soak.used.low
    if 0 < soak.used.high - T[warmest] <= near:
        T[warmest] = soak.used.high
    return T


def of_sensor(config: Config, fitted: FittedMap) -> FittedMap:
    """Return the map with its sensor in the record."""
    if config.filter is None:
        return fitted
    sensor = config.filter.tracked
    update: dict[str, object] = {"channel": sensor.channel, "unit": sensor.unit}
    if sensor.axes != tuple("xyz"[: len(sensor.axes)]):  # their names where the record has none
        update["axes"] = sensor.axes
    return fitted.noting(**update)


def axes_of(fitted: FittedMap) -> tuple[str, ...]:
    """Return the names of the axes of a map."""
    return fitted.record.axes or tuple("xyz"[: fitted.record.d].ljust(fitted.record.d, "?"))


def term_lines(matrix: TriadMatrix, axes: Sequence[str]) -> list[str]:
    """Return each term of M that is known: its value in the middle, in SI too, its range, and its deviation there."""
    ends = matrix.T[0], matrix.T[-1]
    T = np.linspace(*ends, 201)
    terms, sigma = matrix.terms(T), matrix.sigma(T)
    over = f"over {ends[0]:.1f} to {ends[1]:.1f} °C"
    lines = []
    for k in np.flatnonzero(matrix.told):
        i, j = divmod(int(k), len(axes))
        name, shown, si, spec = ("scale", "ppm", "", "+.0f") if i == j else ("misalignment", "mrad", " rad", "+.3f")
        factor, value, of = 1e6 if i == j else 1e3, terms[100, k], axes[i] if i == j else axes[i] + axes[j]
        low, high = np.min(terms[:, k]) * factor, np.max(terms[:, k]) * factor
        known = (
            "sigma not known" if np.isnan(sigma[0, k]) else f"sigma up to {np.max(sigma[:, k]) * factor:.2g} {shown}"
        )
        lines.append(
            f"{name} {of} {value * factor:{spec}} {shown} = {value:.4g}{si} at {T[100]:.1f} °C, {low:{spec}} to "
            f"{high:{spec}} {shown} {over}, {known}"
        )
    hidden = np.reshape(matrix.free & ~np.array(matrix.told), (3, 3))
    if unknown := [axes[i] + axes[j] for i, j in np.argwhere(hidden)]:
        lines.append(f"terms of M that are not known, and taken as zero: {', '.join(unknown)}")
    return lines


def map_lines(fitted: FittedMap, sensor: Sensor | None) -> list[str]:
    """Return a map's file in sentences: its sensor, its deviation, temperatures without a sample.

    In the unit in which figures of `sensor` are shown, whose map it is; where it is not known, in that of the file.
    """
    record = fitted.record
    unit = BiasUnit(record.unit, sensor.shown if sensor and sensor.unit == record.unit else record.unit)
    low, high = record.domain
    lines = [f"map {record.kind}: of the {record.channel} in {unit.shown}, {low:.2f} to {high:.2f} °C"]
    if record.matrix is not None:
        lines += [f"map {record.kind}: {line}" for line in term_lines(record.matrix, axes_of(fitted))]
    if record.sensitivity is not None:
        known = sum(record.sensitivity.told)
        lines.append(f"map {record.kind}: with g-sensitivity, {known} terms of G(T), taken off where accel is recorded")
    if text := shown_by_soak(fitted, axes_of(fitted), unit):
        lines.append(f"map {record.kind}: its soak {text}, which its sigma does not have")
    if record.error is None:
        known = record.residual is not None
        stands = "; its residual stands for that" if known else ", and has no residual; no deviation reckons with it"
        return [*lines, f"map {record.kind}: does not say how sure its curve is{stands}"]
    T = np.linspace(low, high, 200)
    sigma = np.sqrt(np.mean(fitted.sigma(T) ** 2, axis=0)) * unit.factor
    lines.append(f"map {record.kind}: curve known to {', '.join(f'{v:.2g}' for v in sigma)} {unit.shown} (1 sigma)")
    return [*lines, *(f"map {record.kind}: {unseen(fitted, *hole, unit)}" for hole in record.error.holes)]


def unseen(fitted: FittedMap, low: float, high: float, unit: BiasUnit) -> str:
    """Return a sentence on the range between two temperatures in degC of which the soak has no sample."""
    good = ""
    if fitted.record.error is not None:
        sigma = np.max(fitted.sigma(np.linspace(low, high, 50), low), axis=0) * unit.factor
        good = f", good to {', '.join(f'{v:.2g}' for v in sigma)} {unit.shown} where it bends as elsewhere"
    return f"no sample between {low:.4g} and {high:.4g} °C: the curve there is a guess{good}; record these too"


@dataclass(frozen=True, eq=False)
class GatheredSoak:
    """The samples at rest of one or more recordings, joined."""

    t: Array  # (N,): s; a recording begins an interval after the one before it
    T: Array  # (N,): temperature in degC, without the thermometer's steps, in the order of time
    bias: Array  # (N, d): tracked bias, SI
    names: list[str]  # names of the recordings
    starts: list[int]  # where each of them begins
    interval: float  # between samples, s
    about: Mapping[str, str] = field(default_factory=dict)  # facts on the device that all recordings have alike
    placements: Placements | None = None  # where the direction of the sensor's input is not known
    # the epochs of the samples, with all that was recorded; empty where they were not to be kept
    windows: tuple[Chunk, ...] = ()
    used: Used = field(default_factory=Used)  # share of the recordings that they are
    steps: Steps = NO_STEPS  # of the thermometer
    off: Array | None = None  # (N,): how far T may be off between them (`between_steps`), K^2 s
    doubts: tuple[str, ...] = ()  # whether the recordings are what their config says

    @cached_property
    def summary(self) -> SoakSummary:
        """The summary that an assessment needs."""
        return brief(self.T, self.bias, self.starts, self.interval, self.t, self.off)

    @cached_property
    def memory(self) -> MemoryVerdict:
        """The verdict on whether the bias remembers which temperatures came before."""
        return memory_of(self.summary)

    @cached_property
    def of_both_ways(self) -> Array:
        """Bias (N, d) less half of what is between up and down, on the way of each sample, of axes where these differ.

        A soak in stairs stays just below a temperature while it warms, and just above it while it cools. A curve of all
        samples alike would follow the one way below each step, and the other above.
        """
        if not np.ptp(self.T) > LITTLE or not np.any(self.memory.apart):
            return self.bias
        summary, starts = self.summary, [*self.starts, len(self.T)]
        if len(self.starts) > 1:  # levels of recordings are no difference of the ways
            left = self.bias - _smooth(summary.T, summary.bias, summary.span, self.T)
            levels = [left[start:stop].mean(axis=0) for start, stop in pairwise(starts)]
            summary = brief(self.T, self.bias - np.repeat(levels, np.diff(starts), axis=0), self.starts, self.interval)
        T, difference, up, down = summary.between_ways()
        between = _smooth(T, difference, up * down / (up + down), self.T)
        way = np.repeat(self.summary.way, np.round(self.summary.span / self.interval).astype(np.int64))
        return np.asarray(self.bias - way[:, None] * between / 2 * self.memory.apart)

    def wander(self, bias: Array) -> Wander | None:
        """Return the wander of `bias` (N, d) in several recordings; None of one, and where levels are known."""
        several = len(self.starts) > 1 and self.placements is None
        return wander_of(self.T, bias, self.starts) if several else None

    def rows(self, channel: str) -> tuple[SoakRows, ...]:
        """Return the rows of samples with their windows, of each recording or placement; `channel` is the sensor's."""
        rows, ends = [], np.cumsum([len(window) for window in self.windows])
        for start, stop in pairwise([*self.starts, len(self.T)]):
            own = slice(int(np.searchsorted(ends, start, "right")), int(np.searchsorted(ends, stop, "left")) + 1)
            rows.append(_rows(self.windows[own], self.T[start:stop], self.bias[start:stop], channel))
        return tuple(rows)


def _smooth(T: Array, values: Array, weight: Array, at: Array) -> Array:
    """Return penalised lines through values (K, d) of a weight (K,) at T (K,), at temperatures `at` (N,) in degC."""
    domain = float(at.min()), float(at.max())
    lines, grid = smooth_lines(domain), np.linspace(*domain, GRID)
    B, on_grid = lines.values(T), lines.values(grid)
    curves = [on_grid @ penalised(B, column, weight, lines.penalty).coefficients for column in values.T]
    return np.stack([np.interp(at, grid, curve) for curve in curves], axis=1)


def _rows(windows: Sequence[Chunk], T: Array, bias: Array, channel: str) -> SoakRows:
    """Return the rows of epochs, their temperatures T (N,) and bias (N, d)."""
    t, tau = (np.concatenate(part) for part in zip(*((window.t, window["tau"]) for window in windows), strict=True))
    length = max(ROW, float(t[-1] - t[0]) / MAX_ROWS)
    starts = np.flatnonzero(np.diff(np.floor((t - t[0]) / length + 1e-6), prepend=-1.0))
    names = [name for name in windows[0].channels if name not in (*LEFT_OUT, channel)]
    channels = {name: means(np.concatenate([window[name] for window in windows]), starts, tau) for name in names}
    t, T, bias = (means(values, starts, tau) for values in (t - tau / 2, T, bias))
    return SoakRows(t, T, bias, np.add.reduceat(tau, starts), channels)


def gather(
    config: Config,
    recordings: Sequence[str],
    faults: Faults,
    progress: Progress | None = None,
    *,
    keep: bool = False,
) -> GatheredSoak:
    """Return the samples of all recordings; `keep`: with their epochs, as much memory as they take.

    Raises
    ------
    ConfigError
        If recordings have samples in common, in whatever file or cut.
    DataError
        If a recording cannot be used.
    """
    contents = Contents(config.filter.tracked.channel if config.filter else "gyro")
    contents.check_apart(recordings)
    configs = [with_recording(config, item) for item in recordings] or [config]
    used = Used()
    rows: list[Iterator[Chunk]] = [read(c, faults) for c in configs]
    if len(rows) > 1:
        rows = list(map(contents.along, recordings, rows))
    parts = [_samples(*each, faults, used, progress, keep=keep) for each in zip(configs, rows, strict=True)]
    contents.check_apart(recordings)
    windows = tuple(window for part in parts for window in part.windows)
    starts = np.cumsum([0, *(len(part.T) for part in parts)])[:-1].tolist()
    smooth, steps = soak_temperatures([(part.t, part.T) for part in parts])
    T, bias = (np.concatenate(arrays) for arrays in (smooth, [part.bias for part in parts]))
    each = (between_steps(part.t, x, part.T, steps) for part, x in zip(parts, smooth, strict=True))
    off = np.concatenate(list(each)) if steps.size else None
    interval = float(np.median([part.interval for part in parts]))
    _compare(config, parts, names := [c.source.name for c in configs if c.source is not None], faults)
    placements, unknown = None, None if config.filter is None else config.filter.length_of_input(config.site)
    if unknown is not None and np.ptp(T) > 0:
        first = np.cumsum([0, *(len(part.known) for part in parts)])[:-1]
        placement = np.concatenate([part.placement + k for part, k in zip(parts, first, strict=True)])
        known = np.concatenate([part.known for part in parts])
        bias, placements = placed(T, bias + known[placement], placement, *unknown)
        starts = np.flatnonzero(np.diff(placement, prepend=-1)).tolist()
    return GatheredSoak(
        _joined([part.t for part in parts], interval), T, bias, names, starts, interval, _about(configs), placements,
        windows, used, steps, off, tuple(faults.doubts),
    )  # fmt: skip


def _compare(config: Config, parts: Sequence[_Samples], names: Sequence[str], faults: Faults) -> None:
    """Note doubts about recordings that contradict the others."""
    if config.filter is None or len(names) < len(parts):
        return
    tracked = config.filter.tracked
    T, bias = [part.T for part in parts], [part.bias for part in parts]
    for text in contradictions(T, bias, names, tracked.channel, tracked.axes):
        faults.doubt(text)


def _joined(times: Sequence[Array], interval: float) -> Array:
    """Return the times (N,) of recordings, each an interval after the one before it."""
    lasts = [t[-1] - t[0] + interval for t in times]
    begins = np.cumsum([0.0, *lasts])[:-1]
    return np.concatenate([t - t[0] + begin for t, begin in zip(times, begins, strict=True)])


def _about(configs: Sequence[Config]) -> dict[str, str]:
    """Return the facts on the tracked device that the recordings of configs have alike."""
    facts = [c.source.about(c.filter.tracked.channel) for c in configs if c.source is not None and c.filter is not None]
    return {name: value for name, value in (facts or [{}])[0].items() if all(f.get(name) == value for f in facts)}


def provenance(settings: ThermalMap, recordings: Sequence[str]) -> dict[str, str]:
    """Return the provenance of a fit, for a map's record."""
    return {
        "recordings": ", ".join(Path(name).name for name in recordings),
        "fitted_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "driftlab": __version__,
        "plugins": ", ".join(f"{p['kind']} ({p['distribution']} {p['version']})" for p in participants(settings)),
        "settings": settings.model_dump_json(exclude={"path"}),
    }


class _Samples(NamedTuple):
    """The epochs at rest of a recording: times and readings T (N,), bias (N, d), placement (N,), its input (P, d).

    The interval between epochs is in s: a slow recording has less samples than was asked. `windows` are the epochs,
    where kept.
    """

    t: Array
    T: Array
    bias: Array
    placement: Integers
    known: Array
    interval: float
    windows: list[Chunk]


def _samples(
    config: Config, rows: Iterable[Chunk], faults: Faults, used: Used, progress: Progress | None, *, keep: bool
) -> _Samples:
    interval = config.filter.update_interval if config.filter else 1.0
    stretches: list[RestStretch] = []
    times: list[Array] = []
    count, before, seconds, moving = 0, replace(faults), used.seconds, used.moving
    used.most = 0
    for rest in at_rest(config, epochs(rows, interval), faults, used):
        times.append(rest.window.t)
        stretches.append(rest if keep else rest._replace(window=NOTHING))
        count += len(rest.T)
        if progress is not None:
            progress(faults.since(rest.t), count)
    used.read(faults, before)
    if not stretches:
        name = config.source.name if config.source else "the recording"
        seconds, count = used.seconds - seconds, used.moving - moving
        if config.filter and 0 < used.most < ENOUGH and ENOUGH * seconds > config.filter.align * count:
            raise EmptyRecording(f"{name}: {too_few_updates(config.filter, used.most, seconds / count)}")
        section = config.filter.tracked.section if config.filter else "filter.gyro"
        raise EmptyRecording(
            f"{name}: is nowhere at rest in {seconds:.3g} s; record a soak of hours, or check {section}.noise and the "
            "channels' units"
        )
    # the median over the windows knows of no gap
    ends, sizes = np.array([rest.t for rest in stretches]), np.array([len(rest.T) for rest in stretches])
    between = float(np.median(np.diff(ends) / sizes[1:])) if len(stretches) > 1 else interval
    numbers, first = np.unique([rest.placement for rest in stretches], return_index=True)
    known = np.stack([np.broadcast_to(stretches[k].known, stretches[k].bias.shape)[0] for k in first])
    placement = np.repeat([rest.placement for rest in stretches], sizes)
    assert len(numbers) == placement[-1] + 1, "placements are counted from 0"
    T, bias, t = (np.concatenate(a) for a in ([rest.T for rest in stretches], [rest.bias for rest in stretches], times))
    return _Samples(t, T, bias, placement, known, between, [rest.window for rest in stretches] if keep else [])
