"""The bytes of a file, unpacked where they are a gzip archive; `-` is standard input.

Standard input is kept in a temporary file, so that it can be read as often as a recording is: once for each config that
is compared, again to find the number of a line that is wrong.
"""

from __future__ import annotations

import atexit
import gzip
import io
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from fusion_core.contracts import head
from fusion_core.errors import UnreadableFile, Unwritable

STANDARD_INPUT = Path("-")
GZIP = b"\x1f\x8b"
Stream = io.BufferedReader | gzip.GzipFile


@contextmanager
def opened(path: Path) -> Iterator[Stream]:
    """Open the plain bytes of a file.

    Raises
    ------
    UnreadableFile
        If it is not there, empty, or a damaged archive, which may show only while it is read.
    Unwritable
        If standard input cannot be kept.
    """
    where = _kept() if path == STANDARD_INPUT else path
    if not head(where, path).startswith(GZIP):
        with where.open("rb") as file:
            yield file
        return
    try:
        with gzip.open(where, "rb") as unpacked:
            yield unpacked
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise UnreadableFile(f"{path}: is cut short or damaged ({error}); copy or record it again") from None


def beginning(file: Stream, path: Path) -> bytes:
    """Return the first bytes of an open file and go back to them; raises UnreadableFile where there are none."""
    first = file.read(4096)
    file.seek(0)
    if not first:
        raise UnreadableFile(f"{path}: is empty (0 bytes when unpacked); nothing was written to it, or a copy failed")
    return first


@cache
def _kept() -> Path:
    """Return a temporary file with all of standard input, which is removed at exit."""
    if sys.stdin is None or sys.stdin.isatty():
        raise UnreadableFile("-: standard input is a terminal, a recording was expected; pipe one in, or name a file")
    try:
        file = tempfile.NamedTemporaryFile(prefix="driftlab-")  # noqa: SIM115
        atexit.register(file.close)
        shutil.copyfileobj(sys.stdin.buffer, file)
        file.flush()
    except OSError as error:
        raise Unwritable(
            f"-: standard input cannot be kept in {tempfile.gettempdir()} ({error.strerror}); make room there, or name "
            "another folder in TMPDIR"
        ) from None
    return Path(file.name)
