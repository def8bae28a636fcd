"""Thermal hysteresis: the bias on warming up differs from the bias on cooling down."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import TEMPERATURE, PlayState, Signal
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import largest_reversal, up_to, varied

_WIDTHS, _NARROWEST, _WIDEST = 12, 0.02, 0.7  # to try: how many, and from where to where, of the swing


@hookimpl
class Hysteresis(Effect):
    """A play operator: the loop's position y - T, from -width / 2 (warming up) to width / 2 (cooling down)."""

    continuous: ClassVar = {"width": 2.0}
    unit: ClassVar = "bias/K"
    requires: ClassVar = ("temperature",)
    explanation: ClassVar = (
        "Package, die attach and glue creep and rub, so the stress on the sensor depends on where the temperature came "
        "from: between warming up and cooling down the bias crosses a loop of some width. Play operator: "
        "Krasnosel'skii and Pokrovskii, Systems with Hysteresis, Springer (1989)."
    )

    kind: Literal["hysteresis"] = "hysteresis"
    width: Annotated[float, Unit("delta_degC", positive=True, example="8 K")] = Quantity(8.0, "8 K")
    """Width of the play: how far temperature turns back before the bias follows."""

    def candidates(self) -> Iterator[Self]:
        """Yield widths from 1 K to 30 K."""
        return varied(self, "width", np.geomspace(1.0, 30.0, 10).tolist())

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield widths from 2 % to 70 % of the swing, none wider than temperature reverses through.

        A play that is wider is never crossed: a straight line in disguise.
        """
        swing = max(float(np.ptp(chunk["temperature"])) for chunk in recordings)
        most = max(largest_reversal(chunk["temperature"]) for chunk in recordings)
        if swing > 0:
            yield from varied(self, "width", up_to(np.geomspace(_NARROWEST * swing, _WIDEST * swing, _WIDTHS), most))

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return y - T; y starts in the middle of the loop, and is the memory."""
        from fusion_core.recursions import play

        T = chunk["temperature"]
        y = play(T, self.width, T[0] if memory is None else memory)
        return on_each_axis(y - T, len(self.axes)), float(y[-1])

    def realisation(self) -> tuple[Signal, ...]:
        """Return the play's position."""
        return (PlayState(TEMPERATURE, float(self.width)),)

    def fading(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return 1 until temperature has moved through the width, 0 from then on; the memory is its range so far."""
        T = chunk["temperature"]
        lowest, highest = (T[0], T[0]) if memory is None else memory
        lows, highs = np.minimum(np.minimum.accumulate(T), lowest), np.maximum(np.maximum.accumulate(T), highest)
        crossed = highs - lows >= self.width
        return np.where(crossed, 0.0, 1.0), (float(lows[-1]), float(highs[-1]))
