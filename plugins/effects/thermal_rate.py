"""Thermal rate: a bias proportional to how fast the temperature changes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import TEMPERATURE, Behind, Signal, Weighted, lagged
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import lag_of, varied


@hookimpl
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
        return varied(self, "tau", (5.0, 10.0, 20.0, 40.0, 80.0))

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the temperature rate; the memory is the inputs and outputs of its lags, one after the other."""
        T = chunk["temperature"]
        first, second, third = (None,) * 3 if memory is None else (memory[:2], memory[2:4], memory[3:])
        output, first = lag_of(chunk, T, self.tau, first)
        once, second = lag_of(chunk, (T - output) / self.tau, self.tau, second)
        twice, third = lag_of(chunk, once, self.tau, third)
        return on_each_axis(3 * once - 2 * twice, len(self.axes)), (*first, *second, third[1])

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
