"""What tells, without reading them, that recordings are what they were: their lengths, and when they changed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from driftlab import __version__
from driftlab.config import Config, part_of
from driftlab.production.remote import is_url, look
from driftlab.production.unit import Task
from fusion_core.errors import FusionError
from fusion_core.host.provenance import participants


def versions_of(config: Config) -> str:
    """Return the versions of driftlab and of the plugins that a config names, as one text."""
    return json.dumps([__version__, participants(config)])


def stamp_of(task: Task, versions: str) -> str:
    """Return the stamp of a unit: what is to be done, and what its recordings look like.

    Empty where that is not known: a recording is not there, or its server does not say.
    """
    said = [task.config, task.explain, task.folder, {role: list(names) for role, names in task.recordings.items()}]
    try:
        looks = [look for names in task.recordings.values() for name in names for look in _looks(task.folder, name)]
    except OSError:
        return ""
    if None in looks:
        return ""
    return hashlib.sha256(json.dumps([said, versions, looks]).encode()).hexdigest()


def missing(task: Task) -> bool:
    """Whether a recording on a file system is not there."""
    names = [name for names in task.recordings.values() for name in names]
    return any(not is_url(name) and not _path(task.folder, name).exists() for name in names)


def _path(folder: str, name: str) -> Path:
    return Path(folder, part_of(name)[0])


def _looks(folder: str, name: str) -> Iterator[tuple[int | str, ...] | None]:
    """Yield length, times of change and number of a file, or of each in a folder; of a URL, length and tag.

    None where a server does not say. Raises OSError.
    """
    if is_url(name):
        with suppress(FusionError):
            yield look(name)
            return
        yield None
        return
    path = _path(folder, name)
    parts = sorted(part for part in path.rglob("*") if part.is_file()) if path.is_dir() else [path]
    for part in parts:
        found = os.stat(part)
        yield found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino
