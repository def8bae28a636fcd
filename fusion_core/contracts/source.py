"""The contract of sources: where samples come from.

The contract of sources that simulate a recording, whose truth is therefore known.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.plugin import Plugin
from fusion_core.contracts.sensor import Site
from fusion_core.faults import Faults
from fusion_core.units import Unit


class Source(Plugin):
    """A source of samples."""

    live: ClassVar[bool] = False  # whether samples come as they are measured, without an end

    @abstractmethod
    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the recording as chunks of at most `size` samples, in SI units.

        A live source yields what has come at once, and an empty chunk when nothing has for a second, so that its
        reader can look up. A source gives what it has, NaN included: rows that cannot be used are left out, the same
        way for every source, by `fusion_core.faults.usable`. What only the source can see (a torn line) it reports to
        `faults`; a live one that knows why nothing comes says so in `faults.unavailable` as long as it lasts.
        """

    def about(self, channel: str) -> Mapping[str, str]:
        """Return the properties of a channel's device that the recording holds, by name, for the record of its map."""
        return {}

    def of_file(self, path: Path) -> Source | None:
        """Return the source that reads from a file the bytes that a live one would have heard; None where none can."""
        return None

    @property
    def name(self) -> str:
        """Name of the source in messages and provenance, e.g. its path."""
        return self.kind


@dataclass(frozen=True)
class Twin:
    """The truth of a simulated unit and its chamber, which is not known of a real one.

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
    """Duration; the source's own by default."""

    @property
    def site(self) -> Site | None:
        """Site of the sensors, None where the source has none; no latitude: the Earth stands still."""
        return None

    @property
    def twin(self) -> Twin | None:
        """The unit and its chamber, None where the source has none to tell of."""
        return None
