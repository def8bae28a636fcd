"""What the C code of one sensor runs: tables of the temperature and of other signals, and signals with a memory.

::

    bias = table_1(u_1) + table_2(u_2) + ... + weights s

A signal that is asked for twice is computed once. d axes, q signals s with weights.

Knots of straight lines that follow a curve: as few as a given loss allows, in as few bytes.

There are as many knots as the smallest largest error (minimax) asks for to be within the loss; for a smooth curve it is
half the error of lines between points of the curve itself. Of all such lines they are those with the smallest mean
error. Both are linear programs. Where 16-bit integers and a scale for each axis are fine enough, the knots are those.
n knots, d axes, M places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, Effect
from fusion_core.contracts.effect import TEMPERATURE, Function, Reading, Signal, walk

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


Kind = TypeVar("Kind", bound=Signal)

BEYOND = np.float32(100.0)  # K: a temperature further outside of the map is taken for that
LARGEST = np.float32(1e9)  # of another channel


@dataclass(frozen=True, eq=False)
class Program:
    """What the code of a sensor of d axes computes.

    Attributes
    ----------
    tables : tuple of Table
    signals : tuple of q Signal
        With weights of their own.
    weights : (d, q) array of float32
    """

    tables: tuple[LookupTable, ...]
    signals: tuple[Signal, ...]
    weights: Single

    @property
    def d(self) -> int:
        """How many axes."""
        return len(self.weights)

    @cached_property
    def nodes(self) -> tuple[Signal, ...]:
        """All signals, parts before what they are parts of."""
        asked = (*(table.of for table in self.tables), *self.signals)
        return tuple(dict.fromkeys(part for signal in (TEMPERATURE, *asked) for part in walk(signal)))

    @property
    def channels(self) -> dict[str, int]:
        """The channels that are read besides temperature, with how many columns."""
        read = (node for node in self.nodes if isinstance(node, Reading) and node != TEMPERATURE)
        return {node.channel: node.columns for node in read}

    @property
    def remembers(self) -> bool:
        """Whether there is anything but tables of the temperature."""
        return bool(self.signals) or any(table.of != TEMPERATURE for table in self.tables)

    def limits(self, reading: Reading) -> tuple[np.float32, np.float32, np.float32]:
        """Return what a channel is taken for before its first finite value, and between what it is held."""
        if not reading.channel.startswith("temperature"):
            return np.float32(0.0), -LARGEST, LARGEST
        lowest = min(table.lowest for table in self.resting)
        return lowest, lowest - BEYOND, max(table.highest for table in self.resting) + BEYOND

    def numbered(self, kind: type[Kind]) -> dict[Kind, int]:
        """Return the signals of a kind, with their numbers."""
        return {node: k for k, node in enumerate(node for node in self.nodes if isinstance(node, kind))}

    @property
    def resting(self) -> tuple[LookupTable, ...]:
        """The map's table, the first, and others of the temperature: what there is in a steady temperature."""
        first, *others = self.tables
        return (first, *(table for table in others if table.of == TEMPERATURE))


def program_of(sensor: Calibrated, loss: Array, *, floats: bool) -> Program | None:
    """Return the program of a sensor whose effects are all realisable; None where no table keeps the loss (d,).

    `floats` asks for knots in single precision, also where integers would do.
    """
    low, high = sensor.fitted.domain
    seen: Signal = TEMPERATURE
    for effect in sensor.effects:
        seen = effect.realised_input(seen) or seen
    curves: dict[Signal, list[_Part]] = {seen: [_Part(_clipped(sensor), low, high)]}
    signals: dict[Signal, Array] = {}
    for effect in sensor.effects:
        for signal, column in _terms(effect, len(sensor.axes)):
            if isinstance(signal, Function):
                part = _Part(_times(signal, column), signal.low, signal.high)
                curves.setdefault(signal.of, []).append(part)
            else:
                signals[signal] = signals.get(signal, 0.0) + column
    tables = []
    for of, parts in curves.items():
        domain = min(part.low for part in parts), max(part.high for part in parts)
        table = fewest(of, _summed(parts), domain, loss / len(curves), floats=floats)
        if table is None:
            return None
        tables.append(table)
    weights = np.stack(list(signals.values()), axis=1) if signals else np.zeros((len(sensor.axes), 0))
    return Program(tuple(tables), tuple(signals), weights.astype(np.float32))


def why_not(effect: Effect) -> str | None:
    """Return why an effect cannot be run by a program; None where it can."""
    signals = effect.realised
    if signals is None or effect.realised_input(TEMPERATURE) is None:
        return "it cannot be computed from channels and time since switch-on"
    if effect.terms and effect.coefficients is None:
        return "it has no coefficients"
    if any(isinstance(part, Function) for signal in signals for part in walk(signal) if part is not signal):
        return "it is made of functions of functions"
    return None


def channels_of(effect: Effect) -> set[str]:
    """Return the channels that an effect reads besides temperature."""
    return {name for name in effect.requires if name != "temperature"}


@dataclass(frozen=True)
class _Part:
    """A function (N,) -> (N, d) that is added to a table, and its range."""

    curve: Callable[[Array], Array]
    low: float
    high: float


def _terms(effect: Effect, d: int) -> Iterable[tuple[Signal, Array]]:
    """Yield the signals of an effect, each with its coefficients (d,)."""
    signals = effect.realised or ()
    coefficients = np.asarray(effect.coefficients or (), dtype=np.float64).reshape(d, len(signals))
    return zip(signals, coefficients.T, strict=True)


def _clipped(sensor: Calibrated) -> Callable[[Array], Array]:
    return lambda T: sensor.fitted.bias(np.clip(T, *sensor.fitted.domain))


