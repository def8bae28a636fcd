"""Thermal rate: a bias proportional to how fast the temperature changes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal, Self

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.hookspecs import hookimpl


class ThermalRate(Effect):
    """dT/dt, as the application estimates it."""

    unit: ClassVar = "rad/s/(K/s)"
    requires: ClassVar = ("temperature", "temperature_rate")
    explanation: ClassVar = (
        "While the temperature changes, heat flows through the sensor and its parts are unequally warm; in a fibre coil "
        "the two beams meet a moving temperature at different times. D. M. Shupe, Applied Optics 19 (1980) 654."
    )

    kind: Literal["thermal_rate"] = "thermal_rate"

    def candidates(self) -> Iterator[Self]:
        """Yield itself: there is nothing to search."""
        yield self

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the temperature rate; there is no memory."""
        return on_each_axis(chunk["temperature_rate"], len(self.axes)), None


@hookimpl
def effects() -> list[type[Effect]]:
    """Register the plugin."""
    return [ThermalRate]
