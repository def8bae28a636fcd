"""g-sensitivity: a bias proportional to specific force."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import Reading, Signal
from fusion_core.hookspecs import hookimpl

_TILTED = 0.5  # m/s^2: an accelerometer of consumer grade drifts by 0.02 to 0.05 g over its temperatures


@hookimpl
class GSensitivity(Effect):
    """A 3 x 3 matrix on specific force."""

    unit: ClassVar = "bias/(m/s^2)"
    requires: ClassVar = ("accel",)
    explanation: ClassVar = (
        "Gravity and acceleration strain an unbalanced proof mass or coil, and each axis answers to all three "
        "components: seen where the unit is tilted while it is measured. IEEE Std 1431-2004, g-sensitive drift."
    )

    kind: Literal["g_sensitivity"] = "g_sensitivity"

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield itself where the unit was tilted during a recording: less may be the accelerometers' own drift."""
        for chunk in recordings:
            # handling and noise apart
            low, high = np.quantile(chunk["accel"], [0.05, 0.95], axis=0) if "accel" in chunk.channels else (0.0, 0.0)
            if np.max(high - low) > _TILTED:
                yield self
                return

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return specific force on each axis; there is no memory."""
        return on_each_axis(chunk["accel"], len(self.axes)), None

    def realisation(self) -> tuple[Signal, ...]:
        """Return the three components."""
        return tuple(Reading("accel", column, len(self.terms)) for column in range(len(self.terms)))

    @property
    def terms(self) -> tuple[str, ...]:
        """The three components."""
        return ("f_x", "f_y", "f_z")
