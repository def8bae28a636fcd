"""Allan and Hadamard deviations of a sensor at rest, by cumulative sums.

With the angle (or velocity) x_k = dt sum of the N samples up to k, mean removed, and tau = m dt::

    allan^2(tau)    = mean of (x_{k+2m} - 2 x_{k+m} + x_k)^2 / (2 tau^2)                  over all k: overlapping
    hadamard^2(tau) = mean of (x_{k+3m} - 3 x_{k+2m} + 3 x_{k+m} - x_k)^2 / (6 tau^2)     blind to a constant ramp

Sources: IEEE Std 952, annex C; W. J. Riley, NIST Special Publication 1065, sections 5.2.4 and 5.2.10.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from driftlab.noise.fit import Coefficients, fit
from driftlab.noise.model import Curve
from driftlab.samples.epochs import GAP, epochs
from driftlab.samples.screening import read
from driftlab.units import axis_name
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import FileSource
from fusion_core.errors import DataError
from fusion_core.host.participants import Participant, participants

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from driftlab.config import Config
    from fusion_core.contracts import MeasurementModel, Sensor
    from fusion_core.faults import Faults

LEAST = 100  # samples; with fewer there is not a decade of averaging times
IMU = ("gyro", "accel")
PER_DECADE = 10  # averaging times; nearer ones are so correlated that they show nothing more
LONGEST = 5  # the longest averaging time is this part of the recording: a fewer-than-three-fold mean says nothing
FINE = 64  # overlaps in one averaging time; more of them are so alike that the mean does not move
LONG = 2**20  # samples up to which every overlap is taken all the same


class TooShort(DataError):
    """The longest stretch without a gap has too few samples for an Allan deviation."""


@dataclass(frozen=True)
class Analysis:
    """Curves and coefficients of one recording.

    Attributes
    ----------
    dt : float
        Mean sampling interval of the stretch, s.
    used_s, total_s, start_s : float
        Length of the stretch without gaps that was used, of the recording, and the time of the first sample used, s.
    axes, curves, coefficients : dict of channel to list of d items
        Name, curve and coefficients of each axis.
    notes : list of str
        What a user should know, a sentence each.
    plugins : list of dict
        Those that took part.
    sensors : dict of channel to Sensor
        What the config says of them.
    """

    name: str
    dt: float
    used_s: float
    total_s: float
    start_s: float
    axes: dict[str, list[str]]
    curves: dict[str, list[Curve]]
    coefficients: dict[str, list[Coefficients]]
    notes: list[str]
    plugins: list[Participant] = field(default_factory=list)
    sensors: dict[str, Sensor] = field(default_factory=dict)


def factors(N: int, per_decade: int = PER_DECADE) -> NDArray[np.int64]:
    """Return the numbers m of samples to average over, evenly spread on a logarithmic scale from 1 to N / LONGEST."""
    top = max(1, N // LONGEST)
    count = int(np.ceil(np.log10(top) * per_decade)) + 1
    return np.unique(np.rint(np.geomspace(1, top, count)).astype(np.int64))


def curve(rate: Array, dt: float, m: NDArray[np.int64] | None = None) -> Curve:
    """Return the overlapping Allan and Hadamard deviations of samples `rate` (N,), dt seconds apart.

    Every overlap is taken, up to LONG samples. Beyond, where an averaging time has more than FINE of them, every
    second, fourth, ... is taken (`stride`), and m is rounded to a multiple of that.

    Parameters
    ----------
    m : (J,) array of int, optional
        Samples to average over; those of `factors` if left out. 3 m must not exceed N.
    """
    N = len(rate)
    m = factors(N) if m is None else np.asarray(m, dtype=np.int64)
    x = np.zeros(N + 1)
    if rate.min() < rate.max():  # the mean of equal samples may differ from them by its rounding
        # without its mean the sum does not grow with N, and its rounding stays far below the noise
        np.cumsum(rate - np.mean(rate), out=x[1:])
        x *= dt
    stride = np.array([_stride(int(k), N) for k in m], dtype=np.int64)
    m = np.unique(np.rint(m / stride).astype(np.int64) * stride)
    stride = np.array([_stride(int(k), N) for k in m], dtype=np.int64)
    squares = np.empty((len(m), 2))
    thinned = {int(s): x if s == 1 else x[::s].copy() for s in np.unique(stride)}
    for j, (k, s) in enumerate(zip(m, stride, strict=True)):
        squares[j] = _mean_squares(thinned[int(s)], int(k // s))
    tau: Array = np.asarray(m * dt, dtype=np.float64)
    deviations = np.sqrt(squares / [2.0, 6.0]) / tau[:, None]
    return Curve(tau, deviations[:, 0], deviations[:, 1], stride, N * dt, dt)


def _stride(m: int, N: int) -> int:
    s = 1
    while m >= 2 * s * FINE and 2 * s * LONG <= N:
        s *= 2
    return s


@njit(cache=True, nogil=True, fastmath={"reassoc"})  # type: ignore[untyped-decorator]
def _mean_squares(x: Array, m: int) -> tuple[float, float]:
    """Return the mean squares of the second and of the third differences of x over m samples."""
    second, third = len(x) - 2 * m, len(x) - 3 * m
    squares = cubes = 0.0
    for k in range(third):
        now = x[k + 2 * m] - 2 * x[k + m] + x[k]
        later = x[k + 3 * m] - 2 * x[k + 2 * m] + x[k + m]
        squares += now * now
        cubes += (later - now) * (later - now)
    for k in range(third, second):
        now = x[k + 2 * m] - 2 * x[k + m] + x[k]
        squares += now * now
    return squares / second, cubes / third


def analyse(config: Config, faults: Faults, progress: Callable[[float, int], None] | None = None) -> Analysis:
    """Read the config's recording and return its curves and coefficients.

    Raises
    ------
    TooShort
        If no stretch without a gap has LEAST samples.
    DataError
        If the recording cannot be read.
    """
    name = config.source.name if config.source is not None else "the recording"
    whole = _load(config, faults, progress)
    start, stop = longest_stretch(whole.t)
    if stop - start < LEAST:
        raise TooShort(
            f"{name}: the longest stretch without a gap has {stop - start} samples, at least {LEAST} are needed for an "
            "Allan deviation; use a longer recording, or one without gaps"
        )
    part = whole.part(start, stop)
    dt = float(part.t[-1] - part.t[0]) / (len(part) - 1)
    columns = [(channel, part[channel][:, k]) for channel in part.channels for k in range(part[channel].shape[1])]
    with ThreadPoolExecutor() as pool:
        curves = list(pool.map(lambda item: curve(item[1], dt), columns))
    found = [fit(item) for item in curves]
    by_channel = {c: [k for k, (channel, _) in enumerate(columns) if channel == c] for c in part.channels}
    axes = {c: _axes(config.filter, c, len(ks)) for c, ks in by_channel.items()}
    total = float(whole.t[-1] - whole.t[0]) + dt
    notes = [*_gap_notes(total, whole, part, dt, faults), *_motion_notes(config, part, faults)]
    for channel, ks in by_channel.items():
        notes += _grouped(channel, axes[channel], [found[k].notes for k in ks])
    return Analysis(
        name, dt, len(part) * dt, total, float(part.t[0]), axes,
        {c: [curves[k] for k in ks] for c, ks in by_channel.items()},
        {c: [found[k] for k in ks] for c, ks in by_channel.items()}, notes, participants(config.source),
        {sensor.channel: sensor for sensor in (config.filter.sensors if config.filter else ())},
    )  # fmt: skip


def _axes(model: MeasurementModel | None, channel: str, d: int) -> list[str]:
    named = next((list(s.axes) for s in (model.sensors if model else ()) if s.channel == channel), [])
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


def longest_stretch(t: Array) -> tuple[int, int]:
    """Return start and stop of the longest run of samples without a step longer than GAP times the median."""
    if len(t) < 2:
        return 0, len(t)
    step = np.diff(t)
    cuts = np.concatenate([[0], np.flatnonzero(step > GAP * np.median(step)) + 1, [len(t)]])
    k = int(np.argmax(np.diff(cuts)))
    return int(cuts[k]), int(cuts[k + 1])


def _gap_notes(total: float, whole: Chunk, part: Chunk, dt: float, faults: Faults) -> Iterator[str]:
    if len(part) < len(whole):
        yield (
            f"gaps: the longest stretch without one is used, {len(part) * dt:.6g} s from {faults.when(part.t[0])}, "
            f"{100 * len(part) / len(whole):.3g} % of the samples, {100 * len(part) * dt / total:.3g} % of the time"
        )
    step = np.diff(part.t)
    if np.max(np.abs(step - dt)) > 0.01 * dt:
        limits = f"{step.min():.4g} to {step.max():.4g} s"
        yield f"steps vary from {limits}: taken as regular, with the mean interval {dt:.6g} s"


def _motion_notes(config: Config, part: Chunk, faults: Faults) -> Iterator[str]:
    """Say where the unit moves, by the filter's own measure of rest; nothing where there is no filter section."""
    settings = config.filter
    if settings is None or settings.tracked.channel not in part.channels:
        return
    settings = settings.only(part.channels.keys())
    t, still = _windows_at_rest(settings, part)
    moving = np.flatnonzero(~still)
    if not len(moving):
        return
    about = f"in {len(moving)} of {len(still)} windows of {settings.align:g} s (first at {faults.when(t[moving[0]])})"
    cuts = np.concatenate([[-1], moving, [len(still)]])
    k = int(np.argmax(np.diff(cuts)))
    text = f"motion, or noise far beyond what the config declares: {about}; what moves the unit counts as noise here"
    if cuts[k + 1] - cuts[k] > 1 and config.source is not None:
        start, stop = t[[cuts[k] + 1, cuts[k + 1]]] - (faults.first_row or 0.0)
        where = f"{start:.3f}:{stop:.3f}"
        named = config.source.path if isinstance(config.source, FileSource) else config.source.name
        text += f". The longest rest: --input {named}::{where}"
    yield text


def _windows_at_rest(settings: MeasurementModel, part: Chunk) -> tuple[Array, NDArray[np.bool_]]:
    """Return the edges (n + 1,) of windows of the alignment's length, s, and whether each was at rest (n,)."""
    stream = concatenate(epochs([part], settings.update_interval))
    count = max(1, int((stream.t[-1] - stream.t[0]) / settings.align))
    t = stream.t[0] + settings.align * np.arange(count + 1)
    cuts = np.searchsorted(stream.t, t)
    windows = (stream.part(int(a), int(b)) for a, b in pairwise(cuts))
    return t, np.array([len(window) < 3 or settings.still(window) for window in windows])
