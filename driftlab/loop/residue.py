"""What is left when no effect pays any more: is it noise, or something that nothing installed explains?

Two questions are asked of the innovations, which are white with unit variance where the model is right. Do they vary
more over some stretch of time than they may (at which time scale)? And do they depend on a channel in a way that no
effect describes: as any smooth function of it, changing with temperature, or late?
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from driftlab.loop.regression import Fit, Regression
from driftlab.loop.scan import columns_seen, scan
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis

SIGNIFICANT = 1e-5  # probability that noise alone shows so much at any of the time scales
_SPLINES = 6


@dataclass(frozen=True)
class Structure:
    """Something significant that is left: on which channel, at which time scale (s), how strong and how sure.

    `gain` is in nats and `threshold` what chance could reach; `share` is the rms in deviations of the innovations.
    """

    channel: str
    time_scale: float
    description: str
    gain: float
    threshold: float


class Probe(Effect):
    """Any smooth function of a channel, by itself or in proportion to it at any temperature, or the channel late."""

    kind: Literal["probe"] = "probe"
    explanation: ClassVar = "a probe of the residual, no physical effect"
    channel: str
    form: Literal["function", "with temperature", "late"] = "function"
    knots: tuple[float, ...] = ()
    tau: Annotated[float, Field(gt=0)] = 1.0

    @property
    def requires(self) -> tuple[str, ...]:
        """The channel, and temperature where it matters."""
        return (self.channel, "temperature") if self.form == "with temperature" else (self.channel,)

    def candidates(self) -> Iterator[Self]:
        """Yield itself."""
        yield self

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the probe's regressors on each axis."""
        from fusion_core.recursions import lag

        values = _channel(chunk, self.channel)
        if self.form == "late":
            dt = np.ascontiguousarray(np.broadcast_to(chunk.dt, values.shape))
            before, y = (values[0], values[0]) if memory is None else memory
            late = lag(dt, values, self.tau, before, y)
            return on_each_axis(np.stack([values, late], axis=1), len(self.axes)), (float(values[-1]), float(late[-1]))
        along = chunk["temperature"] if self.form == "with temperature" else values
        hats = np.stack([np.interp(along, self.knots, row) for row in np.eye(len(self.knots))], axis=1)
        if self.form == "with temperature":
            hats = hats * values[:, None]
        return on_each_axis(hats, len(self.axes)), None


def _channel(chunk: Chunk, name: str) -> Array:
    return chunk.t - chunk.t[0] if name == "time" else chunk[name]


def structures(regression: Regression, fit: Fit) -> list[Structure]:
    """Return what is significantly left, the strongest first."""
    found = [*_over_time(regression, fit), *_on_channels(regression, fit)]
    return sorted(found, key=lambda s: s.gain - s.threshold, reverse=True)


def _over_time(regression: Regression, fit: Fit) -> Iterator[Structure]:
    """Yield the time scale at which the innovations vary most beyond chance, if there is one.

    The sums over windows of W blocks are independent and of variance W; their squares are a chi-square.
    """
    from scipy.stats import chi2

    evidence = regression.evidence
    white = np.stack([regression.innovations(fit, axis)[0] for axis in range(len(evidence.axes))], axis=1)
    settled = np.concatenate([np.arange(len(record)) > 2 for record in evidence.records])
    parts = [part[keep] for part, keep in zip(evidence.split(white), evidence.split(settled), strict=True)]
    best: tuple[float, int, float] | None = None
    scales = 2 ** np.arange(0, max(1, int(np.log2(max(map(len, parts)) / 8)) + 1))
    for W in scales:
        sums = [part[: len(part) // W * W].reshape(-1, W, part.shape[1]).sum(axis=1) / np.sqrt(W) for part in parts]
        z = np.concatenate(sums).ravel()
        p = float(chi2.logsf(float(z @ z), len(z)))
        if best is None or p < best[0]:
            best = (p, int(W), float(np.mean(z**2)))
    assert best is not None
    limit = float(np.log(SIGNIFICANT / len(scales)))
    if best[0] < limit:
        scale = best[1] * evidence.interval
        text = f"over {_span(scale)} the innovations vary {best[2]:.2f} times as much as noise would"
        yield Structure("time", scale, text, -best[0], -limit)


def _on_channels(regression: Regression, fit: Fit) -> Iterator[Structure]:
    """Yield the dependences on channels that gain more than chance allows, the best form of each channel."""
    probes = list(_probes(regression))
    if not probes:
        return
    N = len(regression.evidence)
    best: dict[str, Structure] = {}
    for score in scan(regression, fit, probes):
        probe = score.effect
        assert isinstance(probe, Probe)
        threshold = 0.5 * columns_seen(regression, probe) * float(np.log(N)) + float(np.log(len(probes)))
        text = {
            "function": f"a smooth function of {probe.channel}",
            "with temperature": f"{probe.channel}, with an influence that changes with temperature",
            "late": f"{probe.channel}, late by about {_span(probe.tau)}",
        }[probe.form]
        found = Structure(probe.channel, probe.tau if probe.form == "late" else 0.0, text, score.gain, threshold)
        present = best.get(probe.channel)
        if score.gain > threshold and (present is None or score.gain - threshold > present.gain - present.threshold):
            best[probe.channel] = found
    yield from best.values()


def _probes(regression: Regression) -> Iterator[Probe]:
    chunks, axes = regression.evidence.chunks, regression.evidence.axes
    skip = {"gyro", "accel", "temperature_rate", "tau"}
    names = [name for name, values in chunks[0].channels.items() if values.ndim == 1 and name not in skip]
    length = max(float(chunk.t[-1] - chunk.t[0]) for chunk in chunks)
    heat = _knots([chunk["temperature"] for chunk in chunks]) if "temperature" in chunks[0].channels else None
    for name in names:
        knots = _knots([chunk[name] for chunk in chunks])
        if knots is None:
            continue
        if name != "temperature":
            yield Probe(axes=axes, channel=name, form="function", knots=knots)
            if heat is not None:
                yield Probe(axes=axes, channel=name, form="with temperature", knots=heat)
            for tau in np.geomspace(30.0, max(100.0, length / 4), 5):
                yield Probe(axes=axes, channel=name, form="late", tau=float(tau))


def _knots(parts: list[Array]) -> tuple[float, ...] | None:
    values = np.concatenate(parts)
    low, high = (float(v) for v in np.quantile(values, [0.005, 0.995]))
    return tuple(float(v) for v in np.linspace(low, high, _SPLINES + 1)) if low < high else None


def _span(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 600 else f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
