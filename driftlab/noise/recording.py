"""Allan analysis of a sensor's recording at rest: its Allan and Hadamard curves, and their coefficients.

Gaps, rows that are left out, and motion cut a recording into stretches; all that can be used are: without a gap, at
rest. N samples, S stretches, n windows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np

from driftlab.config import Config
from driftlab.noise.allan import bridgeable, curve
from driftlab.noise.allan_fit import RAMP_SHOWS, Coefficients, fit
from driftlab.noise.allan_model import KEYS, PRESENT, AllanCurve
from driftlab.noise.bias_step import bias_steps, block_means
from driftlab.noise.temperature_part import temperature_parts
from driftlab.recordings.epochs import GAP, epochs
from driftlab.recordings.plausibility import axes_in
from driftlab.recordings.screening import read
from driftlab.units import axis_name, default_unit, unit_of, with_uncertainty
from fusion_core.chunk import Array, Chunk, Flags, Integers, concatenate
from fusion_core.contracts import FileSource, MeasurementModel, Sensor
from fusion_core.errors import ConfigError, DataError
from fusion_core.faults import Faults
from fusion_core.host.provenance import Participant, participants

MIN_SAMPLES = 100  # in all that an Allan deviation needs
MIN_STRETCH = 30  # samples in the longest stretch; with fewer there is not a decade of averaging times
NEAR = 10  # samples at each end of a gap that say when it begins and ends
NEVER = 10**15  # samples: so long a gap is not bridged
MAX_MOVING = 0.5  # of the windows; where more of them move than that, the declared noise is wrong and not the bench


@dataclass(frozen=True)
class RestWindows:
    """Windows of `length` s that have samples, and whether the unit was at rest in each.

    `numbers` (n,) count windows from the time t_0, s; `still` (n,) says which were at rest.
    """

    t_0: float
    length: float
    numbers: Integers
    still: Flags

    @property
    def doubtful(self) -> bool:
        """True if so many windows look like motion that it is the noise that is not as declared."""
        return bool(np.mean(~self.still) > MAX_MOVING)

    @property
    def moving(self) -> Array:
        """Begin of the windows in which the unit moved, s."""
        return np.asarray(self.t_0 + self.length * self.numbers[~self.still], dtype=np.float64)

    @property
    def longest(self) -> tuple[float, float] | None:
        """Begin and end of the longest rest, s; None where there is none."""
        cuts = np.concatenate([[-1], np.flatnonzero(~self.still), [len(self.still)]])
        k = int(np.argmax(np.diff(cuts)))
        if cuts[k + 1] - cuts[k] < 2:
            return None
        first, last = self.numbers[[cuts[k] + 1, cuts[k + 1] - 1]]
        return self.t_0 + self.length * float(first), self.t_0 + self.length * float(last + 1)

    def rows(self, t: Array) -> Flags:
        """Return the samples at times t (N,) in windows at rest; those between windows go with one beside them."""
        window = np.searchsorted(self.numbers, np.floor((t - self.t_0) / self.length), side="right") - 1
        return np.asarray(self.still[np.maximum(window, 0)], dtype=np.bool_)


def at_rest(settings: MeasurementModel, samples: Chunk) -> RestWindows:
    """Judge windows of the alignment's length by the filter's own measure of rest."""
    stream = concatenate(epochs([samples], settings.update_interval))
    t_0 = float(stream.t[0])
    # one of them at the end that is not whole says no more than that it is short
    whole = max(1, int((stream.t[-1] - t_0) / settings.align))
    number = np.minimum(np.floor((stream.t - t_0) / settings.align), whole - 1).astype(np.int64)
    numbers, first = np.unique(number, return_index=True)
    windows = (stream.part(a, b) for a, b in pairwise([*first.tolist(), len(stream)]))
    still = [len(window) < 3 or settings.still(window) for window in windows]
    return RestWindows(t_0, settings.align, numbers, np.array(still, dtype=np.bool_))


@dataclass(frozen=True)
class Pieces:
    """The usable samples of a recording, cut at gaps and at rows that are not usable."""

    rows: Integers  # (S, 2) first row and end of each piece, of one row too
    missing: (
        Integers  # (S - 1,) samples lost behind each piece but the last; NEVER: rows that are not usable lie between
    )
    parts: Integers  # (P, 2) first piece of each span whose gaps can be bridged, and the piece after its last
    places: Integers  # (P,) samples that each span would have without a gap
    dt: float  # mean step of the spans, s

    @property
    def samples(self) -> int:
        """Number of rows of all spans."""
        total = np.concatenate([[0], np.cumsum(np.diff(self.rows, axis=1)[:, 0])])
        return int(np.sum(total[self.parts[:, 1]] - total[self.parts[:, 0]]))

    @property
    def enough(self) -> bool:
        """True if there are samples enough for an Allan deviation."""
        return self.samples >= MIN_SAMPLES and bool(np.max(self.places, initial=0) >= MIN_STRETCH)

    @property
    def spans(self) -> Integers:
        """First row and end (P, 2) of each span."""
        return np.stack([self.rows[self.parts[:, 0], 0], self.rows[self.parts[:, 1] - 1, 1]], axis=1)


def pieces(t: Array, usable: Flags | None = None) -> Pieces:
    """Cut samples at times t (N,) at steps longer than GAP times the median; leave out spans too short for any average.

    Stamps that jitter make steps as much shorter as longer, a gap makes none shorter: a step that is as much longer
    than the median as the shortest are shorter is no gap. The samples lost in a gap are counted from its own length, so
    a clock that drifts moves none. A gap's ends are those of a line through NEAR samples: one sample that is late makes
    a long step and a short one, and none is lost.
    """
    rows = _runs(t, usable)
    lengths, first, last = np.diff(rows, axis=1)[:, 0], rows[:, 0], rows[:, 1] - 1
    missing = np.full(max(0, len(rows) - 1), NEVER)
    if np.any(lengths > 1):
        dt = float(np.sum(t[last] - t[first]) / np.sum(lengths - 1))
        near = np.minimum(lengths, NEAR)
        total = np.concatenate([[0.0], np.cumsum(t - t[0])])
        begin = (total[first + near] - total[first]) / near - (near - 1) * dt / 2
        end = (total[last + 1] - total[last + 1 - near]) / near + (near - 1) * dt / 2
        lost = np.clip(np.rint((begin[1:] - end[:-1]) / dt) - 1, 0, NEVER).astype(np.int64)
        missing = np.where(first[1:] > rows[:-1, 1], NEVER, lost)
    parts, whole = bridgeable(lengths, missing) if len(rows) else (np.empty((0, 2), dtype=np.int64), lengths)
    cut = Pieces(rows, missing, parts, whole, 0.0)
    lasted = float(np.sum(t[cut.spans[:, 1] - 1] - t[cut.spans[:, 0]]))
    return replace(cut, dt=lasted / max(1, int(np.sum(cut.places - 1))))


def _runs(t: Array, usable: Flags | None) -> Integers:
    if len(t) < 2:
        return np.empty((0, 2), dtype=np.int64)
    step = np.diff(t)
    usual = float(np.median(step))
    cut = step > max(GAP * usual, 2 * usual - float(np.quantile(step, EARLY)))
    if usable is not None:
        cut |= usable[1:] != usable[:-1]
    edges = np.concatenate([[0], np.flatnonzero(cut) + 1, [len(t)]])
    stretches = np.stack([edges[:-1], edges[1:]], axis=1)
    return stretches if usable is None else stretches[usable[stretches[:, 0]]]


def limits(t: Array, stretches: Integers) -> tuple[float, float]:
    """Return the shortest and the longest step within stretches (S, 2), s."""
    step = np.diff(t)
    stretches = stretches[np.diff(stretches, axis=1)[:, 0] > 1]
    inside: Integers = np.ravel(stretches - [0, 1]).astype(np.int64)  # steps from the first row to the last one
    inside = inside[:-1] if inside[-1] == len(step) else inside
    low, high = (f.reduceat(step, inside.tolist())[::2] for f in (np.minimum, np.maximum))
    return float(low.min()), float(high.max())


IMU = ("gyro", "accel")
SLOW = slice(KEYS.index("bias_instability"), None)  # of the coefficients: those that one step of the bias looks like

WARMED = "the temperature shows as a rate ramp"
SPARSE = 0.2  # of the time that samples at their interval fill, at least
EARLY = 1e-3  # of the steps, that are the shortest: a stamp is early by so much, and another one as late


class TooShort(DataError):
    """There are too few samples for an Allan deviation, or too few without a gap."""


@dataclass(frozen=True)
class Analysis:
    """Curves and coefficients of one recording."""

    name: str  # of the recording
    dt: float  # mean sampling interval within the stretches, s
    used_s: float  # length of all stretches that were used, s
    total_s: float  # length of the recording, s
    start_s: float  # time of the first sample used, s
    axes: dict[str, list[str]]  # names, by channel
    curves: dict[str, list[AllanCurve]]  # of each axis, by channel
    coefficients: dict[str, list[Coefficients]]  # of each axis, by channel
    notes: list[str]  # remarks for the user, a sentence each
    plugins: list[Participant] = field(default_factory=list)  # those that took part
    sensors: dict[str, Sensor] = field(default_factory=dict)  # as the config has them, by channel
    warmed: dict[str, list[str]] = field(
        default_factory=dict
    )  # axes whose slow terms are the temperature's, by channel

    @property
    def first(self) -> AllanCurve:
        """One of the curves: their averaging times and stretches are the same."""
        return next(iter(self.curves.values()))[0]

    @property
    def stretches(self) -> int:
        """Number of stretches without a gap that were used."""
        return len(self.first.stretches)


def analyse(config: Config, faults: Faults, progress: Callable[[float, int], None] | None = None) -> Analysis:
    """Read the config's recording and return its curves and coefficients.

    Raises
    ------
    TooShort
        If there are fewer than MIN_SAMPLES samples, or no stretch without a gap has MIN_STRETCH.
    DataError
        If the recording cannot be read.
    """
    name = config.source.name if config.source is not None else "the recording"
    whole, T = _load(config, faults, progress)
    rest = _rest(config, whole)
    cut = pieces(whole.t, None if rest is None or rest.doubtful else rest.rows(whole.t))
    if not cut.enough:
        raise TooShort(
            f"{name}: has {cut.samples} samples in stretches without a long gap, {len(cut.places)} of them, at most "
            f"{np.max(cut.places, initial=0)} in one; an Allan deviation needs {MIN_SAMPLES}, and {MIN_STRETCH} in one "
            "stretch; use a longer recording, or one with fewer gaps"
        )
    dt = cut.dt
    sensors = {sensor.channel: sensor for sensor in (config.filter.sensors if config.filter else ())}
    with ThreadPoolExecutor() as pool:
        each = partial(curve, dt=dt, stretches=cut.rows, missing=cut.missing)
        waiting = {c: pool.map(each, whole[c].T) for c in whole.channels}
        curves = {c: list(of_axes) for c, of_axes in waiting.items()}
    coefficients = {c: list(map(fit, of_axes)) for c, of_axes in curves.items()}
    axes = {c: axes_in(sensors.get(c), len(of_axes)) for c, of_axes in curves.items()}
    total = float(whole.t[-1] - whole.t[0]) + dt
    _doubt_stamps(faults, len(whole), dt, total)
    first = next(iter(curves.values()))[0]
    notes = [*_gap_notes(first, whole, cut, faults), *_motion_notes(config, rest, faults)]
    warmed: dict[str, list[str]] = {}
    for c, of_axes in coefficients.items():
        said = list(_slow_notes(whole.t, whole[c], T, cut.spans, of_axes, c, axes[c], sensors.get(c), faults))
        warmed[c] = [axis for axis, _, by_temperature in said if by_temperature]
        notes += [f"{axis_name(c, axis)}: {text}" for axis, text, _ in said]
        by_axis = zip(axes[c], of_axes, strict=True)
        own = [[t.replace(RAMP_SHOWS, WARMED) if a in warmed[c] else t for t in one.notes] for a, one in by_axis]
        notes += _grouped(c, axes[c], own)
    start, plugins = float(whole.t[cut.spans[0, 0]]), participants(config.source)
    return Analysis(
        name, dt, cut.samples * dt, total, start, axes, curves, coefficients, notes, plugins, sensors, warmed
    )


def _doubt_stamps(faults: Faults, rows: int, dt: float, total: float) -> None:
    """Note where the time stamps of so many rows, dt apart in the mean of `total` s, are not those of the samples."""
    if rows * dt < SPARSE * total:
        faults.doubt(
            f"rows follow one another at {dt:.3g} s, enough for {rows * dt:.3g} s of {total:.6g} s: "
            "packets that were buffered have the time of their arrival; set source.interval"
        )
    repeated = sum(fault.count for what, fault in faults.found.items() if "repeat a time stamp" in what)
    if repeated > (1 - PRESENT) * faults.rows:
        faults.doubt(
            f"{repeated} of {faults.rows} rows repeat a time stamp and are left out: the clock is coarser than the "
            "rows, and the noise is that of the rows that are left; set source.interval"
        )


def _slow_notes(
    t: Array, rate: Array, T: Array | None, spans: Integers, found: Sequence[Coefficients], channel: str,
    axes: list[str], sensor: Sensor | None, faults: Faults,
) -> Iterator[tuple[str, str, bool]]:  # fmt: skip
    """Yield axis and remark where the walk, or ramp, is rather the temperature's (True), or one step of the bias."""
    slow = [k for k, one in enumerate(found) if np.any(one.value[SLOW] > 0)]
    means = block_means(t, rate[:, slow], spans) if slow else None
    if means is None:
        return
    unit = default_unit("rad/s" if channel == IMU[0] else "m/s^2") if sensor is None else unit_of(sensor)
    warmed = [None] * len(slow) if T is None else temperature_parts(means, T)
    for k, part, step in zip(slow, warmed, bias_steps(means, len(slow)), strict=True):
        if part is not None and (step is None or part.gain > step.gain - 3 / 2 * np.log(len(means.t))):
            text = (
                f"the temperature moves by {part.moved:.3g} K, and a curve over it makes {100 * part.part:.0f} % of "
                f"the variance of what the bias moves (log-likelihood {part.gain:.0f} beyond noise, walk, ramp and "
                "warming up alone); walk and ramp have it in: take it out with a map, or record at one temperature"
            )
            yield axes[k], text, True
        elif step is not None:
            value = with_uncertainty(step.size * unit.factor, step.sigma * unit.factor)
            beside = f"{step.walk * unit.factor:.3g} {unit.shown}/sqrt(s)" if step.walk > 0 else "not seen"
            text = (
                f"the bias steps by {value} {unit.shown} at {faults.when(step.t)} "
                f"(log-likelihood {step.gain:.0f} beyond noise and walk alone); the walk that is fitted has it in, "
                f"beside it the walk is {beside}: find its cause, or leave one side of it out with PATH::START:STOP"
            )
            yield axes[k], text, False


