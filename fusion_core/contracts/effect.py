"""The contract of effects: causes to which a residual can be traced.

An effect is made of signals, of channels and of time, that a firmware can run too. A signal has one value a sample;
Reading, Elapsed and Fading begin one, the others are of signals:

::

    Behind    r = u - lag(u),    lag' = (u - lag) / tau, from equilibrium
    Play      r = y - u,         y follows u once u has crossed the width; from the middle
    Weighted  w_1 u_1 + w_2 u_2 + ... + offset
    Product   u v
    Limited   u, and beyond two limits the nearer one
    Function  f(u), within a range of u and continued beyond it

`Effect.realisation` and `Effect.realised_input` say what an effect is in these.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.plugin import Memory, Plugin
from fusion_core.units import Axes, check_axes, usual_axes


class Domain(dict[str, Any]):
    """The ends of each channel by its name, never changed: what has one can be a key."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self.items()))


Ends = tuple[Annotated[float, Field(ge=-1e30, le=1e30)], Annotated[float, Field(ge=-1e30, le=1e30)]]


class Effect(Plugin):
    """A physical effect that a residual can be traced to: a bias that is linear in p coefficients."""

    # hyper-parameters (positive) that are refined after the grid, and the factor up or down that is searched
    continuous: ClassVar[Mapping[str, float]] = {}
    unit: ClassVar[str] = "bias"  # of a coefficient; `bias` stands for the unit of the bias
    # how an effect of time alone runs: any walk imitates what is no line of one frequency
    course: ClassVar[Literal["transient", "line"]] = "transient"
    several: ClassVar[bool] = False  # whether a model may have it more than once of one subject

    axes: Axes = Field(default_factory=usual_axes)
    """Names of the axes on which the effect acts."""
    coefficients: tuple[Annotated[float, Field(ge=-1e30, le=1e30)], ...] | None = None
    """The coefficients in SI, in the order of the effect's labels, once they are known."""
    sigma: tuple[Annotated[float, Field(ge=0, le=1e30)], ...] | None = None
    """Standard deviations of the coefficients, in SI."""
    estimate: bool = False
    """True if the filter goes on estimating the coefficients, as states."""
    initial: tuple[Annotated[float, Field(ge=0, le=1e30)], ...] | None = None
    """Deviation, one an axis in SI, of what the state at the first sample adds to the bias; without it, equilibrium."""
    domain: Annotated[Mapping[str, Ends | tuple[Ends, ...]], AfterValidator(Domain)] | None = None
    """Smallest and largest value of each channel that it was fitted on, SI, a pair a column; without it, no limit."""
    regressors: tuple[Ends, ...] | None = None
    """Smallest and largest value of each regressor in the fit, of an effect with a memory: these are held then."""

    @model_validator(mode="after")
    def _domain_is_ordered(self) -> Self:
        for name in self.domain or {}:
            for low, high in self.ends(name):
                if not low <= high:
                    raise ValueError(f"domain of {name}: {low:g} is above {high:g}; write the smaller end first")
        return self

    @model_validator(mode="after")
    def _starts_somewhere(self) -> Self:
        if self.initial is None:
            return self
        check_axes("initial", self.initial, len(self.axes))
        if any(self.initial) and not self.fades:
            raise ValueError(f"initial is given and {self.kind} has no memory of what came before; remove initial")
        return self

    # must: what every effect writes

    @property
    @abstractmethod
    def requires(self) -> tuple[str, ...]:
        """Names of the channels that the effect reads, what it is mostly about first; none if it is about time."""

    @property
    @abstractmethod
    def explanation(self) -> str:
        """The physics in a sentence or two, with a reference."""

    @abstractmethod
    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Regressors (N, d, p) whose product with the coefficients is the effect's part of the bias."""

    # may: the search for it

    @property
    def channel_columns(self) -> Mapping[str, int]:
        """Columns d of each channel that it reads as (N, d); none by default: channels are (N,), triads (N, 3)."""
        return {}

    def candidates(self) -> Iterator[Self]:
        """Yield the grid of hyper-parameters to try, as configured copies of this effect; by default itself."""
        yield self

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield the grid of hyper-parameters to try, where it depends on the recordings; it does not by default.

        Each recording is at rest, and its channel `residual` (N, d) is what the model leaves, in its own deviation.
        """
        yield from self.candidates()

    def beside_map(self, degree: int | None) -> Self | None:
        """Return the part of the effect that is left beside a map that follows powers of temperature up to `degree`.

        0: there is no map; None: it follows all that matter. The effect itself by default; None where nothing is left.
        """
        return self

    # may: a memory of what came before

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
    def memory_span(self) -> float | None:
        """Time (s) over which the effect forgets its subject, or takes its rate; None, by default, where it is not one.

        A memory of the temperature that is shorter than what recordings resolve is its rate, whatever it is called.
        """
        return None

    # may: acting on the temperature that the map sees

    def input(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Temperature (N,) that the map sees: the chunk's own, unless the effect acts there (a lag)."""
        return chunk["temperature"], memory

    # may: firmware

    def realisation(self) -> tuple[Signal, ...] | None:
        """Return the signals that are the regressors of one axis, in the order of `terms`; each axis has the same.

        For firmware, which has no NumPy; the law: they are the signature. None, the default: not known.
        """
        return None

    def realised_input(self, temperature: Signal) -> Signal | None:
        """Return the temperature that the map sees, made of the thermometer's; None: not known."""
        return None if self.acts_on_input else temperature

    # text: names and units in configs and reports

    @property
    def subject(self) -> str:
        """The subject of the effect in reports: the first channel that it reads, or time."""
        return self.requires[0] if self.requires else "time"

    @property
    def variant(self) -> str:
        """Mark of candidates of one kind and subject that are judged each for itself; none by default."""
        return ""

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the coefficients of one axis; one without a name by default."""
        return ("",)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the p coefficients, as `on_each_axis` orders them."""
        return tuple(f"{axis}_{term}" if term else axis for axis in self.axes for term in self.terms)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the p coefficients, as `labels` names them; `unit` for each by default."""
        return (self.unit,) * len(self.labels)

    # given: the same for every effect

    def ends(self, channel: str) -> Array:
        """Return the ends (columns, 2) of the domain of a channel that is in it, SI."""
        return np.asarray((self.domain or {})[channel], dtype=np.float64).reshape(-1, 2)

    def held(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the signature (N, d, p) as a bias follows it: beyond what it was fitted on it holds, as a clamped map.

        Without a memory its channels are held at the ends of their domain. What remembers must see them as they are,
        and its regressors are held at the ends of what they were in the fit.
        """
        if self.regressors is None:
            return self.signature(self.within_domain(chunk), memory)
        signature, memory = self.signature(chunk, memory)
        return self.within_regressors(signature), memory

    def within_domain(self, chunk: Chunk) -> Chunk:
        """Return the chunk with each channel held at the nearer end of the domain."""
        inside = {name: _clipped(chunk[name], self.ends(name)) for name in self.domain or {} if name in chunk.channels}
        return chunk.having(**inside) if any(values is not chunk[name] for name, values in inside.items()) else chunk

    def within_regressors(self, signature: Array) -> Array:
        """Return a signature (N, d, p) with each regressor held at its ends; one that is zero is of another axis."""
        if not self.regressors:
            return signature
        low, high = np.asarray(self.regressors).T
        if np.all((signature == 0) | ((signature >= low) & (signature <= high))):
            return signature
        return np.where(signature == 0, 0.0, np.clip(signature, low, high))

    @property
    def acts_on_input(self) -> bool:
        """True if the effect changes the temperature that the map sees."""
        return type(self).input is not Effect.input

    @property
    def fades(self) -> bool:
        """True if the effect has a memory of what came before the recording."""
        return type(self).fading is not Effect.fading

    @property
    def walks(self) -> bool:
        """True if the effect runs with time alone, as a walk of the bias may."""
        return not self.requires and self.course != "line"

    @property
    def hyper_parameters(self) -> dict[str, float]:
        """Values of the `continuous` hyper-parameters by name, in SI."""
        return {name: float(value) for name, value in self if name in self.continuous}

    def units_of(self, bias: str) -> tuple[str, ...]:
        """Return `units` where the bias is in the unit `bias`."""
        return tuple(unit.replace("bias", bias) for unit in self.units)

    @property
    def realised(self) -> tuple[Signal, ...] | None:
        """The realisation as `held` has it: with its channels, or its regressors, at the ends of what was fitted on."""
        signals = self.realisation()
        if signals is not None and self.regressors is not None:
            return tuple(Limited(signal, *ends) for signal, ends in zip(signals, self.regressors, strict=False))
        if signals is None or self.domain is None:
            return signals
        ends = {name: self.ends(name).tolist() for name in self.domain}
        return tuple(limited(signal, ends) for signal in signals)