def _times(function: Function, column: Array) -> Callable[[Array], Array]:
    return lambda u: function.at(u)[:, None] * column


def _summed(parts: list[_Part]) -> Callable[[Array], Array]:
    return lambda u: np.asarray(sum(part.curve(u) for part in parts))


Single = NDArray[np.float32]
Curve = Callable[[Array], Array]

MOST = 1000  # knots
_BETWEEN = 12  # places an interval at which the error is looked at
_KEPT = 0.99  # of the loss: the rest is for the curve between those places, and for single precision
_RESOLVED = 0.1  # of the loss: the largest error of rounding to integers


@dataclass(frozen=True, eq=False)
class LookupTable:
    """Straight lines between knots a fixed step apart; beyond the first and the last, their values.

    Attributes
    ----------
    of : Signal
        What is looked up.
    lowest, highest : float32
        Where the first and the last knot are.
    per_unit : float32
        Intervals to a unit of what is looked up.
    knots : (n, d) array of float32
    whole : bool
        Whether knots are whole numbers, and the bias offset + scale times the lines between them.
    offset, scale : (d,) array of float32
    """

    of: Signal
    lowest: np.float32
    highest: np.float32
    per_unit: np.float32
    knots: Single
    whole: bool
    offset: Single
    scale: Single

    @property
    def size(self) -> int:
        """Bytes of the constants."""
        return self.knots.size * 2 + 8 * self.knots.shape[1] if self.whole else self.knots.size * 4


def fewest(of: Signal, curve: Curve, domain: tuple[float, float], loss: Array, *, floats: bool) -> LookupTable | None:
    """Return the table with the fewest knots that is off from the curve by at most `loss` (d,); None beyond MOST.

    `floats` asks for knots in single precision whatever their size.
    """
    lowest, highest = (np.float32(end) for end in domain)
    ends = curve(np.linspace(*domain, MOST))
    offset = ((ends.max(axis=0) + ends.min(axis=0)) / 2).astype(np.float32)
    # a knot is a place too, so it is off from the curve by no more than the loss: that much beyond the curve's ends
    scale = ((1.01 * np.ptp(ends, axis=0) / 2 + loss) / 32767).astype(np.float32)
    whole = not floats and bool(np.all(scale / 2 <= _RESOLVED * loss))
    most = _KEPT * loss - (scale / 2 if whole else 0.0)
    n = _count(curve, domain, most)
    if n is None:
        return None
    knots = np.stack([_knots(v, n, e) for v, e in zip(_values(curve, domain, n).T, most, strict=True)], axis=1)
    if whole:
        knots = np.round((knots - offset) / scale)
    per_unit = np.float32((n - 1) / (float(highest) - float(lowest)))
    return LookupTable(of, lowest, highest, per_unit, knots.astype(np.float32), whole, offset, scale)


def _count(curve: Curve, domain: tuple[float, float], most: Array) -> int | None:
    """Return the smallest number of knots whose lines keep the error below `most` (d,)."""

    def keeps(n: int) -> bool:
        values = _values(curve, domain, n)
        return all(_minimax(own, n)[1] <= error for own, error in zip(values.T, most, strict=True))

    few, enough = 1, 2
    while not keeps(enough):
        if enough == MOST:
            return None
        few, enough = enough, min(2 * enough, MOST)
    while enough - few > 1:
        middle = (few + enough) // 2
        few, enough = (few, middle) if keeps(middle) else (middle, enough)
    return enough


def _values(curve: Curve, domain: tuple[float, float], n: int) -> Array:
    """Return the curve at each of the places (M, d) between n knots, ends included."""
    return curve(np.linspace(*domain, (n - 1) * _BETWEEN + 1))


def _lines(M: int, n: int) -> csr_matrix:
    """Return the matrix (M, n) that draws lines between n knots."""
    from scipy import sparse

    x, row = np.arange(M) / _BETWEEN, np.arange(M)
    k = np.minimum(x.astype(np.int64), n - 2)
    share = np.concatenate([1 - (x - k), x - k])
    return sparse.csr_matrix((share, (np.tile(row, 2), np.concatenate([k, k + 1]))), (M, n))


def _knots(values: Array, n: int, most: float) -> Array:
    """Return the knots (n,) with the smallest mean error from values (M,) of those with errors within `most`.

    Minimise t_1 + ... + t_M such that -t <= B c - values <= t and t <= most.
    """
    from scipy import sparse

    return _solved(values, n, sparse.identity(len(values)), most)[0]


def _minimax(values: Array, n: int) -> tuple[Array, float]:
    """Return the knots (n,) whose lines have the smallest largest error from values (M,), and that error.

    Minimise t such that -t <= B c - values <= t.
    """
    return _solved(values, n, np.ones((len(values), 1)), np.inf)


def _solved(values: Array, n: int, t: Any, most: float) -> tuple[Array, float]:
    """Return c (n,) and the sum of t of a linear program; t (M, k) says which of the k bounds each place has."""
    from scipy import sparse
    from scipy.optimize import linprog

    middle, scale = float(values[0]), float(np.ptp(values)) or 1.0
    B, t = _lines(len(values), n), sparse.csr_matrix(t)
    A = sparse.vstack([sparse.hstack([B, -t]), sparse.hstack([-B, -t])], format="csc")
    aim = (values - middle) / scale
    k = t.shape[1]
    found = linprog(
        np.concatenate([np.zeros(n), np.ones(k)]),
        A_ub=A,
        b_ub=np.concatenate([aim, -aim]),
        bounds=[(None, None)] * n + [(0.0, most / scale)] * k,
        method="highs",
    )
    if found.x is None or found.fun is None:  # `most` is what lines can keep: only by rounding of the solver
        return _minimax(values, n)
    return found.x[:n] * scale + middle, float(found.fun) * scale
