"""Who writes where: a lock that a process holds as long as it lives, with the mark of its owner.

A lock file is locked with `flock`, so a process that is killed leaves no lock, only the file: whoever comes next takes
it. On a file system that knows no locks the mark is all there is.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import sys
from datetime import datetime
from pathlib import Path

from fusion_core.errors import ConfigError


class Lock:
    """A lock on a file that is there for nothing else.

    Parameters
    ----------
    path : Path
        Of the lock file; it is made where it is not there.
    what : str
        What is locked, as messages call it.

    Raises
    ------
    ConfigError
        If another process (or another part of this one) holds it, or the file is of something else.
    OSError
        If the file cannot be made.
    """

    def __init__(self, path: Path, what: str) -> None:
        self.path, self.what = path, what
        self.left_over = path.exists()  # by a process that was killed, if this one gets the lock
        self._number = self._locked()
        while not self._is_the_file():  # the one before has removed it meanwhile
            os.close(self._number)
            self._number = self._locked()
        said = os.pread(self._number, 4096, 0)
        if said and b'"program": "driftlab"' not in said:
            os.close(self._number)
            raise ConfigError(f"{what}: {path} is in the way, and not of driftlab; move it, or name another")

    def _locked(self) -> int:
        number = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = _holder(os.read(number, 4096))
            os.close(number)
            raise ConfigError(f"{self.what}: is being written by {holder}; wait for its end, or name another") from None
        except OSError:  # of a file system that knows no locks
            pass
        return number

    def _is_the_file(self) -> bool:
        try:
            found = os.stat(self.path)
        except FileNotFoundError:
            return False
        return os.path.samestat(found, os.fstat(self._number))

    def sign(self) -> None:
        """Write into the file who holds the lock; raises OSError."""
        mark = {
            "program": "driftlab",
            "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])[:1000],
            "process": os.getpid(),
            "host": socket.gethostname(),
            "since": datetime.now().astimezone().isoformat(sep=" ", timespec="seconds"),
        }
        os.ftruncate(self._number, 0)
        os.pwrite(self._number, json.dumps(mark).encode(), 0)

    def release(self, path: Path | None = None, *, remove: bool = True) -> None:
        """Give the lock back and remove its file, which may have moved to `path`."""
        if remove:
            (path or self.path).unlink(missing_ok=True)
        os.close(self._number)


def _holder(mark: bytes) -> str:
    try:
        said = json.loads(mark)
        return f"`{said['command']}` (process {said['process']} on {said['host']}, since {said['since']})"
    except (ValueError, KeyError, TypeError):
        return "another process"
