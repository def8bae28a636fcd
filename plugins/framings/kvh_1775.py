"""The messages of the KVH 1775 inertial unit (fibre optic gyros), as its manual describes them.

::

    A (36 bytes)   FE 81 FF 55 | gyro x y z | accel x y z |           | status | sequence | temperature | CRC-32
    B (40 bytes)   FE 81 FF 56 | gyro x y z | accel x y z | time (us) | status | sequence | temperature | CRC-32

Big-endian; gyro and accelerometer are float32, the time is uint32 and the temperature int16. The sequence counts
messages from 0 to 127. A status of 0x77 says that all six sensors are valid. The CRC covers the header too; which one
it is follows from the parameters of the manual and its sample message. Format C, where the temperature shares its
place with a magnetometer, is not read.

Source: KVH Industries, 1775 Inertial Measurement Unit Technical Manual, 54-0938 Rev. D, appendix C: Interface Control
Document 56-0298 Rev. B, tables 5-1 to 5-4 (messages), 5-8 (status) and 5-9 (CRC).
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import model_validator

from fusion_core.chunk import Chunk
from fusion_core.contracts import Counter, Frames, Framing, Memory
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Unit, problem
from fusion_plugins.framings.binary import Binary
from fusion_plugins.framings.field import VALID

ALL_VALID = 0x77
HEADERS = {"A": "FE 81 FF 55", "B": "FE 81 FF 56"}


@hookimpl
class Kvh1775(Framing):
    """The KVH 1775 inertial unit, message formats A and B."""

    kind: Literal["kvh_1775"] = "kvh_1775"
    message: Literal["A", "B"] = "A"
    """Format of the messages: A is the unit's default; B has a time stamp."""
    output: Literal["delta", "rate"] = "delta"
    """Output of the gyros: the angle since the message before (the unit's default), or the angular rate."""
    angle: Literal["rad", "deg"] = "rad"
    """Unit of angles."""
    interval: Annotated[float, Unit("s", positive=True, example="10 ms")] | None = None
    """Time between messages, where the unit sends angles."""
    temperature: Literal["degC", "0.01 degC", "degF", "0.01 degF"] = "degC"
    """Unit of the temperature, as set with =TEMPUNITS."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.output == "delta" and self.interval is None:
            raise problem(
                "the unit sends angles and not rates unless configured otherwise; write interval: 10 ms (time between "
                "messages), or output: rate where the unit was set so"
            )
        return self

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return both messages."""
        return (cls(interval=0.01), cls(interval=0.01, message="B"))

    @property
    def device_counter(self) -> Counter:
        """The time stamp of format B, else the sequence number."""
        return Counter(2**32, 1e-6) if self.message == "B" else Counter(128)

    @cached_property
    def _binary(self) -> Binary:
        factor = f"{self.angle}/s"
        scale = 1.0 if self.interval is None or self.output == "rate" else 1 / float(self.interval)
        number, celsius = (0.01 if self.temperature.startswith("0.01") else 1.0), self.temperature.endswith("degC")
        fields: list[dict[str, Any]] = [
            {"name": "gyro", "type": "float32", "count": 3, "unit": factor, "scale": scale},
            {"name": "accel", "type": "float32", "count": 3, "unit": "g"},
            *([{"name": "timestamp", "type": "uint32"}] if self.message == "B" else []),
            {"name": "status", "type": "uint8"},
            {"name": "sequence", "type": "uint8"},
            {"name": "temperature", "type": "int16", "unit": "degC" if celsius else "degF", "scale": number},
        ]
        counted = {"field": "timestamp", "tick": "1 us"} if self.message == "B" else {"field": "sequence"}
        return Binary.model_validate({
            "sync": HEADERS[self.message],
            "byte_order": "big",
            "fields": fields,
            "checksum": {"kind": "CRC-32/MPEG-2"},
            "counter": {**counted, "modulo": self.device_counter.modulo},
        })  # fmt: skip

    def decode(self, data: bytes, memory: Memory) -> tuple[Frames, Memory]:
        """Return the messages that end in `data`; the memory is what may be the beginning of the next one."""
        frames, memory = self._binary.decode(data, memory)
        channels = {name: frames.channels[name] for name in ("gyro", "accel", "temperature")}
        channels[VALID] = (frames.channels["status"] == ALL_VALID).astype(np.float64)
        return Frames(frames.N, channels, frames.count, frames.rejected), memory

    def encode(self, chunk: Chunk, begun: int) -> bytes:
        """Return the messages of samples, all of them valid."""
        number = begun + np.arange(len(chunk))
        more = {"status": np.full(len(chunk), ALL_VALID), "sequence": number % 128}
        return self._binary.encode(Chunk(chunk.t, {**chunk.channels, **more}), begun)
