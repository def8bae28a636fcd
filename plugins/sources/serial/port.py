"""A serial port that is read in the background, into a buffer that has an end.

A thread takes the bytes as they come, with the host's time. What is not fetched in time is dropped, oldest first, and
counted. When the device is unplugged the port is opened again, after 0.1 s, then twice as long, up to 5 s.
"""

from __future__ import annotations

import errno
import io
import os
import select
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from fusion_core.errors import UnreadableFile

if TYPE_CHECKING:
    import serial

AT_ONCE = 65_536  # bytes
CHECK = "check that the device is plugged in, and the rights to its port"
PATIENCE = 0.1  # s between looks at whether to stop
FIRST_WAIT, LONGEST_WAIT = 0.1, 5.0  # s before the port is opened again


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

    @property
    def connected(self) -> bool:
        """Whether there is a device at the moment."""
        return self._port is not None

    def take(self, timeout: float) -> Arrived | None:
        """Return what has come, waiting for it up to `timeout` s; None where nothing has."""
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
        """Return what there is, after waiting for a first byte; raises OSError where the device is gone."""
        try:
            number = port.fileno()
        except (io.UnsupportedOperation, AttributeError):
            data = port.read(1)  # of what pyserial plays itself, as loop://
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
