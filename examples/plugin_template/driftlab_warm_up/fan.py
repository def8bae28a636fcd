"""Chamber fan: the bias jumps whenever the fan starts, and settles: exp(-t / tau), t since the last start."""

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit


class ChamberFan(Effect):
    """One regressor; zero until the fan has been seen to start."""

    continuous: ClassVar = {"tau": 2.0}  # refined after the grid, by at most this factor
    explanation: ClassVar = (
        "Each start of the chamber's fan blows air of another temperature on the housing; its wall settles with a "
        "thermal time constant, whether the fan goes on or not. Incropera et al., Fundamentals of Heat and Mass "
        "Transfer, Wiley (2007), section 5.1 (lumped capacitance)."
    )

    kind: Literal["chamber_fan"] = "chamber_fan"
    channel: str = "fan"
    """The channel that is above 0.5 while the fan runs."""
    tau: Annotated[float, Unit("s", positive=True, example="400 s")] = Quantity(400.0, "400 s")
    """Time constant with which the housing settles."""

    @property
    def requires(self) -> tuple[str, ...]:
        return (self.channel,)

    def candidates(self) -> Iterator[Self]:
        for tau in np.geomspace(60.0, 3000.0, 8):
            yield self.model_copy(update={"tau": float(tau)})

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        on = chunk[self.channel] > 0.5
        # what the first sample shows running may have started long ago
        was_on, started = (bool(on[0]), -np.inf) if memory is None else memory
        starts = on & ~np.concatenate([[was_on], on[:-1]])
        last = np.maximum(started, np.maximum.accumulate(np.where(starts, chunk.t, -np.inf)))
        return on_each_axis(np.exp(-(chunk.t - last) / self.tau), len(self.axes)), (bool(on[-1]), float(last[-1]))


@hookimpl
def effects() -> list[type[Effect]]:
    return [ChamberFan]
