"""Turn-on transient: the bias settles after the unit is switched on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import Fading, Signal
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import longest_span, varied

_OF_SPAN = 1 / 3  # longest time constant to try, of the longest recording: beyond, it is a drift


@hookimpl
class TurnOn(Effect):
    """exp(-t / tau), with t since the recording's first sample."""

    continuous: ClassVar = {"tau": 2.0}
    requires: ClassVar = ()
    explanation: ClassVar = (
        "After switch-on the electronics, the drive loop and charges on the sensor settle, whatever the thermometer "
        "says; the bias runs in exponentially. IEEE Std 528-2019, turn-on transient (warm-up)."
    )

    kind: Literal["turn_on"] = "turn_on"
    tau: Annotated[float, Unit("s", positive=True, example="600 s")] = Quantity(600.0, "600 s")
    """Time constant of the transient."""

    def candidates(self) -> Iterator[Self]:
        """Yield time constants from 2 min to 11 h."""
        return varied(self, "tau", np.geomspace(120.0, 39_600.0, 18).tolist())

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield the candidates up to a third of the longest recording."""
        most = _OF_SPAN * longest_span(recordings)
        yield from (candidate for candidate in self.candidates() if candidate.tau <= most)

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the exponential; the memory is the time of the first sample."""
        t_0 = float(chunk.t[0]) if memory is None else memory
        return on_each_axis(np.exp(-(chunk.t - t_0) / self.tau), len(self.axes)), t_0

    def realisation(self) -> tuple[Signal, ...]:
        """Return the exponential."""
        return (Fading(float(self.tau)),)
