"""Thermal rate: a bias proportional to how fast the temperature changes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import TEMPERATURE, Behind, Signal, Weighted, lagged
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit


class ThermalRate(Effect):
    """dT/dt through s (1 + 3 tau s) / (1 + tau s)^3: without a coarse thermometer's steps, and late on no ramp."""

    continuous: ClassVar = {"tau": 2.0}
    unit: ClassVar = "bias/(K/s)"
    requires: ClassVar = ("temperature",)
    explanation: ClassVar = (
        "While the temperature changes, heat flows through the sensor and its parts are unequally warm; in a fibre "
        "coil the two beams meet a moving temperature at different times. D. M. Shupe, Applied Optics 19 (1980) 654."
    )

    kind: Literal["thermal_rate"] = "thermal_rate"
    tau: Annotated[float, Unit("s", positive=True, example="20 s")] = Quantity(20.0, "20 s")
    """Time constant of the differentiator."""

    def candidates(self) -> Iterator[Self]:
        """Yield differentiators from 5 s to 80 s: a coarse thermometer needs a slow one."""
        for tau in (5.0, 10.0, 20.0, 40.0, 80.0):
            yield self.model_copy(update={"tau": tau})

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the temperature rate; the memory is the inputs and outputs of the two lags."""
        from fusion_core.recursions import lag

        T = chunk["temperature"]
        dt = np.ascontiguousarray(np.broadcast_to(chunk.dt, T.shape))
        x = (T[0], T[0], 0.0, 0.0, 0.0) if memory is None else memory
        rate = (T - (behind := lag(dt, T, self.tau, x[0], x[1]))) / self.tau
        once = lag(dt, rate, self.tau, x[2], x[3])
        twice = lag(dt, once, self.tau, x[3], x[4])
        after = tuple(float(values[-1]) for values in (T, behind, rate, once, twice))
        return on_each_axis(3 * once - 2 * twice, len(self.axes)), after

    def realisation(self) -> tuple[Signal, ...]:
        """Return the rate, in what its lags have not followed."""
        tau = float(self.tau)
        rate = Weighted(((1 / tau, Behind(TEMPERATURE, tau)),))
        once = lagged(rate, tau)
        # 3 once - 2 twice = once + 2 (once - twice)
        return (Weighted(((1.0, once), (2.0, Behind(once, tau)))),)

    @property
    def memory_span(self) -> float:
        """Of the differentiator."""
        return float(self.tau)


@hookimpl
def effects() -> list[type[Effect]]:
    """Register the plugin."""
    return [ThermalRate]
