"""Curve: a bias that follows a low power series of temperature, or of a channel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Memory, on_each_axis
from fusion_core.contracts.effect import Function, Reading, Signal
from fusion_core.hookspecs import hookimpl
from fusion_plugins.effects.common import OfChannel, scalars, varied

_MAX_POWERS = 3  # powers


@hookimpl
class Curve(OfChannel):
    """Powers above + 1 ... above + powers of x = (u - middle) / half of the range; beyond the range the tangent."""

    explanation: ClassVar = (
        "Elastic constants, expansion and circuits answer to temperature, or to a supply, along a smooth curve, and a "
        "straight line or a low polynomial leaves the next powers. IEEE Std 1431-2004, temperature sensitivities "
        "expressed as a power series."
    )

    kind: Literal["curve"] = "curve"
    channel: str = "temperature"
    """Name of the channel."""
    powers: Annotated[int, Field(ge=1, le=_MAX_POWERS)] = 1
    """Number of powers."""
    above: Annotated[int, Field(ge=0, le=15)] = 0
    """The degree that a declared map has already."""
    low: Annotated[float, Field(ge=-1e30, le=1e30)] = -40.0
    """Lower end of the channel's range, SI (degC for temperature)."""
    high: Annotated[float, Field(ge=-1e30, le=1e30)] = 85.0
    """Upper end of the channel's range, SI (degC for temperature)."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} is not below high {self.high:g}; write the lower end as low")
        return self

    def candidates(self) -> Iterator[Self]:
        """Yield 1, 2 and 3 powers; of a channel other than temperature 3: one is `channel`, two `interaction`."""
        return varied(self, "powers", range(1 if self.channel == "temperature" else _MAX_POWERS, _MAX_POWERS + 1))

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield the candidates for temperature and every auxiliary channel of one column that moves, over its range."""
        for name in scalars(recordings):
            u = np.concatenate([chunk[name] for chunk in recordings])
            low, high = float(np.min(u)), float(np.max(u))
            if low < high:
                yield from self.model_copy(update={"channel": name, "low": low, "high": high}).candidates()

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the powers; there is no memory."""
        x = self._scaled(chunk[self.channel])
        edge = np.clip(x, -1.0, 1.0)
        beyond = x - edge
        k = np.arange(self.above + 1, self.above + self.powers + 1)
        terms = edge[:, None] ** k + k * edge[:, None] ** (k - 1) * beyond[:, None]
        return on_each_axis(terms, len(self.axes)), None

    def _scaled(self, u: Array) -> Array:
        return np.asarray((u - (self.low + self.high) / 2) / ((self.high - self.low) / 2))

    def realisation(self) -> tuple[Signal, ...]:
        """Return the powers, as functions of the channel."""
        of, powers = Reading(self.channel), range(self.above + 1, self.above + self.powers + 1)
        return tuple(
            Function(of, lambda u, k=k: self._scaled(u) ** k, self.low, self.high, "tangent")  # type: ignore[misc]
            for k in powers
        )

    def beside_map(self, degree: int | None) -> Self | None:
        """Return the powers above the map's, of temperature; of a channel, itself."""
        if self.channel != "temperature":
            return self
        return None if degree is None else self.model_copy(update={"above": degree})

    @property
    def terms(self) -> tuple[str, ...]:
        """One a power."""
        return tuple(f"c{k}" for k in range(self.above + 1, self.above + self.powers + 1))
