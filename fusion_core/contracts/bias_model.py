"""The contract of bias models: the steps of a sensor's bias from sample to sample."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.plugin import Memory, Plugin
from fusion_core.model import Prior, Transition
from fusion_core.units import Axes, Quantity, Unit, check_axes, usual_axes


class BiasModel(Plugin):
    """Model of a bias of d axes: states, prior, and the transition of each step."""

    axes: Axes = Field(default_factory=usual_axes)
    """Names of the axes whose bias it is."""
    sigma_0: Annotated[float, Unit("bias", positive=True)] | None = None
    """Deviation of the bias before the first sample, which every model's prior begins from; None: nothing is known."""

    @model_validator(mode="after")
    def _one_value_an_axis(self) -> Self:
        for name, value in self:
            if name != "axes" and isinstance(value, tuple) and value and isinstance(value[0], Quantity):
                check_axes(name, value, len(self.axes))
        return self

    @property
    def initial_sigma(self) -> Array:
        """Deviation (d,) of the bias before the first sample: `sigma_0`, or 1 SI unit, which seconds overrule."""
        return np.full(len(self.axes), 1.0 if self.sigma_0 is None else self.sigma_0)

    def as_random_walk(self) -> Mapping[str, Any] | None:
        """Return the settings `axes`, `sigma_0` and `walk` where the bias is a random walk and nothing else.

        None, the default, says that it is more than that. A model that gives them can be replaced by one that follows
        a map and carries effects besides (`ThermalBias.from_random_walk`).
        """
        return None

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

    @property
    def channel_columns(self) -> Mapping[str, int]:
        """Columns d of each channel that it reads as (N, d); none by default: channels are (N,), triads (N, 3)."""
        return {}

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
