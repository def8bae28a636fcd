"""What is frozen from a stretch at rest, and what tells rest from motion. N epochs, d axes of a sensor, D of all."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.plugin import Memory
from fusion_core.model import Flags


class Patience(NamedTuple):
    """When a measurement is refused, and after how many seconds of refusals at a new rest the filter begins anew."""

    false_alarm: float
    realign_after: float


@dataclass(frozen=True)
class Alignment:
    """What is frozen at the end of a stretch at rest.

    Attributes
    ----------
    t : float
        Time of the last epoch of the stretch, s.
    dt : float
        The usual duration of an epoch, s.
    inputs : dict of str to (d,) array
        What each ideal sensor shows at rest, in its unit.
    noise_ratio : dict of str to (d,) array
        Measured white noise over declared noise, for each sensor.
    unsure : (d,) array
        Deviation of the tracked sensor's input, in its unit: the Earth rate that a tilted vertical leaves.
    up : (3,) array or None
        Unit vector up in the axes of the unit, where that is known.
    levels : dict of str to (d,) array
        Mean reading less input over the stretch, a first look at the bias, where the model asks for it.
    notes : tuple of str
        What one should know of it, a sentence each.
    """

    t: float
    dt: float
    inputs: dict[str, Array]
    noise_ratio: dict[str, Array]
    unsure: Array
    up: Array | None = None
    levels: dict[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @cached_property
    def gate_scale(self) -> float:
        """How much larger the innovations may be because the declared noise is too small."""
        worst = max((float(np.mean(ratio**2)) for ratio in self.noise_ratio.values()), default=1.0)
        return max(1.0, worst)


class Detector(ABC):
    """Tells from the sensors alone, without map, bias model and filter, where they are not at their known input."""

    axes: tuple[tuple[str, str], ...]  # channel and name of the D axes that it looks at

    @abstractmethod
    def start(self) -> Memory:
        """Return the memory before the first epoch."""

    @abstractmethod
    def look(self, chunk: Chunk, memory: Memory) -> tuple[Flags, Flags, Memory]:
        """Return which epochs are still (N,), which axes stand out in each (N, D), and the memory."""


@dataclass(frozen=True)
class AlwaysStill(Detector):
    """The detector of sensors that cannot move."""

    axes: tuple[tuple[str, str], ...] = field(default=())

    def start(self) -> Memory:
        """Return nothing."""
        return None

    def look(self, chunk: Chunk, memory: Memory) -> tuple[Flags, Flags, Memory]:
        """Return that every epoch is still."""
        return np.ones(len(chunk), dtype=np.bool_), np.zeros((len(chunk), len(self.axes)), dtype=np.bool_), memory
