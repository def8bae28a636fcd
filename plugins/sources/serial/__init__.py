"""A device on a serial port, while it measures.

::

    bytes as they come  ->  framing: whole samples  ->  clock: their times  ->  chunks, at once

The port is read in the background and opened again when the cable was pulled; what was not measured meanwhile is a gap.
Time begins with the first sample.

A thread takes the bytes as they come, with the host's time, into a buffer that has an end: bytes that are not fetched
in time are dropped, oldest first, and counted. When the device is unplugged the port is opened again, after 0.1 s,
then twice as long, up to 5 s.
"""

from __future__ import annotations

import errno
import io
import os
import select
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from fusion_core.chunk import Chunk
from fusion_core.contracts import Counter, Frames, Framing, Source
from fusion_core.contracts.framing import REPEATED
from fusion_core.errors import UnreadableFile, seconds
from fusion_core.faults import NO_FRAME, Faults
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Installed
from fusion_core.units import Quantity, Unit, problem
from fusion_plugins.sources.binary_log import BinaryLog
from fusion_plugins.sources.serial.clock import SampleClock

if TYPE_CHECKING:
    import serial


AT_ONCE = 65_536  # bytes
CHECK = "check that the device is plugged in, and the rights to its port"
PATIENCE = 0.1  # s between looks at whether to stop
FIRST_WAIT, LONGEST_WAIT = 0.1, 5.0  # s before the port is opened again
LOOK_UP = 1.0  # s without a sample before an empty chunk is yielded


