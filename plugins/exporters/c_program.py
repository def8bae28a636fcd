"""What the C code of one sensor runs: tables of the temperature and of other signals, and signals with a memory.

::

    bias = table_1(u_1) + table_2(u_2) + ... + weights s

A signal that is asked for twice is computed once. d axes, q signals s with weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, Effect
from fusion_core.contracts.realisation import TEMPERATURE, Function, Reading, Signal, walk
from fusion_plugins.exporters.c_tables import Single, Table, fewest

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

    tables: tuple[Table, ...]
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
    def resting(self) -> tuple[Table, ...]:
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
