"""The program of one sensor's C code: tables of the temperature and of other signals, and signals with a memory.

::

    bias = table_1(u_1) + table_2(u_2) + ... + weights s
    input = r + N(T) r,    r = reading - bias,    N = (I + M)^-1 - I

The second is of a map with scale factor and misalignment, and N a table of nine columns. A signal that is asked for
twice is computed once. d axes, q signals s with weights.

Knots of straight lines that follow a curve: as few as a given loss allows, in as few bytes.

There are as many knots as the smallest largest error (minimax) asks for to be within the loss; for a smooth curve it is
half the error of lines between points of the curve itself. Of all such lines they are those with the smallest mean
error. Both are linear programs. Where 16-bit integers and a scale for each axis are fine enough, the knots are those.
n knots, d axes, M places.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, Effect, TriadMatrix
from fusion_core.contracts.effect import TEMPERATURE, Behind, Function, PlayState, Reading, Signal, walk

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


BEYOND = np.float32(100.0)  # K: a temperature further outside of the map is taken for that
LARGEST = np.float32(1e9)  # of another channel


@dataclass(frozen=True, eq=False)
class Program:
    """The computation of a sensor of d axes.

    Attributes
    ----------
    tables : tuple of Table
    signals : tuple of q Signal
        With weights of their own.
    weights : (d, q) array of float32
    matrix : LookupTable or None
        N, row by row.
    """

    tables: tuple[LookupTable, ...]
    signals: tuple[Signal, ...]
    weights: Single
    matrix: LookupTable | None = None

    @property
    def d(self) -> int:
        """Number of axes."""
        return len(self.weights)

    @property
    def lookups(self) -> tuple[LookupTable, ...]:
        """All tables: those of the bias, then the matrix."""
        return self.tables if self.matrix is None else (*self.tables, self.matrix)

    @cached_property
    def nodes(self) -> tuple[Signal, ...]:
        """All signals, parts before what they are parts of."""
        outputs = (*(table.of for table in self.tables), *self.signals)
        return tuple(dict.fromkeys(part for signal in (TEMPERATURE, *outputs) for part in walk(signal)))

    @property
    def channels(self) -> dict[str, int]:
        """The channels that are read besides temperature, with how many columns."""
        read = (node for node in self.nodes if isinstance(node, Reading) and node != TEMPERATURE)
        return {node.channel: node.columns for node in read}

    @property
    def remembers(self) -> bool:
        """True if there is anything but tables of the temperature."""
        return bool(self.signals) or any(table.of != TEMPERATURE for table in self.tables)

    def limits(self, reading: Reading) -> tuple[np.float32, np.float32, np.float32]:
        """Return the value of a channel before its first finite one, and the limits that it is held between."""
        if not reading.channel.startswith("temperature"):
            return np.float32(0.0), -LARGEST, LARGEST
        lowest, highest = self.ends
        return lowest, lowest - BEYOND, highest + BEYOND

    @property
    def ends(self) -> tuple[np.float32, np.float32]:
        """The lowest and the highest temperature of the tables, degC."""
        return min(table.lowest for table in self.resting), max(table.highest for table in self.resting)

    def numbered(self, *kinds: str) -> dict[Signal, int]:
        """Return the signals of some kinds, named by their classes, with their numbers."""
        return {node: k for k, node in enumerate(node for node in self.nodes if type(node).__name__ in kinds)}

    @property
    def needed_at_start(self) -> set[Signal]:
        """All parts of the inputs with which memories begin in equilibrium."""
        return {part for node in self.nodes if isinstance(node, Behind | PlayState) for part in walk(node.of)}

    @property
    def resting(self) -> tuple[LookupTable, ...]:
        """The map's table, the first, and others of the temperature: those that count in a steady temperature."""
        first, *others = self.tables
        return (first, *(table for table in others if table.of == TEMPERATURE))


def program_of(sensor: Calibrated, loss: Array, *, floats: bool) -> Program | None:
    """Return the program of a sensor whose effects are all realisable; None where no table keeps the loss (d,).

    `floats` asks for knots in single precision, also where integers would do.
    """
    low, high = sensor.fitted.domain
    temperature: Signal = TEMPERATURE
    for effect in sensor.effects:
        temperature = effect.realised_input(temperature) or temperature
    signals: dict[Signal, Array] = {}
    functions: dict[Signal, list[tuple[Function, Array]]] = {temperature: []}  # with coefficients (d,), by their inputs
    for effect in sensor.effects:
        realised = effect.realised or ()
        coefficients = np.asarray(effect.coefficients or (), dtype=np.float64).reshape(len(sensor.axes), len(realised))
        for signal, column in zip(realised, coefficients.T, strict=True):
            if isinstance(signal, Function):
                functions.setdefault(signal.of, []).append((signal, column))
            else:
                signals[signal] = signals.get(signal, 0.0) + column
    tables = []
    for of, parts in functions.items():

        def curve(u: Array, of: Signal = of, parts: list[tuple[Function, Array]] = parts) -> Array:
            of_map = [sensor.fitted.bias(np.clip(u, low, high))] if of is temperature else []
            return np.asarray(sum([*of_map, *(function.at(u)[:, None] * column for function, column in parts)]))

        ends = [end for function, _ in parts for end in (function.low, function.high)]
        ends += [low, high] if of is temperature else []
        table = fewest(of, curve, (min(ends), max(ends)), loss / len(functions), floats=floats)
        if table is None:
            return None
        tables.append(table)
    weights = np.stack(list(signals.values()), axis=1) if signals else np.zeros((len(sensor.axes), 0))
    matrix = None
    if sensor.matrix is not None:
        matrix = _matrix_table(sensor.matrix, (low, high), floats=floats)
        if matrix is None:
            return None
    return Program(tuple(tables), tuple(signals), weights.astype(np.float32), matrix)


