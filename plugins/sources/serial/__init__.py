"""A device on a serial port, while it measures.

::

    bytes as they come  ->  framing: whole samples  ->  clock: their times  ->  chunks, at once

The port is read in the background and opened again when the cable was pulled; what was not measured meanwhile is a gap.
Time begins with the first sample.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from fusion_core.chunk import Chunk
from fusion_core.contracts import Source
from fusion_core.contracts.framing import Framing
from fusion_core.errors import seconds
from fusion_core.faults import NO_FRAME, Faults
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Installed
from fusion_core.units import Quantity, Unit
from fusion_plugins.sources.binary_log import BinaryLog
from fusion_plugins.sources.serial.clock import SampleClock
from fusion_plugins.sources.serial.port import Port

LOOK_UP = 1.0  # s without a sample before an empty chunk is yielded


class Serial(Source):
    """A device on a serial port, or behind a URL of pyserial."""

    live: ClassVar[bool] = True

    kind: Literal["serial"] = "serial"
    port: Annotated[str, Field(min_length=1)]
    """The port, as /dev/ttyUSB0, socket://host:port or loop://."""
    baudrate: Annotated[int, Field(gt=0, le=100_000_000)] = 115200
    """Bits a second."""
    framing: Annotated[Framing, Installed()]
    """How the device puts samples into bytes."""
    interval: Annotated[float, Unit("s", positive=True, example="10 ms")]
    """Time between samples, as the device is set."""
    clock: Literal["device", "host"] | None = None
    """Whose clock stamps the samples; by default the device's where it sends a counter."""
    window: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """Window over which the host's clock is smoothed."""
    buffer: Annotated[int, Field(ge=4096, le=1 << 30)] = 1 << 20
    """Bytes kept for a filter that is late."""
    silent_after: Annotated[float, Unit("s", positive=True, example="5 s")] = Quantity(5.0, "5 s")
    """How long the device may be silent before it is reported."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.clock == "device" and self.framing.device_counter is None:
            text = "the framing knows no counter of the device; write counter: under framing, or clock: host"
            raise PydanticCustomError("serial", "{text}", {"text": text})
        return self

    @property
    def name(self) -> str:
        """The port."""
        return self.port

    def of_file(self, path: Path) -> Source:
        """Return the source that reads a file of the device's bytes."""
        stamped = "time" in self.framing.decode(b"", None)[0].channels
        return BinaryLog(path=path, framing=self.framing, interval=None if stamped else self.interval)

    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield samples as they come, without an end; an empty chunk every second in which none comes."""
        counter = self.framing.device_counter
        kind = self.clock or ("host" if counter is None else "device")
        clock = SampleClock(self.interval, counter, kind, self.window, faults)
        memory = None
        heard = spoke = whole_at = time.monotonic()
        silent, unused = False, 0  # bytes since the last frame
        with Port(self.port, self.baudrate, self.buffer) as port:
            watch = _Watch(port, faults)
            while True:
                arrived = port.take(LOOK_UP)
                watch.look(clock.t)
                now = time.monotonic()
                if arrived is not None:
                    heard, silent, unused = now, False, unused + len(arrived.data)
                    frames, memory = self.framing.decode(arrived.data, None if arrived.fresh else memory)
                    where = f"after {seconds(max(clock.t, 0.0))}"
                    for what, count in frames.rejected.items():
                        faults.add(what, count, where)
                    t = clock.stamp(frames.N, frames.count, arrived.at)
                    if frames.N:
                        spoke, whole_at, unused = now, now, 0
                    whole = Chunk(t, frames.channels)
                    for start in range(0, frames.N, size):
                        yield whole.part(start, min(start + size, frames.N))
                if unused and now - whole_at >= max(LOOK_UP, 3 * self.interval):
                    faults.add(NO_FRAME, unused, f"after {seconds(max(clock.t, 0.0))}")
                    unused = 0
                if not silent and now - heard > self.silent_after:
                    silent = True
                    what = f"times that the device was silent for more than {self.silent_after:g} s"
                    faults.add(what, 1, f"after {seconds(max(clock.t, 0.0))}")
                if arrived is None or now - spoke >= LOOK_UP:
                    spoke = now
                    yield Chunk(clock.stamp(0, None, 0.0))


class _Watch:
    """Reports what happened to a port since the last look."""

    def __init__(self, port: Port, faults: Faults) -> None:
        self.port, self.faults, self.seen = port, faults, (0, 0)

    def look(self, t: float) -> None:
        now = (self.port.dropped, self.port.interrupted)
        where = f"after {seconds(max(t, 0.0))}"
        self.faults.add("bytes dropped because the program was slower than the device", now[0] - self.seen[0], where)
        self.faults.add("times that the connection was lost", now[1] - self.seen[1], where)
        self.seen = now
        self.faults.unavailable = "" if self.port.connected else f"unplugged, waiting for {self.port.url}"


@hookimpl
def sources() -> list[type[Source]]:
    """Register the plugin."""
    return [Serial]
