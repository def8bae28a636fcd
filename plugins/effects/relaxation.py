"""Relaxation: a bias that answers to a change of temperature, or of a channel, at once and then forgets it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Memory, on_each_axis
from fusion_core.contracts.effect import Behind, Reading, Signal, lagged
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import FadingLag, OfChannel, lag_of, longest_span, scalars, up_to, varied

_SHORTEST, _LONGEST = 20.0, 36_000.0  # s
_OF_TEMPERATURE, _OF_CHANNEL = 26, 8  # time constants to try
_OF_SPAN = 0.5  # longest time constant to try, of the longest recording: beyond, it is the channel itself


@hookimpl
class Relaxation(FadingLag, OfChannel):
    """u - lag(u): what of the channel u a first-order lag tau has not followed yet; or, where it acts late, lag(u)."""

    continuous: ClassVar = {"tau": 2.0}
    several: ClassVar = True
    explanation: ClassVar = (
        "Two parts of the sensor follow the channel unequally fast, the thermometer on the oven's wall and the element "
        "behind a thermal resistance (Incropera et al., Fundamentals of Heat and Mass Transfer, Wiley (2007), section "
        "5.1, lumped capacitance), or die attach and glue take up stress at once and let it go by viscoelastic creep "
        "(J. D. Ferry, Viscoelastic Properties of Polymers, Wiley (1980)): the bias follows the difference to a lag."
    )

    kind: Literal["relaxation"] = "relaxation"
    channel: str = "temperature"
    """Name of the channel that the bias answers to."""
    tau: Annotated[float, Unit("s", positive=True, example="20 min")] = Quantity(1200.0, "20 min")
    """Time constant of the lag."""
    form: Literal["relaxed", "late"] = "relaxed"
    """Input: the channel less its lag (relaxed), or the lag (late)."""

    def candidates(self) -> Iterator[Self]:
        """Yield time constants from 20 s to 10 h."""
        return varied(self, "tau", _grid(self.channel).tolist())

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield the grid for temperature and for every auxiliary channel of one column, up to half the longest span."""
        most = _OF_SPAN * longest_span(recordings)
        for name in scalars(recordings):
            # what follows the temperature itself, late or not, is the map's
            for form in ("relaxed",) if name == "temperature" else ("relaxed", "late"):
                acting = self.model_copy(update={"channel": name, "form": form})
                yield from varied(acting, "tau", up_to(_grid(name), most))

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return u - lag(u), or lag(u), from equilibrium; the memory is the last u and the last output of the lag."""
        u = chunk[self.channel]
        output, memory = lag_of(chunk, u, self.tau, memory)
        return on_each_axis(output if self.form == "late" else u - output, len(self.axes)), memory

    def realisation(self) -> tuple[Signal, ...]:
        """Return the part that the lag has not followed, or the lag."""
        u, tau = Reading(self.channel), float(self.tau)
        return (lagged(u, tau) if self.form == "late" else Behind(u, tau),)

    @property
    def variant(self) -> str:
        """Its form."""
        return self.form

    @property
    def units(self) -> tuple[str, ...]:
        """Of the channel: kelvin, or its SI unit."""
        thermometer = self.channel.startswith("temperature")
        return ("bias/K" if thermometer else "bias per SI unit of the channel",) * len(self.labels)


def _grid(channel: str) -> Array:
    """Return the time constants to try, s."""
    return np.geomspace(_SHORTEST, _LONGEST, _OF_TEMPERATURE if channel == "temperature" else _OF_CHANNEL)
