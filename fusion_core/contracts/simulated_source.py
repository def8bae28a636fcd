"""The contract of sources that simulate a recording, whose truth is therefore known."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from fusion_core.contracts.sensor import Site
from fusion_core.contracts.source import Source
from fusion_core.units import Unit


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
