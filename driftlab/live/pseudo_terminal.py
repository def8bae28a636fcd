"""A device that is not there: samples go out of a pseudo-terminal at the pace at which they would be measured.

The other end is opened as a serial port is, by any program. The first sample is sent when one has opened it. What is
sent while nobody listens, or is not taken in time, is lost, as on a wire.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from fusion_core.chunk import Chunk
from fusion_core.contracts import Framing
from fusion_core.errors import ConfigError

LOOK = 0.02  # s between looks at whether the device was opened
SETTLE = 0.2  # s from its opening to the first byte, and from the last byte to its end
PATIENCE = 0.2  # s that bytes wait for room
WAIT = 1e-3  # s between looks at whether there is room
PIECE = 0.02  # s of the listener: samples that are sent together


class PseudoTerminal:
    """The end of a pseudo-terminal that a device would have.

    Attributes
    ----------
    device : str
        Name of the other end, as /dev/pts/3.
    lost : int
        Bytes that nobody took.
    """

    def __init__(self) -> None:
        try:
            import pty
            import tty
        except ImportError:
            raise ConfigError(
                "--serve: this system has no pseudo-terminals, a POSIX system was expected; write a file with --out"
            ) from None
        self._raw = tty.setraw
        self._master, slave = pty.openpty()
        self.device, self.lost = os.ttyname(slave), 0
        os.close(slave)  # so that the system tells whether another has it open
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, 0)

    @property
    def heard(self) -> bool:
        """True while a program has the device open."""
        return not self._poll.poll(0)

    def wait(self) -> None:
        """Wait until a program has opened the device."""
        while not self.heard:
            time.sleep(LOOK)
        self._raw(self._master)  # of both ends: bytes pass as they are, also before the program has set it so
        time.sleep(SETTLE)

    def send(self, data: bytes) -> None:
        """Send bytes; those that find no room in time are lost."""
        sent, until = 0, time.monotonic() + PATIENCE
        while sent < len(data) and self.heard and time.monotonic() < until:
            with suppress(BlockingIOError):
                os.read(self._master, 1 << 16)  # what the program says to the device: else it waits for room
            try:
                sent += os.write(self._master, data[sent:])
            except BlockingIOError:
                time.sleep(WAIT)
        self.lost += len(data) - sent

    def play(self, chunk: Chunk, framing: Framing, begun: int, speed: float, zero: float) -> None:
        """Send the samples of a chunk, before which `begun` were sent, each when it is due.

        The host's clock shows `zero` at t = 0; time passes `speed` times as fast.
        """
        span = float(chunk.t[-1] - chunk.t[0])
        n = max(1, int(PIECE * speed * (len(chunk) - 1) / span)) if span > 0 else 1
        for start in range(0, len(chunk), n):
            part = chunk.part(start, min(start + n, len(chunk)))
            data = framing.encode(part, begun + start)
            time.sleep(max(0.0, zero + float(part.t[-1]) / speed - time.monotonic()))
            self.send(data)

    def close(self) -> None:
        """End the device, as if it were unplugged, once the last bytes are taken."""
        time.sleep(SETTLE)
        os.close(self._master)


@contextmanager
def served_at(link: Path | None) -> Iterator[PseudoTerminal]:
    """Give a pseudo-terminal, which a link leads to as long as it lasts; raises ConfigError where that is taken."""
    with closing(PseudoTerminal()) as terminal:
        if link is None:
            yield terminal
            return
        if link.is_symlink() and os.readlink(link).startswith("/dev/pts/") and not link.exists():
            link.unlink()  # of one that was killed
        try:
            link.symlink_to(terminal.device)
        except OSError as error:
            raise ConfigError(f"--out {link}: cannot be linked ({error.strerror}); name another") from None
        try:
            yield terminal
        finally:
            with suppress(OSError):  # gone, or somebody's file by now
                if os.readlink(link) == terminal.device:
                    link.unlink()