def _matrix_table(matrix: TriadMatrix, domain: tuple[float, float], *, floats: bool) -> LookupTable | None:
    """Return the table of N = (I + M)^-1 - I, row by row, to a tenth of what the terms are known to, 0.1 to 10 ppm."""
    one, known = np.eye(3), np.nan_to_num(matrix.sigma(np.linspace(*domain, MATRIX_PLACES)))
    loss = np.clip(0.1 * np.sqrt(np.mean(known**2, axis=0)), 1e-7, 1e-5)

    def curve(T: Array) -> Array:
        return np.asarray((np.linalg.inv(one + matrix.at(T)) - one).reshape(-1, 9))

    return fewest(TEMPERATURE, curve, domain, loss, floats=floats)


def why_not(effect: Effect) -> str | None:
    """Return the reason that a program cannot run an effect; None where it can."""
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


Single = NDArray[np.float32]
Curve = Callable[[Array], Array]

MAX_KNOTS = 1000  # knots
_BETWEEN = 12  # places an interval at which the error is looked at
_KEPT = 0.99  # of the loss: the rest is for the curve between those places, and for single precision
MATRIX_PLACES = 200  # temperatures at which the matrix is looked at
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
    def d(self) -> int:
        """Number of columns."""
        return int(self.knots.shape[1])

    @property
    def size(self) -> int:
        """Bytes of the constants."""
        return self.knots.size * 2 + 8 * self.d if self.whole else self.knots.size * 4


def fewest(of: Signal, curve: Curve, domain: tuple[float, float], loss: Array, *, floats: bool) -> LookupTable | None:
    """Return the table with the fewest knots that is off from the curve by at most `loss` (d,); None beyond MAX_KNOTS.

    `floats` asks for knots in single precision whatever their size.
    """
    from scipy import sparse

    lowest, highest = (np.float32(end) for end in domain)
    ends = curve(np.linspace(*domain, MAX_KNOTS))
    offset = ((ends.max(axis=0) + ends.min(axis=0)) / 2).astype(np.float32)
    # a knot is a place too, so it is off from the curve by no more than the loss: that much beyond the curve's ends
    scale = ((1.01 * np.ptp(ends, axis=0) / 2 + loss) / 32767).astype(np.float32)
    whole = not floats and bool(np.all(scale / 2 <= _RESOLVED * loss))
    most = _KEPT * loss - (scale / 2 if whole else 0.0)
    n = _count(curve, domain, most)
    if n is None:
        return None
    # of all lines with errors within the limits those with the smallest mean error: minimise t_1 + ... + t_M such that
    # -t <= B c - values <= t and t <= most
    bounds = sparse.identity((n - 1) * _BETWEEN + 1)
    columns = zip(_values(curve, domain, n).T, most, strict=True)
    knots = np.stack([_solved(values, n, bounds, limit)[0] for values, limit in columns], axis=1)
    if whole:
        knots = np.round((knots - offset) / scale)
    per_unit = np.float32((n - 1) / (float(highest) - float(lowest)))
    return LookupTable(of, lowest, highest, per_unit, knots.astype(np.float32), whole, offset, scale)


def _count(curve: Curve, domain: tuple[float, float], most: Array) -> int | None:
    """Return the smallest number of knots whose lines keep the error below `most` (d,)."""

    def keeps(n: int) -> bool:
        values = _values(curve, domain, n)
        return all(_minimax(column, n)[1] <= error for column, error in zip(values.T, most, strict=True))

    few, enough = 1, 2
    while not keeps(enough):
        if enough == MAX_KNOTS:
            return None
        few, enough = enough, min(2 * enough, MAX_KNOTS)
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
    solution = linprog(
        np.concatenate([np.zeros(n), np.ones(k)]),
        A_ub=A,
        b_ub=np.concatenate([aim, -aim]),
        bounds=[(None, None)] * n + [(0.0, most / scale)] * k,
        method="highs",
    )
    if solution.x is None or solution.fun is None:  # `most` is what lines can keep: only by rounding of the solver
        return _minimax(values, n)
    return solution.x[:n] * scale + middle, float(solution.fun) * scale
