"""The budget of a reader: what a file that a stranger made may cost, over what its rows cost.

A header, a chunk or an archive can declare any size, and a few bytes can inflate to any number. So every reader asks
here before it makes room for a piece that has to be held whole, inflates no further than the budget, and gives up on
what has no end. `docs/explanation/robustness.md` states the figures.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Protocol

from fusion_core.errors import UnreadableFile

PIECE = 512_000_000  # bytes of a piece (row group, chunk, variable, message) that is held whole
TOTAL = 1_500_000_000  # bytes of memory in all, over what the rows cost
KEPT = 16_000_000_000  # bytes of a temporary file
SECONDS = 60.0  # of a step that yields no rows
NAME = 64  # characters of a channel, a kind, a unit
TEXT = 100_000  # characters of another text in the record of a map


class Decompressor(Protocol):
    """What inflates, as those of bz2, lz4 and zstd do."""

    eof: bool

    def decompress(self, data: bytes, max_length: int = -1) -> bytes:
        """Return at most `max_length` bytes."""


def size_of(count: float) -> str:
    """Return a number of bytes in words, as `1.2 GB`."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count:.0f} bytes"


def check_size(path: Path, what: str, size: float, most: float = PIECE) -> None:
    """Raise UnreadableFile where a piece is larger than the budget.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        The piece, as `row group 3` or `the chunk at byte 132`.
    size, most : float
        Bytes that it takes in memory, and that it may take.
    """
    if size > most:
        raise UnreadableFile(
            f"{path}: {what} takes {size_of(size)}, at most {size_of(most)} are read at once; write it in smaller pieces"
        )


def inflated(path: Path, what: str, engine: Decompressor, data: bytes, most: int = PIECE) -> bytes:
    """Return what compressed bytes hold, as far as they are whole; raises UnreadableFile beyond the budget."""
    found = engine.decompress(data, max_length=most + 1)
    if len(found) > most:
        raise UnreadableFile(
            f"{path}: {what} of {size_of(len(data))} inflates to more than {size_of(most)}, which is the limit; write "
            "it in smaller pieces"
        )
    return found


class Clock:
    """The time of a step that yields no rows, from when it is made.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What is done, as `63,000,000 lines of comments`.
    seconds : float
        Of the processor.
    """

    def __init__(self, path: Path, what: str, seconds: float = SECONDS) -> None:
        self.path, self.what, self.seconds = path, what, seconds
        self.begun = time.process_time()

    def check(self) -> None:
        """Raise UnreadableFile where the step has taken longer than it may."""
        if time.process_time() - self.begun > self.seconds:
            raise UnreadableFile(
                f"{self.path}: {self.what} took more than {self.seconds:g} s of the processor, which is the limit; "
                "write the recording anew"
            )