def _grouped(channel: str, axes: list[str], notes: list[list[str]]) -> list[str]:
    """Return each note once, with the axes that it is about."""
    by_text: dict[str, list[str]] = {}
    for axis, texts in zip(axes, notes, strict=True):
        for text in texts:
            by_text.setdefault(text, []).append(axis)
    return [f"{axis_name(channel, ', '.join(about))}: {text}" for text, about in by_text.items()]


def _load(config: Config, faults: Faults, progress: Callable[[float, int], None] | None) -> tuple[Chunk, Array | None]:
    """Return the sensors' samples, and the temperatures (N,) beside them where there are such."""
    sensors = [sensor.channel for sensor in config.filter.sensors] if config.filter else []
    # an inertial unit's accelerometers also where the filter does without them
    wanted, parts, T, count = IMU if "gyro" in (sensors or IMU) else sensors, list[Chunk](), list[Array](), 0
    for chunk in read(config, faults):
        channels = {c: chunk[c] for c in wanted if c in chunk.channels}
        parts.append(Chunk(chunk.t, channels, sensors=frozenset(channels)))
        T += [chunk["temperature"]] if "temperature" in chunk.channels and chunk["temperature"].ndim == 1 else []
        count += len(chunk)
        if progress is not None:
            progress(faults.since(float(chunk.t[-1])), count)
    whole = concatenate(parts)
    if not whole.channels:
        raise ConfigError(
            f"source: the recording has no channel {' or '.join(wanted)}; name that of another sensor by a filter, as "
            "in filter: {kind: held, channel: pressure, ...}"
        )
    return whole, np.concatenate(T) if len(T) == len(parts) else None


