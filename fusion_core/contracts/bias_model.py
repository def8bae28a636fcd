"""The contract of bias models: how a sensor's bias moves from sample to sample."""

from __future__ import annotations

from abc import abstractmethod
from typing import Self

from pydantic import model_validator

from fusion_core.chunk import Chunk
from fusion_core.contracts.plugin import Memory, Plugin
from fusion_core.model import Prior, Transition
from fusion_core.units import Axes, Quantity, check_axes


class BiasModel(Plugin):
    """How a bias of d axes moves: states, prior, and the transition of each step."""

    axes: Axes = ("x", "y", "z")

    @model_validator(mode="after")
    def _one_value_an_axis(self) -> Self:
        for name, value in self:
            if name != "axes" and isinstance(value, tuple) and value and isinstance(value[0], Quantity):
                check_axes(name, value, len(self.axes))
        return self

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the n states, unique within the block."""
        return self.axes

    def units(self, bias: str) -> tuple[str, ...]:
        """Units of the n states, in the order of `labels`, where `bias` is that of the bias; it for each by default."""
        return (bias,) * len(self.labels)

    @property
    def requires(self) -> tuple[str, ...]:
        """Names of the channels that the model reads."""
        return ()

    @abstractmethod
    def prior(self) -> Prior:
        """Mean (n,) and covariance (n, n) of the states before the first sample."""

    def prior_at(self, chunk: Chunk) -> Prior:
        """Prior where the chunk's first sample is the first of all, just before the step that leads to it.

        By default `prior()`: what the samples say of the bias is in the steps alone.
        """
        return self.prior()

    def prior_again(self, memory: Memory) -> Prior:
        """Prior just after the sample that the memory is of, where the filter begins anew: at another level, or place.

        By default `prior()`.
        """
        return self.prior()

    @abstractmethod
    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Transition of the N steps that lead to the chunk's samples, and the memory for the next chunk.

        `chunk.dt` is 0-d where every step lasts the same: then F and Q should have no leading N.
        """
