"""The contract of the framings: samples are cut out of a stream of bytes.

A stream may begin anywhere, be torn anywhere, and hold bytes that belong to no sample. A framing is asked for the
samples in the next bytes and hands back what it could not use yet as its memory. The law: any split of a stream gives
the same samples, and the same counts of what was rejected.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fusion_core.chunk import Array, Chunk, Integers
from fusion_core.contracts.plugin import Memory, Plugin
from fusion_core.errors import ConfigError

GARBAGE = "bytes that belong to no frame, left out"
DAMAGED = "frames whose checksum or constants are wrong, left out"
REPEATED = "frames repeated by the device, left out"


@dataclass(frozen=True)
class Counter:
    """A number in each frame by which a device counts.

    Attributes
    ----------
    modulo : int
        The value after which it starts at zero again.
    tick : float or None
        Duration of one count in s (a clock); None where it counts frames.
    """

    modulo: int
    tick: float | None = None


@dataclass(frozen=True)
class Frames:
    """N samples that were whole.

    Attributes
    ----------
    N : int
        How many.
    channels : mapping of str to (N,) or (N, d) array
        In SI units.
    count : (N,) array of int, or None
        The device's counter as it was sent.
    rejected : mapping of str to int
        What was met on the way and is no sample: what it was, and how often.
    """

    N: int
    channels: Mapping[str, Array]
    count: Integers | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)

    def without_repeats(self, before: Frames) -> tuple[Frames, Integers]:
        """Return the frames that differ, in counter or values, from the one before them.

        `before` ends with the frame before the first, or has none. The second array (K,) says of each of the K others
        how many frames are left before it. Without a counter all are left: two samples may show the same.
        """
        again = np.zeros(self.N, dtype=np.bool_)
        if self.count is not None and self.N:
            first = self.count[0] - 1 if before.count is None or not before.N else before.count[-1]
            again = np.diff(self.count, prepend=first) == 0
        if self.count is None or not np.any(again):
            return self, np.empty(0, dtype=np.int64)
        for name, values in self.channels.items():
            old = np.concatenate([before.channels[name][-1:] if before.N else values[:1], values[:-1]])
            again &= ((old == values) | (np.isnan(old) & np.isnan(values))).reshape(self.N, -1).all(axis=1)
        keep, left = ~again, np.cumsum(~again, dtype=np.int64)
        channels = {name: values[keep] for name, values in self.channels.items()}
        return Frames(int(left[-1]), channels, self.count[keep], self.rejected), left[again]


class Framing(Plugin):
    """The form in which a device puts its samples into bytes."""

    @property
    def device_counter(self) -> Counter | None:
        """The counter in each frame, where there is one."""
        return None

    @abstractmethod
    def decode(self, data: bytes, memory: Memory) -> tuple[Frames, Memory]:
        """Return the samples that end in `data`, and the memory for the bytes that follow.

        `memory` is None where the stream begins, or was interrupted: in the middle of a frame, as likely as not.
        It stays small whatever the stream holds.
        """

    def encode(self, chunk: Chunk, begun: int) -> bytes:
        """Return samples as the device sends them, before which `begun` were sent; by default ConfigError.

        The chunk is in SI, its time counts from the first sample that is sent. What `decode` makes of the bytes is the
        same samples, to the resolution of the device's numbers.
        """
        raise ConfigError(f"{self.kind}: is a framing that can only be read; serve lines of text instead")
