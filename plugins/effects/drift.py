"""Drift: a bias that grows steadily with the time since switch-on."""

from __future__ import annotations

from typing import ClassVar, Literal

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import Elapsed, Signal
from fusion_core.hookspecs import hookimpl


@hookimpl
class Drift(Effect):
    """The time since the recording's first sample."""

    unit: ClassVar = "bias/s"
    requires: ClassVar = ()
    explanation: ClassVar = (
        "A leak, an ageing resonator or charge that builds up moves the bias at a steady rate, whatever the "
        "temperature: a rate ramp. IEEE Std 952-1997 (R2008), annex C.1.5."
    )

    kind: Literal["drift"] = "drift"

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the time; the memory is the time of the first sample."""
        t_0 = float(chunk.t[0]) if memory is None else memory
        return on_each_axis(chunk.t - t_0, len(self.axes)), t_0

    def realisation(self) -> tuple[Signal, ...]:
        """Return the time."""
        return (Elapsed(),)
