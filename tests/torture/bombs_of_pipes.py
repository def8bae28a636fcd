"""Streams without an end on standard input: what comes first, and what comes after it again and again."""

from __future__ import annotations

import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from torture import base

RNG = np.random.Generator
HEADER = base.csv_text(base.recording(100)).partition("\n")[0].encode() + b"\n"
MEMBER = zlib.compress(b"", wbits=31)
BLOCK = 1 << 20  # bytes of what is repeated
STREAMS: dict[str, tuple[bytes, bytes]] = {
    "words": (b"", b"y\n"),
    "lines of text": (b"", b"a line of a log without any separators\n"),
    "one line": (b"", b"y"),
    "zeros": (b"", b"\0"),
    "lines that are blank": (b"", b"\n"),
    "comments": (b"", b"# nothing\n"),
    "comments below a header": (HEADER, b"#\n"),
    "blank lines below a header": (HEADER, b"\n"),
    "words below a header": (HEADER, b"a,b,c\n"),
    "members of an archive": (b"", MEMBER),
    "padding of an archive": (MEMBER, b"\0"),
    "an archive of zeros": (b"", zlib.compress(bytes(4 << 20), wbits=31)),
    "noise": (b"", b""),
}


def stream(rng: RNG, path: Path) -> None:
    """Write what is repeated to `path`, and what comes before it beside that."""
    first, again = STREAMS[str(rng.choice(list(STREAMS)))]
    path.with_suffix(".first").write_bytes(first)
    path.write_bytes(again * (BLOCK // len(again) + 1) if again else rng.bytes(BLOCK))


def feed(path: Path) -> subprocess.Popen[bytes]:
    """Start a process that writes the stream, until nobody reads it."""
    endless = 'cat "$1"; while cat "$2"; do :; done'
    command = ["sh", "-c", endless, "sh", path.with_suffix(".first"), path]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


FORMATS: dict[str, Callable[[RNG, Path], None]] = {"csv pipe": stream, "binary_log pipe": stream}
SUFFIXES = dict.fromkeys(FORMATS, ".pipe")
