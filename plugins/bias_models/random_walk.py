"""Bias as a random walk (rate random walk): the bias model of the standard ZUPT filter.

::

    b_k = b_{k-1} + w_k,    w_k ~ N(0, walk^2 dt)

One state an axis, the bias itself. Source: eq. (8) of Fontanella et al., Sensors 18 (2018) 1457.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import BiasModel, Memory, Prior, Transition
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Unit, along_axes


@hookimpl
class RandomWalk(BiasModel):
    """Bias as a random walk."""

    kind: Literal["random_walk"] = "random_walk"
    walk: Annotated[float | tuple[float, ...], Unit("bias/sqrt(s)", least=0, example="5e-4 deg/s/sqrt(s)")]
    """Density of the random walk."""

    def as_random_walk(self) -> dict[str, Any]:
        """Return the settings: it is one and nothing else."""
        return {"axes": self.axes, "sigma_0": self.sigma_0, "walk": self.walk}

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return one density for all axes, and one an axis."""
        return (cls(walk=1e-6), cls(walk=(1e-6, 0.0, 2e-6), sigma_0=1e-3))

    def prior(self) -> Prior:
        """Return zero with a variance that the first seconds at rest overrule."""
        d = len(self.axes)
        return Prior(np.zeros(d), np.diag(self.initial_sigma**2))

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Return F = I and Q = walk^2 dt."""
        F, density, u = self._second
        return Transition(F, density * chunk.dt[..., None, None], u), memory

    @cached_property
    def _second(self) -> tuple[Array, Array, Array]:
        """F, Q and u of one second."""
        d = len(self.axes)
        return np.eye(d), np.diag(along_axes(self.walk, d) ** 2), np.zeros(d)
