"""Bias that follows temperature through a map: the bias model of the TCZUPT filter.

::

    b_k = b_{k-1} + u_k + w_k,    w_k ~ N(0, walk^2 dt)
    difference:  u_k = g(k) - g(k-1),     g = map(T) + what the calibrated effects add
    slope:       u_k = (dmap/dT) (dT/dt) dt + the effects' part of g(k) - g(k-1)
    bias_k = b_k + S(k) theta + sum of a_k,    a_k = f_k a_{k-1},    a_0 ~ N(0, initial^2)

One state b an axis, without a map the effects' part alone. Effects whose coefficients theta the filter estimates
(`estimate: true`) are further states that stay as they are, with their signatures S in the output C. An effect with a
memory (a lag, a play) begins in equilibrium; what it was off by at the first sample is a state a of each axis, where
`initial` says how large it may be, and fades by the factors f of the effect.

Before the first sample b is N(0, sigma_0^2), or N(g + turn_on_bias, repeatability^2) where earlier switch-ons say so.

Source: eq. (9)-(11) of Fontanella et al., Sensors 18 (2018) 1457; `slope` is the paper's form, `difference` its exact
integral over the step (they differ where the map bends within a step, and where the temperature rate is estimated with
a lag).
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from fusion_core.chunk import Array, Chunk, constant
from fusion_core.contracts import Effect, Memory, Prior, ThermalBias, ThermalMap, Transition
from fusion_core.contracts.effect import as_measured
from fusion_core.errors import ConfigError
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Installed
from fusion_core.units import along_axes


class _Memory(NamedTuple):
    """The memory from chunk to chunk; effect by effect where it is a list."""

    g: Array | None  # (d,) of the last sample
    inputs: list[Memory]
    signatures: list[Memory]
    fadings: list[Memory]
    left: list[float]  # product of the factors by which the start has faded
    level: Array | None  # (d,) map and effects at the last sample

    @classmethod
    def start(cls, count: int) -> _Memory:
        return cls(None, [None] * count, [None] * count, [None] * count, [1.0] * count, None)


@hookimpl
class ThermalDerivative(ThermalBias):
    """Bias that follows temperature through a map, plus a random walk."""

    kind: Literal["thermal_derivative"] = "thermal_derivative"
    map: Annotated[ThermalMap, Installed()] | None = None
    """The map of temperature that the bias follows."""
    form: Literal["difference", "slope"] = "difference"
    """Form of a step along the map: by the difference of its values, or by its slope times the temperature rate."""
    effects: tuple[Annotated[Effect, Installed()], ...] = ()
    """Effects that the bias follows too, in this order."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.form == "slope" and self.map is None:
            raise ValueError("form is slope and there is no map to take it of; name a map, or leave form out")
        return self

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return one without a map: a map needs a file."""
        return (cls(walk=1e-6),)

    @property
    def requires(self) -> tuple[str, ...]:
        """Names of the channels that the map and the effects read."""
        temperature = ("temperature",) if self.map or any(effect.acts_on_input for effect in self.effects) else ()
        rate = ("temperature_rate",) if self.map and self.form == "slope" else ()
        return (*temperature, *rate, *(name for effect in self.effects for name in effect.requires))

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The axes, the coefficients that are estimated, and what memories began at."""
        effects = list(enumerate(self.effects))
        estimated = (
            f"{effect.kind}_{k}_{label}" for k, effect in effects if effect.estimate for label in effect.labels
        )
        starts = (f"{self.effects[k].kind}_{k}_start_{axis}" for k in self._starts for axis in self.axes)
        return (*self.axes, *estimated, *starts)

    def units(self, bias: str) -> tuple[str, ...]:
        """Units of the states: the bias's, those of the coefficients that are estimated, the bias's again."""
        d = len(self.axes)
        estimated = (unit for effect in self.effects if effect.estimate for unit in effect.units_of(bias))
        return (*(bias,) * d, *estimated, *(bias,) * (d * len(self._starts)))

    @cached_property
    def _starts(self) -> list[int]:
        """Places of the effects that began at a state that is not known."""
        return [k for k, effect in enumerate(self.effects) if effect.fades and any(effect.initial or ())]

    @cached_property
    def _density(self) -> Array:
        """Of the walk (n, n): Q of one second."""
        d = len(self.axes)
        density = np.zeros(len(self.labels))
        density[:d] = along_axes(self.walk, d) ** 2
        return np.diag(density)

    @cached_property
    def _same(self) -> Array:
        """F of states that stay as they are (n, n)."""
        return np.eye(len(self.labels))

    def prior(self) -> Prior:
        """Return zero with a variance that the first seconds at rest overrule, or what earlier switch-ons say.

        Coefficients are as they were fitted. Map and effects are left out: `prior_at` has them.
        """
        given = self.repeatability
        sigma = self.initial_sigma if given is None else along_axes(given, len(self.axes))
        return self._prior(self._offset, sigma, [1.0] * len(self.effects))

    def prior_at(self, chunk: Chunk) -> Prior:
        """Return the prior with the level of map and effects at the first sample, where `repeatability` is given."""
        prior, (_, memory) = self.prior(), self.transition(chunk.part(0, 1), None)
        return Prior(self._levelled(prior.x, memory), prior.P)

    def prior_again(self, memory: Memory) -> Prior:
        """Return a wide prior about the present level; what memories began at has faded meanwhile."""
        known = _Memory(*memory)
        prior = self._prior(self._offset, self.initial_sigma, known.left)
        return Prior(self._levelled(prior.x, memory), prior.P)

    @property
    def _offset(self) -> Array:
        return along_axes(0.0 if self.repeatability is None else self.turn_on_bias or 0.0, len(self.axes))

    def _levelled(self, x: Array, memory: Memory) -> Array:
        """Return the states x (n,) with the level of map and effects on that of the bias, where it is known at all."""
        d, level = len(self.axes), _Memory(*memory).level
        return x if self.repeatability is None or level is None else np.concatenate([x[:d] + level, x[d:]])

    def _prior(self, level: Array, sigma: Array, left: list[float]) -> Prior:
        """Return the prior from mean and deviation (d,) of the level, and what is left of the memories' starts."""
        estimated = [effect for effect in self.effects if effect.estimate and effect.labels]
        for effect in estimated:
            given = (effect.coefficients or (0.0,) * len(effect.labels), effect.sigma or ())
            if any(len(values) != len(effect.labels) for values in given):
                raise ConfigError(
                    f"effects: {effect.kind} is to be estimated; write sigma, one value for each of its "
                    f"{len(effect.labels)} coefficients ({', '.join(effect.labels)})"
                )
        theta = [value for effect in estimated for value in effect.coefficients or (0.0,) * len(effect.labels)]
        of_theta = [value for effect in estimated for value in effect.sigma or ()]
        starts = [left[k] * value for k in self._starts for value in self.effects[k].initial or ()]
        mean = np.concatenate([level, np.array(theta, dtype=float), np.zeros(len(starts))])
        return Prior(mean, np.diag(np.square(np.concatenate([sigma, np.array([*of_theta, *starts], dtype=float)]))))

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Return F, Q = walk^2 dt, the known drift u and the output C."""
        d, n = len(self.axes), len(self.labels)
        before = _Memory.start(len(self.effects)) if memory is None else _Memory(*memory)
        shifted, inputs = self._map_input(chunk, before.inputs) if self.effects else (chunk, [])
        g, S, signatures = self._effects(chunk, before.signatures)
        level = g
        if self.fitted is not None and (self.form == "difference" or self.repeatability is not None):
            level = g + self.fitted.bias(shifted["temperature"], chunk.t)
        if self.form == "difference":
            g = level
        u = np.zeros((len(g), n))
        if len(g) > 1:
            u[1:, :d] = g[1:] - g[:-1]
        if before.g is not None:
            u[0, :d] = g[0] - before.g
        if self.form == "slope" and self.fitted is not None:
            rate = chunk["temperature_rate"] * chunk.dt
            u[:, :d] += self.fitted.slope(shifted["temperature"], chunk.t) * rate[:, None]
        Q = self._density * chunk.dt[..., None, None]
        F, fadings, left = self._transition_matrix(chunk, before)
        after = g[-1], inputs, signatures, fadings, left, level[-1]
        return Transition(F, Q, u, self._output(S, len(chunk))), after

    def _output(self, S: list[Array], N: int) -> Array | None:
        """Return C: None where the states are the bias, (d, n), or (N, d, n) with the signatures S (N, d, p)."""
        d = len(self.axes)
        starts = [np.eye(d) for _ in self._starts]
        if S:
            return np.concatenate([*(np.broadcast_to(a, (N, *a.shape[-2:])) for a in [np.eye(d), *S, *starts])], axis=2)
        return np.hstack([np.eye(d), *starts]) if starts else None

    def _transition_matrix(self, chunk: Chunk, before: _Memory) -> tuple[Array, list[Memory], list[float]]:
        """Return F, the effects' memories of their fading, and what is left of their starts."""
        d, factors = len(self.axes), []
        fadings, left = list(before.fadings), list(before.left)
        if not self._starts:
            return self._same, fadings, left
        chunk = as_measured(chunk)
        for k in self._starts:
            factor, fadings[k] = self.effects[k].fading(chunk, before.fadings[k])
            if factor is None:  # nothing is unknown as it is configured
                factor = np.zeros(len(chunk))
            # factor by factor: the same wherever the recording was cut
            left[k] = float(np.multiply.accumulate(np.concatenate([[left[k]], factor]))[-1])
            factors.append(constant(factor))
        diagonal = np.ones((*np.broadcast_shapes(*(f.shape for f in factors)), len(self.labels)))
        for place, factor in enumerate(factors, start=1):
            at = len(self.labels) - d * (len(factors) - place + 1)
            diagonal[..., at : at + d] = factor[..., None]
        return diagonal[..., None] * np.eye(len(self.labels)), fadings, left

    def _map_input(self, chunk: Chunk, memories: list[Memory]) -> tuple[Chunk, list[Memory]]:
        """Return the chunk with the temperature that the map sees."""
        after = []
        if any(effect.acts_on_input for effect in self.effects):
            chunk = as_measured(chunk)
        for effect, memory in zip(self.effects, memories, strict=True):
            if effect.acts_on_input:
                T, memory = effect.input(chunk, memory)
                chunk = chunk.having(temperature=T)
            after.append(memory)
        return chunk, after

    def _effects(self, chunk: Chunk, memories: list[Memory]) -> tuple[Array, list[Array], list[Memory]]:
        """Return the sum of the calibrated effects (N, d), the signatures (N, d, p) of the others, and the memories."""
        g, S, after = np.zeros((len(chunk.t), len(self.axes))), [], []
        if self.effects:
            chunk = as_measured(chunk)
        for effect, memory in zip(self.effects, memories, strict=True):
            signature, memory = effect.held(chunk, memory)
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
