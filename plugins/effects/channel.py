"""Channel: a bias that is proportional to an auxiliary channel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Memory, on_each_axis
from fusion_core.contracts.effect import Reading, Signal
from fusion_core.hookspecs import hookimpl
from fusion_plugins.effects.common import OfChannel, auxiliary


@hookimpl
class Channel(OfChannel):
    """A channel as it is; one with several columns acts with each of them."""

    unit: ClassVar = "bias per SI unit of the channel"
    explanation: ClassVar = (
        "Supply voltage, pressure or a magnetic field reach the sensor's drive, its cavity or its readout; to first "
        "order the bias follows them linearly. IEEE Std 1431-2004, environmentally sensitive terms."
    )

    kind: Literal["channel"] = "channel"
    channel: str = "voltage"
    """Name of the auxiliary channel."""
    columns: Annotated[int, Field(ge=1, le=64)] = 1
    """Number of columns of the channel."""

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield every auxiliary channel."""
        for name in auxiliary(recordings):
            columns = recordings[0][name].reshape(len(recordings[0]), -1).shape[1]
            yield self.model_copy(update={"channel": name, "columns": columns})

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the channel; there is no memory."""
        return on_each_axis(chunk[self.channel], len(self.axes)), None

    def realisation(self) -> tuple[Signal, ...]:
        """Return the channel's columns."""
        return tuple(Reading(self.channel, column, self.columns) for column in range(self.columns))

    @property
    def terms(self) -> tuple[str, ...]:
        """One a column."""
        return ("",) if self.columns == 1 else tuple(f"{self.channel}_{k}" for k in range(self.columns))
