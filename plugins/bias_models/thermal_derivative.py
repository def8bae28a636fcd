"""Bias that follows temperature through a map: the bias model of the TCZUPT filter.

::

    b_k = b_{k-1} + u_k + w_k,    w_k ~ N(0, walk^2 dt)
    difference:  u_k = g(k) - g(k-1),     g = map(T) + what the calibrated effects add
    slope:       u_k = (dmap/dT) (dT/dt) dt + the effects' part of g(k) - g(k-1)

One state an axis, the raw bias itself. Source: eq. (9)-(11) of Fontanella et al., Sensors 18 (2018) 1457; `slope` is
the paper's form, `difference` its exact integral over the step (they differ where the map bends within a step, and
where the temperature rate is estimated with a lag).
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import BiasModel, Effect, FittedMap, Memory, Prior, ThermalMap, Transition
from fusion_core.errors import ConfigError
from fusion_core.hookspecs import hookimpl
from fusion_core.registry import Installed
from fusion_core.units import Unit, along_axes


class ThermalDerivative(BiasModel):
    """Bias that follows temperature through a map, plus a random walk."""

    kind: Literal["thermal_derivative"] = "thermal_derivative"
    walk: Annotated[float | tuple[float, ...], Unit("bias/sqrt(s)", least=0, example="5e-4 deg/s/sqrt(s)")]  # density
    sigma_0: Annotated[float, Unit("bias", positive=True)] | None = None  # before the first sample; default 1 SI unit
    map: Annotated[ThermalMap, Installed()]
    form: Literal["difference", "slope"] = "difference"
    effects: tuple[Annotated[Effect, Installed()], ...] = ()

    @property
    def requires(self) -> tuple[str, ...]:
        """Names of the channels that the map and the effects read."""
        rate = ("temperature_rate",) if self.form == "slope" else ()
        return ("temperature", *rate, *(name for effect in self.effects for name in effect.requires))

    @cached_property
    def fitted(self) -> FittedMap:
        """The map, read from its file at first use."""
        return self.map.load()

    def prior(self) -> Prior:
        """Return zero with a variance that the first seconds at rest overrule."""
        d = len(self.axes)
        return Prior(np.zeros(d), np.eye(d) * (self.sigma_0 or 1.0) ** 2)

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Return F = I, Q = walk^2 dt and the known drift u; the memory is g of the last sample and the effects'."""
        d = len(self.axes)
        g_before, inputs, signatures = memory or (None, [None] * len(self.effects), [None] * len(self.effects))
        chunk, inputs = self._map_input(chunk, inputs)
        g, signatures = self._effects(chunk, signatures, d)
        if self.form == "difference":
            g = g + self.fitted.bias(chunk["temperature"], chunk.t)
        u = np.diff(g, axis=0, prepend=g[:1] if g_before is None else g_before)
        if self.form == "slope":
            rate = chunk["temperature_rate"] * chunk.dt
            u = u + self.fitted.slope(chunk["temperature"], chunk.t) * rate[:, None]
        Q = np.diag(along_axes(self.walk, d) ** 2) * chunk.dt[..., None, None]
        return Transition(np.eye(d), Q, u), (g[-1:], inputs, signatures)

    def _map_input(self, chunk: Chunk, memories: list[Memory]) -> tuple[Chunk, list[Memory]]:
        after = []
        for effect, memory in zip(self.effects, memories, strict=True):
            T, memory = effect.input(chunk, memory)
            chunk = chunk.having(temperature=T)
            after.append(memory)
        return chunk, after

    def _effects(self, chunk: Chunk, memories: list[Memory], d: int) -> tuple[Array, list[Memory]]:
        g, after = np.zeros((len(chunk), d)), []
        for effect, memory in zip(self.effects, memories, strict=True):
            if effect.coefficients is None:
                raise ConfigError(f"effects: {effect.kind} has no coefficients; write those that were fitted")
            signature, memory = effect.signature(chunk, memory)
            g = g + signature @ np.asarray(effect.coefficients)
            after.append(memory)
        return g, after


@hookimpl
def bias_models() -> list[type[BiasModel]]:
    """Register the plugin."""
    return [ThermalDerivative]
