"""Interaction: a bias that follows the product of two channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement
from typing import ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import Product, Reading, Signal, Weighted
from fusion_core.hookspecs import hookimpl
from fusion_plugins.effects.common import auxiliary


@hookimpl
class Interaction(Effect):
    """(a - a_0) (b - b_0), together with a and b themselves (temperature is the map's).

    A product without its factors would depend on where their zeros are: the principle of marginality, J. A. Nelder,
    J. R. Stat. Soc. A 140 (1977) 48.
    """

    unit: ClassVar = "bias per SI units of the channels"
    explanation: ClassVar = (
        "One quantity changes how much another matters, e.g. a supply whose influence on the readout grows with "
        "temperature: the bias follows the product of the two. IEEE Std 1431-2004, cross terms of the model equation."
    )

    kind: Literal["interaction"] = "interaction"
    channels: tuple[str, str] = ("voltage", "temperature")
    """Names of the two channels."""
    zero: tuple[float, float] = (0.0, 0.0)
    """Offsets of the two channels, subtracted before they are multiplied, in SI."""

    @property
    def requires(self) -> tuple[str, ...]:
        """The two channels."""
        return self.channels

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield every pair of single-column channels, temperature among them, about their means; also their squares."""
        names = [name for name in (*auxiliary(recordings), "temperature") if recordings[0][name].ndim == 1]
        means = {name: float(np.mean(np.concatenate([chunk[name] for chunk in recordings]))) for name in names}
        for a, b in combinations_with_replacement(names, 2):
            if a == b == "temperature":
                continue  # the map's
            yield self.model_copy(update={"channels": (a, b), "zero": (means[a], means[b])})

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return product and factors; there is no memory."""
        factors = [chunk[name] - zero for name, zero in zip(self.channels, self.zero, strict=True)]
        linear = [chunk[name] - zero for name, zero in self._factors]
        return on_each_axis(np.stack([factors[0] * factors[1], *linear], axis=1), len(self.axes)), None

    def realisation(self) -> tuple[Signal, ...]:
        """Return product and factors."""
        pairs = zip(self.channels, self.zero, strict=True)
        a, b = (Weighted(((1.0, Reading(name)),), -zero) for name, zero in pairs)
        return (Product(a, b), *(Weighted(((1.0, Reading(name)),), -zero) for name, zero in self._factors))

    @property
    def subject(self) -> str:
        """The product."""
        return "*".join(self.channels)

    @property
    def terms(self) -> tuple[str, ...]:
        """The product, then the factors."""
        return ("product", *(name for name, _ in self._factors))

    @property
    def _factors(self) -> list[tuple[str, float]]:
        return [item for item in dict(zip(self.channels, self.zero, strict=True)).items() if item[0] != "temperature"]
