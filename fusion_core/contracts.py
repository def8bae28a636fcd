"""The contracts of the four plugin families.

A plugin class is its own configuration: a frozen pydantic model whose fields are what the user writes and whose methods
speak arrays for a whole chunk of samples, never one sample. `kind` names it.

What a plugin must remember from one chunk to the next is an explicit `memory` that goes in and comes out (None at the
start). Plugins have no hidden state. The law that follows: any split of a recording into chunks gives the same result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core.chunk import Array, Chunk
from fusion_core.config import ConfigPath, Settings
from fusion_core.errors import MapError
from fusion_core.faults import Faults
from fusion_core.fitted_map import FittedMap as FittedMap
from fusion_core.fitted_map import MapRecord as MapRecord
from fusion_core.fitted_map import Outside
from fusion_core.model import Prior as Prior
from fusion_core.model import Transition as Transition
from fusion_core.units import Axes, Quantity, Unit, check_axes

Memory = Any


class Plugin(Settings, ABC):
    """Base of every plugin: a frozen configuration that refuses unknown keys."""

    kind: str


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


@dataclass(frozen=True)
class Basis:
    """Curves whose combination c is a map: values(T (N,)) -> (N, q), and penalty (q, q) of roughness c' penalty c."""

    values: Callable[[Array], Array]
    penalty: Array


class ThermalMap(Plugin):
    """Settings of a map from temperature to bias: how it is fitted, where it is kept."""

    suffix: ClassVar[str] = ".json"  # of the map's file

    path: ConfigPath | None = None  # the fitted map's file
    outside: Outside = "refuse"  # beyond the temperatures of the fit: an error, the value at the end, or straight on
    min_swing: Annotated[float, Unit("delta_degC", positive=True, example="2 K")] = Quantity(2.0, "2 K")  # to fit on

    def basis(self, domain: tuple[float, float]) -> Basis:
        """Return curves that stand for this kind of map where it is fitted jointly with other effects.

        By default straight lines between knots 1 K apart (at most 150 pieces), as smooth as the samples say; a kind
        that is linear in its coefficients gives its own.
        """
        count = int(np.clip(np.ceil(domain[1] - domain[0]), 4, 150)) + 1
        knots = np.linspace(*domain, count)
        bends = np.diff(np.eye(count), n=2, axis=0)
        return Basis(lambda T: np.stack([np.interp(T, knots, row) for row in np.eye(count)], axis=1), bends.T @ bends)

    @abstractmethod
    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> FittedMap:
        """Fit the map to samples T (N,) in degC and bias (N, d) in rad/s.

        Raises
        ------
        SwingTooSmall
            If T does not move enough to determine the map.
        SingularFit
            If the samples cannot determine the coefficients.
        """

    @abstractmethod
    def read(self, path: Path) -> FittedMap:
        """Read a map of this kind from its file; raises MapError."""

    def load(self) -> FittedMap:
        """Read the map that the config names."""
        if self.path is None:
            raise MapError(f"{self.kind}: no map file is named; fit one with `driftlab fit-map` and set path: FILE")
        if not self.path.is_file():
            raise MapError(f"{self.kind}: map file {self.path} does not exist; fit it with `driftlab fit-map`")
        return self.read(self.path)