def as_measured(chunk: Chunk) -> Chunk:
    """Return the chunk as effects see it: an application's own smoothing of the temperature is none of theirs."""
    return chunk.having(temperature=chunk["temperature_raw"]) if "temperature_raw" in chunk.channels else chunk


def _clipped(values: Array, ends: Array) -> Array:
    """Return values (N,) or (N, columns) within the ends (columns, 2): the very same where all are."""
    low, high = ends.T
    return values if np.all((values >= low) & (values <= high)) else np.clip(values, low, high)


def on_each_axis(terms: Array, d: int) -> Array:
    """Return regressors (N, d, d q) of an effect that acts on every axis alike: terms (N,) or (N, q) times I."""
    values = terms.reshape(len(terms), -1)
    spread = np.zeros((len(values), d, d, values.shape[1]))
    spread[:, np.arange(d), np.arange(d)] = values[:, None]
    return spread.reshape(len(values), d, -1)


_SLOPE = 1e-4  # of a function's range: the step over which its slope at the ends is taken


@dataclass(frozen=True)
class Reading:
    """A column of a channel that has so many columns."""

    channel: str
    column: int = 0
    columns: int = 1


@dataclass(frozen=True)
class Elapsed:
    """The time since the first sample, s."""


@dataclass(frozen=True)
class Fading:
    """exp(-t / tau), with t since the first sample."""

    tau: float  # s


