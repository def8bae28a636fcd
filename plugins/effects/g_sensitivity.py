"""g-sensitivity: a bias proportional to specific force."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal, Self

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.hookspecs import hookimpl


class GSensitivity(Effect):
    """A 3 x 3 matrix on specific force."""

    unit: ClassVar = "rad/s/(m/s^2)"
    requires: ClassVar = ("accel",)
    explanation: ClassVar = (
        "Gravity and acceleration strain an unbalanced proof mass or coil, and each axis answers to all three "
        "components: seen where the unit is tilted while it is measured. IEEE Std 1431-2004, g-sensitive drift."
    )

    kind: Literal["g_sensitivity"] = "g_sensitivity"

    def candidates(self) -> Iterator[Self]:
        """Yield itself: there is nothing to search."""
        yield self

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return specific force on each axis; there is no memory."""
        return on_each_axis(chunk["accel"], len(self.axes)), None

    @property
    def terms(self) -> tuple[str, ...]:
        """The three components."""
        return ("f_x", "f_y", "f_z")


@hookimpl
def effects() -> list[type[Effect]]:
    """Register the plugin."""
    return [GSensitivity]