def _rest(config: Config, whole: Chunk) -> RestWindows | None:
    """Return the windows at rest, by the filter's own measure; None where there is no filter section."""
    settings = config.filter
    if settings is None or settings.tracked.channel not in whole.channels:
        return None
    return at_rest(settings.only(whole.channels.keys()), whole)


def _gap_notes(first: AllanCurve, whole: Chunk, cut: Pieces, faults: Faults) -> Iterator[str]:
    """Yield remarks on the samples behind each averaging time, and on steps that vary within a stretch."""
    dt, lengths = cut.dt, cut.places
    if len(bridged := first.bridged):
        short, long = np.min(bridged), np.max(bridged)
        many = f"{len(bridged)} gaps are" if len(bridged) > 1 else "1 gap is"
        since = f"{short:.3g} s" if short == long else f"{short:.3g} s (all of them from {long:.3g} s)"
        yield (
            f"{many} bridged for averaging times from {since} on: an average is the mean of the samples that are "
            f"there, where {100 * PRESENT:.0f} % of them are; shorter averaging times stand on what lies between gaps"
        )
    if len(lengths) > 1:
        k, share = int(np.argmax(lengths)), 100 * cut.samples / len(whole)
        gap = "long gap" if len(bridged) else "gap"
        yield (
            f"{len(lengths)} stretches without a {gap} or motion are used, {share:.3g} % of the samples, of "
            f"{lengths.min() * dt:.3g} to {lengths.max() * dt:.6g} s (the longest from "
            f"{faults.when(whole.t[cut.spans[k, 0]])}): {_stands(first)}"
        )
    low, high = limits(whole.t, cut.rows)
    if max(high - dt, dt - low) > 0.01 * dt:
        yield f"steps vary from {low:.4g} to {high:.4g} s: taken as regular, with the mean interval {dt:.6g} s"


