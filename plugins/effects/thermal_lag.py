"""Thermal lag: the sensing element follows the thermometer late."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Memory
from fusion_core.contracts.effect import Signal, lagged
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import FadingLag, lag_of, varied


@hookimpl
class ThermalLag(FadingLag):
    """The map sees the temperature through a first-order lag tau; no coefficient."""

    continuous: ClassVar = {"tau": 2.0}
    requires: ClassVar = ("temperature",)
    explanation: ClassVar = (
        "The thermometer and the sensing element are not at one place: heat reaches the element through a thermal "
        "resistance and its capacity, a first-order lag. Incropera et al., Fundamentals of Heat and Mass Transfer, "
        "Wiley (2007), section 5.1 (lumped capacitance)."
    )

    kind: Literal["thermal_lag"] = "thermal_lag"
    coefficients: tuple[float, ...] | None = ()
    """There are none."""
    tau: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """Time constant with which the sensing element follows the thermometer."""

    def candidates(self) -> Iterator[Self]:
        """Yield time constants from 10 s to 2000 s."""
        return varied(self, "tau", np.geomspace(10.0, 2000.0, 9).tolist())

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return no regressor (N, d, 0): the effect acts on the map's input."""
        return np.zeros((len(chunk), len(self.axes), 0)), None

    def input(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the lagged temperature; the memory is the last temperature and the last output."""
        return lag_of(chunk, chunk["temperature"], self.tau, memory)

    def realisation(self) -> tuple[Signal, ...]:
        """Return none: there is no regressor."""
        return ()

    def realised_input(self, temperature: Signal) -> Signal:
        """Return the lagged temperature."""
        return lagged(temperature, float(self.tau))

    @property
    def terms(self) -> tuple[str, ...]:
        """There is none."""
        return ()
