"""What is known of a line: its charts, its changes, its limits. m values of a chart; all values in SI."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.family.capability import Capability
from driftlab.family.scale import Scale
from driftlab.units import RATE, BiasUnit
from fusion_core.chunk import Array

LEVEL = "level"
PER = {"noise": "/sqrt(Hz)", "walk": "/sqrt(s)"}


@dataclass(frozen=True)
class Change:
    """A step of one quantity of one axis.

    Attributes
    ----------
    at, low, high : int
        Place in the line of the first unit after it, and the 95 % interval of that.
    before, after : float
        What is usual (SI) in the stretches on either side of it.
    error : float
        Deviation of the difference, in the chart's scale.
    p : float
        Probability of such a step anywhere in this chart by chance.
    of_lot : str
        The lot that is off, where the line begins or ends it there and is afterwards as before; else empty.
    """

    at: int
    low: int
    high: int
    before: float
    after: float
    error: float
    p: float
    of_lot: str = ""


@dataclass(frozen=True)
class Trend:
    """A quantity that rises or falls all along the line: what is usual (SI) of its first and of its last unit."""

    before: float
    after: float


@dataclass(frozen=True)
class Lot:
    """The units of one lot: their count, their mean (SI), the limits of means of so many, whether it is beyond them."""

    name: str
    n: int
    mean: float
    low: float
    high: float
    out: bool


@dataclass(frozen=True, eq=False)
class Control:
    """The control chart of one quantity of one axis; m units have it.

    Attributes
    ----------
    quantity, axis, unit : str
        One of FIGURES, or `level`; the unit is SI.
    at : (m,) int array
        Places of the units in the line.
    value : (m,) array
    scale : Scale
        In which the limits lie alike above and below.
    normal : float
        Probability of values as little normal in that scale about their stretches, if they were.
    basis : (start, stop)
        Places in the line of the units on which the limits stand, unless `of_family`.
    centre, spread : float
        Of a line in control: its middle (SI), and the deviation between units in the scale.
    low, high : (m,) arrays
        Shewhart's limits.
    ewma, ewma_low, ewma_high : (m,) arrays
        The EWMA and its limits, as values of a unit whose own deviation is the middle one.
    beyond, drifting : (m,) bool arrays
        Alarms of either chart.
    changes : tuple of Change
    trend : Trend or None
        Where a straight line says more than steps; then there are no changes.
    lots : tuple of Lot
        In the order of their first units.
    of_family : bool
        Whether centre and limits are those of a family that was known.
    """

    quantity: str
    axis: str
    unit: str
    at: NDArray[np.intp]
    value: Array
    scale: Scale
    normal: float
    basis: tuple[int, int]
    centre: float
    spread: float
    low: Array
    high: Array
    ewma: Array
    ewma_low: Array
    ewma_high: Array
    beyond: NDArray[np.bool_]
    drifting: NDArray[np.bool_]
    changes: tuple[Change, ...]
    lots: tuple[Lot, ...]
    trend: Trend | None = None
    of_family: bool = False


@dataclass(frozen=True, eq=False)
class Line:
    """A line, its units in the order in which they were made.

    Attributes
    ----------
    units, lots, dates : tuple of str
    order : str
        What the order stands on, in a sentence.
    axes : tuple of str
    unit : BiasUnit
        Of the bias: in SI, and as it is shown.
    controls : tuple of Control
    capability : tuple of Capability
    too_few : tuple of str
        What has no chart because fewer than FEWEST units have it.
    sentences : tuple of str
        What the line did, in words: changes, where it is now, its limits.
    """

    units: tuple[str, ...] = ()
    lots: tuple[str, ...] = ()
    dates: tuple[str, ...] = ()
    order: str = ""
    axes: tuple[str, ...] = ()
    unit: BiasUnit = RATE
    controls: tuple[Control, ...] = ()
    capability: tuple[Capability, ...] = ()
    too_few: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()

    def shown(self, quantity: str) -> BiasUnit:
        """Return the unit of a quantity."""
        per = PER.get(quantity, "")
        return BiasUnit(self.unit.si + per, self.unit.shown + per)