class Source(Plugin):
    """Where samples come from."""

    live: ClassVar[bool] = False  # whether samples come as they are measured, without an end

    @abstractmethod
    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the recording as chunks of at most `size` samples, in SI units.

        A live source yields what has come at once, and an empty chunk when nothing has for a second, so that its
        reader can look up. A source gives what it has, NaN included: rows that cannot be used are left out, the same
        way for every source, by `fusion_core.faults.usable`. What only the source can see (a torn line) it reports to
        `faults`.
        """

    @property
    def name(self) -> str:
        """What the source is called in messages and provenance, e.g. its path."""
        return self.kind


class Effect(Plugin):
    """A physical effect that a residual can be traced to: a bias that is linear in p coefficients."""

    # hyper-parameters (positive) that are refined after the grid, and the factor up or down that is searched
    continuous: ClassVar[Mapping[str, float]] = {}
    unit: ClassVar[str] = "rad/s"  # of a coefficient

    axes: Axes = ("x", "y", "z")
    coefficients: tuple[Annotated[float, Field(ge=-1e30, le=1e30)], ...] | None = None  # (p,) in SI, once known
    sigma: tuple[Annotated[float, Field(ge=0, le=1e30)], ...] | None = None  # (p,) their standard deviations, in SI
    estimate: bool = False  # whether the filter goes on estimating the coefficients, as states
    # (d,) deviation, in SI, of what the effect's state at the first sample adds to the bias; None: it is in equilibrium
    initial: tuple[Annotated[float, Field(ge=0, le=1e30)], ...] | None = None

    @model_validator(mode="after")
    def _starts_somewhere(self) -> Self:
        if self.initial is None:
            return self
        check_axes("initial", self.initial, len(self.axes))
        if any(self.initial) and not self.fades:
            raise ValueError(f"initial is given and {self.kind} has no memory of what came before; remove initial")
        return self

    @property
    @abstractmethod
    def requires(self) -> tuple[str, ...]:
        """Names of the channels that the effect reads, what it is mostly about first; none if it is about time."""

    @property
    @abstractmethod
    def explanation(self) -> str:
        """The physics in a sentence or two, with a reference."""

    @abstractmethod
    def candidates(self) -> Iterator[Self]:
        """Yield the grid of hyper-parameters to try, as configured copies of this effect."""

    @abstractmethod
    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Regressors (N, d, p) whose product with the coefficients is the effect's part of the bias."""

    def input(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Temperature (N,) that the map sees: the chunk's own, unless the effect acts there (a lag)."""
        return chunk["temperature"], memory

    @property
    def acts_on_input(self) -> bool:
        """Whether the effect changes the temperature that the map sees."""
        return type(self).input is not Effect.input

    def fading(self, chunk: Chunk, memory: Memory) -> tuple[Array | None, Memory]:
        """Factor (N,) by which what is unknown of the effect's state decays over the step to each sample.

        What the effect adds to the bias is its signature from equilibrium times its coefficients, and a times the
        product of the factors so far, where a is what the state at the recording's first sample was off by; so the
        first factor of a recording is 1. A lag has exp(-dt / tau); a play has 1 until it must have been dragged,
        whatever it began at, and 0 from then on. None, the default: no memory of what came before. The memory is the
        method's own.
        """
        return None, memory

    @property
    def fades(self) -> bool:
        """Whether the effect has a memory of what came before the recording."""
        return type(self).fading is not Effect.fading

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield what to try on these recordings, where the grid depends on them; it does not by default.

        Each recording is at rest, and its channel `residual` (N, d) is what the model leaves, in its own deviation.
        """
        yield from self.candidates()

    @property
    def subject(self) -> str:
        """What the effect is about, in reports: the first channel that it reads, or time."""
        return self.requires[0] if self.requires else "time"

    @property
    def terms(self) -> tuple[str, ...]:
        """What the coefficients of one axis are called; one without a name by default."""
        return ("",)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the p coefficients, as `labels` names them; `unit` for each by default."""
        return (self.unit,) * len(self.labels)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the p coefficients, as `on_each_axis` orders them."""
        return tuple(f"{axis}_{term}" if term else axis for axis in self.axes for term in self.terms)


def on_each_axis(terms: Array, d: int) -> Array:
    """Return regressors (N, d, d q) of an effect that acts on every axis alike: terms (N,) or (N, q) times I."""
    values = terms.reshape(len(terms), -1)
    spread = np.zeros((len(values), d, d, values.shape[1]))
    spread[:, np.arange(d), np.arange(d)] = values[:, None]
    return spread.reshape(len(values), d, -1)