@hookimpl
class Serial(Source):
    """A device on a serial port, or behind a URL of pyserial."""

    live: ClassVar[bool] = True

    kind: Literal["serial"] = "serial"
    port: Annotated[str, Field(min_length=1)]
    """The port, as /dev/ttyUSB0, socket://host:port or loop://."""
    baudrate: Annotated[int, Field(gt=0, le=100_000_000)] = 115200
    """Bits a second."""
    framing: Annotated[Framing, Installed()]
    """Format of the device's bytes."""
    interval: Annotated[float, Unit("s", positive=True, example="10 ms")]
    """Time between samples, as the device is set."""
    clock: Literal["device", "host"] | None = None
    """Clock that stamps the samples; by default the device's where it sends a counter."""
    window: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """Window over which the host's clock is smoothed."""
    buffer: Annotated[int, Field(ge=4096, le=1 << 30)] = 1 << 20
    """Bytes kept for a filter that is late."""
    silent_after: Annotated[float, Unit("s", positive=True, example="5 s")] = Quantity(5.0, "5 s")
    """Longest silence of the device before it is reported."""
    speed: Annotated[float, Field(gt=0)] = 1.0
    """Pace of the device's clock, in that of the host: more than 1 in a rehearsal (`simulate --serve --speed`)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.clock == "device" and self.framing.device_counter is None:
            raise problem("the framing knows no counter of the device; write counter: under framing, or clock: host")
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
        if counter is not None and counter.tick is not None:
            counter = Counter(counter.modulo, counter.tick / self.speed)  # by the host's clock
        kind = self.clock or ("host" if counter is None else "device")
        clock = SampleClock(self.interval / self.speed, counter, kind, self.window, faults)
        memory, last = None, Frames(0, {})
        heard = spoke = whole_at = time.monotonic()
        silent, unused = False, 0  # bytes since the last frame
        with Port(self.port, self.baudrate, self.buffer) as port:
            while True:
                arrived = port.take(LOOK_UP)
                port.report(faults, f"after {seconds(max(clock.t, 0.0))}")
                now = time.monotonic()
                if arrived is not None:
                    heard, silent, unused = now, False, unused + len(arrived.data)
                    frames, memory = self.framing.decode(arrived.data, None if arrived.fresh else memory)
                    where = f"after {seconds(max(clock.t, 0.0))}"
                    for what, count in frames.rejected.items():
                        faults.add(what, count, where)
                    if frames.N:
                        spoke, whole_at, unused = now, now, 0
                    frames, again = frames.without_repeats(last)
                    faults.add(REPEATED, len(again), where)
                    last = frames if frames.N else last
                    t = clock.stamp(frames.N, frames.count, arrived.at) * self.speed
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


@dataclass(frozen=True)
class Arrived:
    """Bytes that came since the last look; `fresh` where they do not go on from those before."""

    data: bytes
    at: float  # host time of the last byte [s]
    fresh: bool


class Port:
    """An open port: `take` from it what has come.

    Parameters
    ----------
    url : str
        A device (`/dev/ttyUSB0`) or a URL of pyserial (`socket://host:port`, `loop://`).
    baudrate : int
        In bit/s.
    capacity : int
        Bytes that are kept for a reader who is late.

    Raises
    ------
    UnreadableFile
        If the port cannot be opened.
    """

    def __init__(self, url: str, baudrate: int, capacity: int) -> None:
        self.url, self.baudrate, self.capacity = url, baudrate, capacity
        self.dropped = 0  # bytes
        self.interrupted = 0  # times the connection was lost
        self._reported = 0, 0
        self._waiting: deque[tuple[int, float, bytes]] = deque()  # connection, host time, bytes
        self._size = 0
        self._taken = -1  # the connection of what was taken last
        self._torn = False
        self._stop = threading.Event()
        self._some = threading.Condition()
        try:
            self._port: serial.SerialBase | None = self._open()
        except (OSError, ValueError) as error:
            number = getattr(error, "errno", None)
            reason = str(error) if number is None else os.strerror(number)
            taken = number in (errno.EAGAIN, errno.EBUSY)  # the port is locked
            remedy = "another program reads it, end that first" if taken else CHECK
            raise UnreadableFile(f"{url}: cannot be opened ({reason}); {remedy}") from None
        self._thread = threading.Thread(target=self._run, name=f"reader of {url}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def take(self, timeout: float) -> Arrived | None:
        """Return the bytes that have come, after up to `timeout` s; None where there are none."""
        with self._some:
            if not self._waiting and not self._some.wait(timeout):
                return None
            connection, parts, at = self._waiting[0][0], [], 0.0
            while self._waiting and self._waiting[0][0] == connection:
                _, at, data = self._waiting.popleft()
                parts.append(data)
            whole = b"".join(parts)
            self._size -= len(whole)
            fresh = self._torn or connection != self._taken
            self._torn, self._taken = False, connection
        return Arrived(whole, at, fresh)

    def report(self, faults: Faults, where: str) -> None:
        """Report dropped bytes and lost connections since the last report, and a device that is not there."""
        dropped, interrupted = self.dropped, self.interrupted
        faults.add("bytes dropped because the program was slower than the device", dropped - self._reported[0], where)
        faults.add("times that the connection was lost", interrupted - self._reported[1], where)
        self._reported = dropped, interrupted
        faults.unavailable = "" if self._port is not None else f"unplugged, waiting for {self.url}"

    def _run(self) -> None:
        connection, wait = 0, FIRST_WAIT
        while not self._stop.is_set():
            try:
                if self._port is None:
                    self._port = self._open()
                    connection, wait = connection + 1, FIRST_WAIT
                self._keep(connection, *self._read(self._port))
            except OSError:  # what pyserial raises is one
                if self._port is not None:
                    self.interrupted += 1
                    self._close()
                self._stop.wait(wait)
                wait = min(2 * wait, LONGEST_WAIT)
        self._close()

    def _open(self) -> serial.SerialBase:
        import serial

        # another program that reads the same device would take half of the bytes
        if "://" not in self.url:
            return serial.Serial(self.url, baudrate=self.baudrate, timeout=PATIENCE, exclusive=True)
        return serial.serial_for_url(self.url, baudrate=self.baudrate, timeout=PATIENCE)

    def _close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _read(self, port: serial.SerialBase) -> tuple[bytes, float]:
        """Return the next bytes, after waiting for a first one; raises OSError where the device is gone."""
        try:
            number = port.fileno()
        except (io.UnsupportedOperation, AttributeError):
            data = port.read(
                max(1, getattr(port, "in_waiting", 1))
            )  # on Windows, or of what pyserial plays itself, as loop://
            return data, time.monotonic()
        if not select.select([number], [], [], PATIENCE)[0]:
            return b"", 0.0
        data = os.read(number, AT_ONCE)
        at = time.monotonic()
        if not data:
            raise OSError("the device is gone")
        return data, at

    def _keep(self, connection: int, data: bytes, at: float) -> None:
        if not data:
            return
        with self._some:
            self._waiting.append((connection, at, data))
            self._size += len(data)
            while self._size > self.capacity and len(self._waiting) > 1:
                lost = len(self._waiting.popleft()[2])
                self._size -= lost
                self.dropped += lost
                self._torn = True
            self._some.notify()
