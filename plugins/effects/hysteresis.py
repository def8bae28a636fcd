"""Thermal hysteresis: the bias on warming up differs from the bias on cooling down."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit


class Hysteresis(Effect):
    """A play operator: the loop's position y - T, from -width / 2 (warming up) to width / 2 (cooling down)."""

    continuous: ClassVar = {"width": 2.0}
    unit: ClassVar = "rad/s/K"
    requires: ClassVar = ("temperature",)
    explanation: ClassVar = (
        "Package, die attach and glue creep and rub, so the stress on the sensor depends on where the temperature came "
        "from: between warming up and cooling down the bias crosses a loop of some width. Play operator: "
        "Krasnosel'skii and Pokrovskii, Systems with Hysteresis, Springer (1989)."
    )

    kind: Literal["hysteresis"] = "hysteresis"
    width: Annotated[float, Unit("delta_degC", positive=True, example="8 K")] = Quantity(8.0, "8 K")

    def candidates(self) -> Iterator[Self]:
        """Yield widths from 1 K to 30 K."""
        for width in np.geomspace(1.0, 30.0, 10):
            yield self.model_copy(update={"width": float(width)})

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return y - T; y starts in the middle of the loop, and is the memory."""
        from fusion_core.recursions import play

        T = chunk["temperature"]
        y = play(T, self.width, T[0] if memory is None else memory)
        return on_each_axis(y - T, len(self.axes)), float(y[-1])


@hookimpl
def effects() -> list[type[Effect]]:
    """Register the plugin."""
    return [Hysteresis]
