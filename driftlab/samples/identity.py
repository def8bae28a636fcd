"""What tells one recording, or one map, from another: length and hash of its file, or of its samples in memory."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any

from driftlab.config import part_of
from driftlab.memory import Held
from fusion_core.contracts import FileSource, Source
from fusion_core.errors import UnreadableFile


def identity(name: str) -> dict[str, Any]:
    """Return what tells a recording from others: its name, and length and hash of its file (or samples).

    Raises
    ------
    UnreadableFile
        If its file cannot be read.
    """
    if isinstance(name, Held):
        return {"name": str(name), **name.identity()}
    return {"name": name, **of_file(part_of(name)[0])}


def of_source(source: Source) -> dict[str, Any]:
    """Return the identity of what a source reads; of standard input and a device, which are not kept, the name alone.

    Raises
    ------
    UnreadableFile
        If its file cannot be read.
    """
    if isinstance(source, FileSource):
        known = source.path is not None and source.path.is_file()
        return {"name": source.name, **(of_file(source.path) if known and source.path else {})}
    return {"name": source.name} if source.live else identity(Held(source))


def of_file(path: Path) -> dict[str, Any]:
    """Return length and hash of a file; raises UnreadableFile."""
    digest = sha256(path)
    return {"bytes": path.stat().st_size, "sha256": digest}


def sha256(path: Path) -> str:
    """Return the hash of a file, computed once as long as the file stays as it is; raises UnreadableFile."""
    try:
        found = path.stat()
        return _sha256(path, found.st_mtime_ns, found.st_size)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name an existing file") from None


@lru_cache(maxsize=64)
def _sha256(path: Path, changed: int, size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
