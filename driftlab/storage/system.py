"""Calls of the operating system that POSIX and Windows have otherwise: locks, links, and names of files that are open.

Windows neither renames nor removes a file that is open, nor a folder that holds one, and opens no folder. It is known
by what it lacks, so that its rules can be tried elsewhere.
"""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

PLAIN = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))
"""Of `os.open`: no link is followed, nothing is waited for, and bytes stay as they are."""
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of mallopt(3)
OWNER = 4096  # bytes at the front of a lock file that name its owner; Windows locks one behind them


def has_posix_locks() -> bool:
    """Return True if files are locked as POSIX does, and can be renamed and removed while they are open."""
    try:
        return find_spec("fcntl") is not None
    except ValueError:  # hidden
        return False


def lock(number: int) -> None:
    """Lock an open file until it is closed; raises BlockingIOError where it is locked, OSError where it cannot be."""
    if has_posix_locks():
        fcntl = import_module("fcntl")
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    msvcrt = import_module("msvcrt")
    os.lseek(number, OWNER, os.SEEK_SET)
    try:
        msvcrt.locking(number, msvcrt.LK_NBLCK, 1)
    except OSError as error:
        raise BlockingIOError(error.errno, os.strerror(error.errno or errno.EACCES)) from None


def read_owner(number: int) -> bytes:
    """Return the front of an open lock file."""
    os.lseek(number, 0, os.SEEK_SET)
    return os.read(number, OWNER)


def write_owner(number: int, owner: bytes) -> None:
    """Write the front of an open lock file."""
    os.ftruncate(number, 0)
    os.lseek(number, 0, os.SEEK_SET)
    os.write(number, owner[:OWNER])


def sync(path: Path) -> None:
    """Have a file or a folder reach the disk, where the system and its file system can be asked to."""
    try:
        number = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
    except PermissionError:  # of a folder
        return
    try:
        with suppress(PermissionError, InterruptedError):
            os.fsync(number)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # of folders on some network file systems
            raise
    finally:
        os.close(number)


def is_read_only(folder: Path) -> bool:
    """Return True if the file system of a folder is known to be read-only."""
    return hasattr(os, "statvfs") and bool(os.statvfs(folder).f_flag & os.ST_RDONLY)


def keep_freed_memory() -> None:
    """Ask the C library to keep what is freed, where it is glibc: a command asks for the same blocks many times.

    It gives large blocks back to the system at once, and the system hands them out again page by page, each cleared: a
    third of the steady method's time, an eighth of a whole run's.
    """
    import ctypes

    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "gnu_get_libc_version"):
        library = ctypes.CDLL(None)
        library.mallopt(TRIM_THRESHOLD, 1 << 30)
        library.mallopt(MMAP_THRESHOLD, 1 << 25)
