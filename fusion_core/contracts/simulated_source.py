"""The contract of sources that simulate a recording, whose truth is therefore known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from fusion_core.chunk import Array
from fusion_core.contracts.sensor import Site
from fusion_core.contracts.source import Source
from fusion_core.units import Unit


@dataclass(frozen=True)
class Twin:
    """What a simulated unit is, and the chamber that it is in: what is not known of a real one.

    Attributes
    ----------
    channel : str
        Whose bias it is.
    noise, walk : (d,) arrays
        Densities of the white noise and the random walk of the bias, in its unit/sqrt(Hz) and its unit/sqrt(s).
    curve : function of T (N,) in degC -> (N, d)
        The bias over temperature.
    time, temperature : (M,) arrays
        Set points of the chamber in s and degC, straight lines in between.
    lag : float
        Time constant with which the unit follows, s.
    """

    channel: str
    noise: Array
    walk: Array
    curve: Callable[[Array], Array]
    time: Array
    temperature: Array
    lag: float


class SimulatedSource(Source):
    """Samples that are made up: with the same settings the same, to the bit."""

    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 0
    """Seed of the random numbers: the same gives the same samples."""
    duration: Annotated[float, Unit("s", positive=True, example="20 min")] | None = None
    """How long it lasts; as long as the source itself has it by default."""

    @property
    def site(self) -> Site | None:
        """Where the sensors are taken to be, None where that says nothing; no latitude: the Earth stands still."""
        return None

    @property
    def twin(self) -> Twin | None:
        """The unit and its chamber, None where the source has none to tell of."""
        return None
