"""Bias that follows temperature through a map: the bias model of the TCZUPT filter.

::

    b_k = b_{k-1} + u_k + w_k,    w_k ~ N(0, walk^2 dt)
    difference:  u_k = g(k) - g(k-1),     g = map(T) + what the calibrated effects add
    slope:       u_k = (dmap/dT) (dT/dt) dt + the effects' part of g(k) - g(k-1)

One state an axis, the raw bias itself. Effects whose coefficients theta the filter estimates (`estimate: true`) are
further states that stay as they are, and the bias is then b + S(k) theta, with their signatures S in the output C.

Source: eq. (9)-(11) of Fontanella et al., Sensors 18 (2018) 1457; `slope` is the paper's form, `difference` its exact
integral over the step (they differ where the map bends within a step, and where the temperature rate is estimated with
a lag).
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

    @property
    def labels(self) -> tuple[str, ...]:
        """The axes, then the coefficients that are estimated."""
        estimated = (
            f"{effect.kind}_{k}_{label}"
            for k, effect in enumerate(self.effects)
            if effect.estimate
            for label in effect.labels
        )
        return (*self.axes, *estimated)

    def units(self, bias: str) -> tuple[str, ...]:
        """Units of the states: the bias's, then those of the coefficients that are estimated."""
        estimated = (unit for effect in self.effects if effect.estimate for unit in effect.units)
        return (*(bias,) * len(self.axes), *estimated)

    @cached_property
    def fitted(self) -> FittedMap:
        """The map, read from its file at first use."""
        return self.map.load()

    @cached_property
    def _density(self) -> Array:
        """Of the walk (n, n): Q of one second."""
        d = len(self.axes)
        density = np.zeros(len(self.labels))
        density[:d] = along_axes(self.walk, d) ** 2
        return np.diag(density)

    def prior(self) -> Prior:
        """Return zero with a variance that the first seconds at rest overrule; coefficients as they were fitted."""
        d = len(self.axes)
        estimated = [effect for effect in self.effects if effect.estimate and effect.labels]
        for effect in estimated:
            given = (effect.coefficients or (0.0,) * len(effect.labels), effect.sigma or ())
            if any(len(values) != len(effect.labels) for values in given):
                raise ConfigError(
                    f"effects: {effect.kind} is to be estimated; write sigma, one value for each of its "
                    f"{len(effect.labels)} coefficients ({', '.join(effect.labels)})"
                )
        theta = [value for effect in estimated for value in effect.coefficients or (0.0,) * len(effect.labels)]
        sigma = [value for effect in estimated for value in effect.sigma or ()]
        variance = np.concatenate([np.full(d, (self.sigma_0 or 1.0) ** 2), np.square(np.array(sigma, dtype=float))])
        return Prior(np.concatenate([np.zeros(d), np.array(theta, dtype=float)]), np.diag(variance))

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Return F = I, Q = walk^2 dt and the known drift u; the memory is g of the last sample and the effects'."""
        d, n = len(self.axes), len(self.labels)
        g_before, inputs, signatures = memory or (None, [None] * len(self.effects), [None] * len(self.effects))
        seen, inputs = self._map_input(chunk, inputs)
        g, S, signatures = self._effects(chunk, signatures)
        if self.form == "difference":
            g = g + self.fitted.bias(seen["temperature"], chunk.t)
        u = np.zeros((len(chunk), n))
        u[1:, :d] = g[1:] - g[:-1]
        u[0, :d] = 0.0 if g_before is None else g[0] - g_before[0]
        if self.form == "slope":
            rate = chunk["temperature_rate"] * chunk.dt
            u[:, :d] += self.fitted.slope(seen["temperature"], chunk.t) * rate[:, None]
        Q = self._density * chunk.dt[..., None, None]
        C = None if n == d else np.concatenate([np.broadcast_to(np.eye(d), (len(chunk), d, d)), *S], axis=2)
        return Transition(np.eye(n), Q, u, C), (g[-1:], inputs, signatures)

    def _map_input(self, chunk: Chunk, memories: list[Memory]) -> tuple[Chunk, list[Memory]]:
        """Return the chunk with the temperature that the map sees."""
        after = []
        if any(effect.acts_on_input for effect in self.effects):
            chunk = _as_measured(chunk)
        for effect, memory in zip(self.effects, memories, strict=True):
            T, memory = effect.input(chunk, memory)
            chunk = chunk.having(temperature=T)
            after.append(memory)
        return chunk, after

    def _effects(self, chunk: Chunk, memories: list[Memory]) -> tuple[Array, list[Array], list[Memory]]:
        """Return what the calibrated effects add (N, d), the signatures (N, d, p) of the others, and the memories."""
        g, S, after = np.zeros((len(chunk), len(self.axes))), [], []
        if self.effects:
            chunk = _as_measured(chunk)
        for effect, memory in zip(self.effects, memories, strict=True):
            signature, memory = effect.signature(chunk, memory)
            after.append(memory)
            if effect.estimate:
                S.append(signature)
            elif effect.coefficients is None or len(effect.coefficients) != signature.shape[2]:
                raise ConfigError(
                    f"effects: {effect.kind} has no coefficients for its {signature.shape[2]} regressors; "
                    "write those that were fitted"
                )
            else:
                g = g + signature @ np.asarray(effect.coefficients)
        return g, S, after


def _as_measured(chunk: Chunk) -> Chunk:
    """Return the chunk as effects see it: an application's own smoothing of the temperature is none of theirs."""
    return chunk.having(temperature=chunk["temperature_raw"]) if "temperature_raw" in chunk.channels else chunk


@hookimpl
def bias_models() -> list[type[BiasModel]]:
    """Register the plugin."""
    return [ThermalDerivative]