@dataclass(frozen=True)
class Behind:
    """The part of a signal that a first-order lag has not followed yet; the signal is straight between its samples."""

    of: Signal
    tau: float  # s


@dataclass(frozen=True)
class PlayState:
    """The state of a play operator in its loop: its output less its input, from -width / 2 to width / 2."""

    of: Signal
    width: float


@dataclass(frozen=True)
class Weighted:
    """A weighted sum of signals, and a constant."""

    terms: tuple[tuple[float, Signal], ...]
    offset: float = 0.0


@dataclass(frozen=True)
class Product:
    """The product of two signals."""

    a: Signal
    b: Signal


@dataclass(frozen=True)
class Limited:
    """A signal between two limits."""

    of: Signal
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Function:
    """A smooth function of a signal u (N,) -> (N,) on a range; beyond, its value at the end or its tangent there."""

    of: Signal
    values: Callable[[Array], Array]
    low: float
    high: float
    beyond: Literal["constant", "tangent"] = "constant"

    def at(self, u: Array) -> Array:
        """Return the function of u (N,), also beyond its range."""
        low, high = self.low, self.high
        edge = np.clip(u, low, high)
        values = np.asarray(self.values(edge))
        if self.beyond == "constant" or np.all(edge == u):
            return values
        step = _SLOPE * (high - low)
        k = np.arange(3)
        f, g = np.asarray(self.values(np.concatenate([low + step * k, high - step * k]))).reshape(2, 3)
        ends = np.array([-1.5, 2.0, -0.5]) / step  # one-sided differences of second order
        slope = np.where(u < low, ends @ f, -ends @ g)
        return np.asarray(values + slope * (u - edge))


Signal: TypeAlias = Reading | Elapsed | Fading | Behind | PlayState | Weighted | Product | Limited | Function

TEMPERATURE = Reading("temperature")


def lagged(of: Signal, tau: float) -> Signal:
    """Return a signal through a first-order lag."""
    return Weighted(((1.0, of), (-1.0, Behind(of, tau))))


def parts_of(signal: Signal) -> tuple[Signal, ...]:
    """Return the signals that a signal is made of."""
    match signal:
        case Behind() | PlayState() | Limited() | Function():
            return (signal.of,)
        case Weighted():
            return tuple(part for _, part in signal.terms)
        case Product():
            return (signal.a, signal.b)
        case _:
            return ()


def limited(signal: Signal, ends: Mapping[str, Sequence[tuple[float, float]]]) -> Signal:
    """Return a signal whose channels are held at their ends, a pair of limits a column.

    A function of a channel stays one: its table is as long as what the channel is held to.
    """
    match signal:
        case Reading() if signal.channel in ends:
            return Limited(signal, *ends[signal.channel][signal.column])
        case Function(of=Reading() as of) if of.channel in ends:
            low, high = ends[of.channel][of.column]
            if low < high:
                return Function(of, signal.at, low, high)
            return replace(signal, values=lambda u: signal.at(np.full_like(u, low)), beyond="constant")
        case Behind() | PlayState() | Limited() | Function():
            return replace(signal, of=limited(signal.of, ends))
        case Weighted():
            return replace(signal, terms=tuple((weight, limited(part, ends)) for weight, part in signal.terms))
        case Product():
            return replace(signal, a=limited(signal.a, ends), b=limited(signal.b, ends))
        case _:
            return signal


def walk(signal: Signal) -> Iterator[Signal]:
    """Yield all that a signal is made of, parts before what they are parts of, and itself last."""
    for part in parts_of(signal):
        yield from walk(part)
    yield signal