def _stands(first: AllanCurve) -> str:
    used = first.used
    if used[-1] >= used[0]:
        return "every averaging time stands on all of them"
    most = first.tau[int(np.flatnonzero(used >= 0.9 * used[0])[-1])]
    return (
        f"averaging times up to {most:.3g} s stand on 90 % of their time or more, the longest, "
        f"{first.tau[-1]:.3g} s, on {first.counts[-1]} of them, {used[-1]:.6g} s"
    )


def _motion_notes(config: Config, rest: RestWindows | None, faults: Faults) -> Iterator[str]:
    """Yield remarks on where the unit moves, and what was made of it."""
    if rest is None or np.all(rest.still):
        return
    moving = rest.moving
    about = f"{len(moving)} of {len(rest.still)} windows of {rest.length:g} s (first at {faults.when(moving[0])})"
    if not rest.doubtful:
        yield f"motion, left out: {about}"
        return
    text = (
        f"motion, or noise far beyond what the config declares: {about}; nothing is left out for it, and what moves "
        "the unit counts as noise here"
    )
    if (longest := rest.longest) is not None and config.source is not None:
        start, stop = np.array(longest) - (faults.first_row or 0.0)
        named = config.source.path if isinstance(config.source, FileSource) else config.source.name
        text += f". The longest rest: --input {named}::{start:.3f}:{stop:.3f}"
    yield text
