"""Map misfit: a smooth function of temperature that the declared map is too stiff for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import TEMPERATURE, Function, Signal
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import varied


@hookimpl
class MapMisfit(Effect):
    """Cubic B-splines on equal intervals from `low` to `high`; the function is constant beyond."""

    requires: ClassVar = ("temperature",)
    explanation: ClassVar = (
        "A low polynomial or a small network cannot follow every bend of the bias over temperature; what it leaves "
        "comes back at the same temperatures every time, warming up or cooling down. de Boor, A Practical Guide to "
        "Splines, Springer (2001)."
    )

    kind: Literal["map_misfit"] = "map_misfit"
    intervals: Annotated[int, Field(ge=1, le=64)] = 8
    """Number of intervals from low to high."""
    low: Annotated[float, Unit("degC", example="-40 degC")] = Quantity(-40.0, "-40 degC")
    """Lower end of the temperatures."""
    high: Annotated[float, Unit("degC", example="85 degC")] = Quantity(85.0, "85 degC")
    """Upper end of the temperatures."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} degC is not below high {self.high:g} degC; write the colder one as low")
        return self

    def candidates(self) -> Iterator[Self]:
        """Yield from 2 to 32 intervals."""
        return varied(self, "intervals", (2, 4, 8, 16, 32))

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield the grid over the temperatures of the recordings."""
        T = np.concatenate([chunk["temperature"] for chunk in recordings])
        if np.ptp(T) > 0:
            fitted = self.model_copy(update={"low": float(T.min()), "high": float(T.max())})
            yield from fitted.candidates()

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the B-splines; there is no memory."""
        return on_each_axis(self._splines(chunk["temperature"]), len(self.axes)), None

    def realisation(self) -> tuple[Signal, ...]:
        """Return the B-splines, as functions of temperature."""
        return tuple(
            Function(TEMPERATURE, lambda T, k=k: self._splines(T)[:, k], self.low, self.high)  # type: ignore[misc]
            for k in range(len(self.terms))
        )

    def _splines(self, temperature: Array) -> Array:
        from scipy.interpolate import BSpline

        step = (self.high - self.low) / self.intervals
        beyond = step * np.arange(1, 4)
        inside = np.linspace(self.low, self.high, self.intervals + 1)
        knots = np.concatenate([self.low - beyond[::-1], inside, self.high + beyond])
        T = np.clip(temperature, self.low, self.high)
        return np.asarray(BSpline.design_matrix(T, knots, 3).toarray())

    @property
    def terms(self) -> tuple[str, ...]:
        """One a spline."""
        return tuple(f"B{k}" for k in range(self.intervals + 3))
