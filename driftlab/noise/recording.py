"""Allan analysis of a sensor's recording at rest: its Allan and Hadamard curves, and their coefficients.

Gaps, rows that are left out, and motion cut a recording into stretches; all stretches are used.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from driftlab.noise.allan import curve
from driftlab.noise.allan_fit import Coefficients, fit
from driftlab.noise.allan_model import PRESENT, AllanCurve
from driftlab.noise.stretches import MIN_SAMPLES, MIN_STRETCH, Pieces, RestWindows, at_rest, limits, pieces
from driftlab.recordings.screening import read
from driftlab.units import axis_name
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import FileSource
from fusion_core.errors import DataError
from fusion_core.host.provenance import Participant, participants

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from driftlab.config import Config
    from fusion_core.contracts import Sensor
    from fusion_core.faults import Faults

IMU = ("gyro", "accel")


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
    whole = _load(config, faults, progress)
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
    axes = {c: _axes(sensors.get(c), len(of_axes)) for c, of_axes in curves.items()}
    total = float(whole.t[-1] - whole.t[0]) + dt
    first = next(iter(curves.values()))[0]
    notes = [*_gap_notes(first, whole, cut, faults), *_motion_notes(config, rest, faults)]
    for c, of_axes in coefficients.items():
        notes += _grouped(c, axes[c], [one.notes for one in of_axes])
    start, plugins = float(whole.t[cut.spans[0, 0]]), participants(config.source)
    return Analysis(name, dt, cut.samples * dt, total, start, axes, curves, coefficients, notes, plugins, sensors)


def _axes(sensor: Sensor | None, d: int) -> list[str]:
    named = [] if sensor is None else list(sensor.axes)
    return named if len(named) == d else list("xyz"[:d])


def _grouped(channel: str, axes: list[str], notes: list[list[str]]) -> list[str]:
    """Return each note once, with the axes that it is about."""
    by_text: dict[str, list[str]] = {}
    for axis, texts in zip(axes, notes, strict=True):
        for text in texts:
            by_text.setdefault(text, []).append(axis)
    return [f"{axis_name(channel, ', '.join(about))}: {text}" for text, about in by_text.items()]


def _load(config: Config, faults: Faults, progress: Callable[[float, int], None] | None) -> Chunk:
    t: list[Array] = []
    sensors = [sensor.channel for sensor in config.filter.sensors] if config.filter else []
    # an inertial unit's accelerometers also where the filter does without them
    parts: dict[str, list[Array]] = {c: [] for c in (IMU if "gyro" in (sensors or IMU) else sensors)}
    count = 0
    for chunk in read(config, faults):
        t.append(chunk.t)
        for channel, values in parts.items():
            if channel in chunk.channels:
                values.append(chunk[channel])
        count += len(chunk)
        if progress is not None:
            progress(faults.since(float(chunk.t[-1])), count)
    channels = {c: np.concatenate(values) for c, values in parts.items() if values}
    return Chunk(np.concatenate(t), channels, sensors=frozenset(channels))


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
