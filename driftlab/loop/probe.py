"""Probes: what no effect names, in forms general enough to catch most of it.

A probe takes part in the search like an effect, but is only a nuisance: it keeps what has no name from being given a
wrong one, and is reported as unexplained, on its channel and at its time scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from fusion_core.chunk import Array, Chunk, auxiliary
from fusion_core.contracts import Effect, Memory, on_each_axis

_SPLINES = 12


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

        values = chunk[self.channel]
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

    @property
    def variant(self) -> str:
        """Its form."""
        return self.form

    @property
    def description(self) -> str:
        """What was found, in words."""
        return {
            "function": f"a smooth function of {self.channel}",
            "with temperature": f"{self.channel}, with an influence that changes with temperature",
            "late": f"{self.channel}, late by about {span(self.tau)}",
        }[self.form]


def probes(chunks: Sequence[Chunk], axes: tuple[str, ...]) -> Iterator[Probe]:
    """Yield the probes of every auxiliary channel of the recordings."""
    names = [name for name in auxiliary(chunks) if name != "temperature" and chunks[0][name].ndim == 1]
    length = max(float(chunk.t[-1] - chunk.t[0]) for chunk in chunks)
    heat = _knots([chunk["temperature"] for chunk in chunks]) if "temperature" in chunks[0].channels else None
    for name in names:
        knots = _knots([chunk[name] for chunk in chunks])
        if knots is None:
            continue
        yield Probe(axes=axes, channel=name, form="function", knots=knots)
        if heat is not None:
            yield Probe(axes=axes, channel=name, form="with temperature", knots=heat)
        for tau in np.geomspace(30.0, max(100.0, length / 4), 5):
            yield Probe(axes=axes, channel=name, form="late", tau=float(tau))


def _knots(parts: list[Array]) -> tuple[float, ...] | None:
    values = np.concatenate(parts)
    low, high = (float(v) for v in np.quantile(values, [0.005, 0.995]))
    return tuple(float(v) for v in np.linspace(low, high, _SPLINES + 1)) if low < high else None


def span(seconds: float) -> str:
    """Return a time span as one says it."""
    return (
        f"{seconds:.0f} s"
        if seconds < 600
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )
