"""Identity of a recording or a map: length and hash of its file, or of its samples in memory."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from math import inf
from pathlib import Path
from threading import Thread
from typing import Any

from driftlab.config import part_of
from driftlab.storage.in_memory import InMemoryName
from fusion_core.budget import COPIED, on_disk
from fusion_core.contracts import FileSource, Source
from fusion_core.errors import UnreadableFile

STANDARD_INPUT = Path("-")
HOLLOW = 100  # times what it takes on its disk: a larger file is little more than a hole


def identity(name: str) -> dict[str, Any]:
    """Return the identity of a recording: its name, and length and hash of its file (or samples), as `of_file`.

    Raises
    ------
    UnreadableFile
        If its file cannot be read.
    """
    if isinstance(name, InMemoryName):
        return {"name": str(name), **name.identity()}
    return {"name": name, **of_file(part_of(name)[0])}


def span_of(name: str) -> tuple[str, float, float]:
    """Return the hash of a recording's file (or samples), and from when to when it is of that, s; raises as that."""
    content = identity(name).get("sha256", "-")  # of standard input, which is one recording
    span = {} if isinstance(name, InMemoryName) else part_of(name)[1]
    start, stop = span.get("start"), span.get("stop")
    return content, -inf if start is None else start, inf if stop is None else stop


def of_source(source: Source) -> dict[str, Any]:
    """Return the identity of what a source reads; of standard input and a device, which are not kept, the name alone.

    Raises
    ------
    UnreadableFile
        If its file cannot be read.
    """
    if isinstance(source, FileSource):
        try:
            known = source.path is not None and (source.path.is_file() or source.path.is_dir())
        except OSError as error:  # a name that is too long, a folder that may not be searched
            raise _unreadable(source.path, error) from None
        return {"name": source.name, **(of_file(source.path) if known and source.path else {})}
    return {"name": source.name} if source.live else identity(InMemoryName(source))


def beforehand(source: Source | None) -> Callable[[], None]:
    """Begin to hash the file of a source, beside other work; return the function that waits for the end.

    A hash of a day at 1 kHz takes seconds, and the start and the filter leave a processor idle. What cannot be read,
    or is little more than a hole, is left to whoever needs the hash: it may have no row.
    """
    if not isinstance(source, FileSource) or source.path is None:
        return lambda: None
    path = source.path

    def hash_it() -> None:
        with suppress(UnreadableFile, OSError):
            if all(part.stat().st_size <= HOLLOW * on_disk(part) for part in _parts(path)):
                of_source(source)

    thread = Thread(target=hash_it, name="hashing", daemon=True)  # it only reads: it may end with the program
    thread.start()
    return thread.join


def of_file(path: Path) -> dict[str, Any]:
    """Return length and hash of a file, or of a folder that is one recording; raises UnreadableFile.

    Nothing is known of standard input, which is not kept.
    """
    if path == STANDARD_INPUT:
        return {}
    digest = sha256(path)
    return {"bytes": sum(part.stat().st_size for part in _parts(path)), "sha256": digest}


def sha256(path: Path) -> str:
    """Return the hash of a file, computed once as long as the file stays as it is; raises UnreadableFile.

    That of a folder is of the names of its files and their hashes, one a line, as `sha256sum` writes them.
    """
    try:
        state = path.stat()
        if path.is_dir():
            lines = "".join(f"{sha256(part)}  {part.relative_to(path).as_posix()}\n" for part in _parts(path))
            return hashlib.sha256(lines.encode()).hexdigest()
        if not path.is_file():
            raise UnreadableFile(f"{path}: is a pipe or a device, a file was expected; record it to one first")
        return _sha256(path, state.st_mtime_ns, state.st_size)
    except OSError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path | None, error: OSError) -> UnreadableFile:
    return UnreadableFile(f"{path}: cannot be read ({error.strerror}); name an existing file")


def _parts(path: Path) -> list[Path]:
    """Return the file, or the files of a folder in the order of their names."""
    return [path] if not path.is_dir() else sorted(part for part in path.rglob("*") if part.is_file())


@lru_cache(maxsize=64)
def _sha256(path: Path, changed: int, size: int) -> str:
    digest = hashlib.sha256()
    with path.open("rb", buffering=0) as file:
        while piece := file.read(2 * COPIED):  # between two of them it waits for its turn beside other threads
            digest.update(piece)
    return digest.hexdigest()
