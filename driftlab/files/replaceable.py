"""What may be replaced: the files that driftlab writes, and results that can be computed again."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Collection
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from driftlab.files.hdf5_stream import reading
from fusion_core.budget import read_whole
from fusion_core.data_sets import attribute
from fusion_core.errors import UnreadableFile
from fusion_core.escaping import json_text

FILES = {  # of each command; the first says that all are there
    "run": ("summary.json", "estimates.h5", "report.html"),
    "allan": ("summary.json", "allan.json", "allan.svg", "report.html"),
    "compare": ("summary.json", "report.html"),
    "plan": ("plan.json", "setpoints.csv", "report.html"),
    "explain": ("loop.json", "explained.*", "declared.*", "candidate.*", "prediction.h5", "report.html"),
}
LOCK, BEFORE = "driftlab.lock", ".replaced"
LARGEST = 1 << 28  # bytes of a file of JSON that may be ours
MARKS = {  # how a file begins, and what stands near its beginning
    ".html": (b"<!doctype html>", b'<meta name="generator" content="driftlab '),
    ".svg": (b"<svg", b"<dc:title>driftlab</dc:title>"),
    ".csv": (b"time [s],temperature [degC]\n", b"\n"),
}
WORKING = (LOCK, BEFORE, "checkpoint.npz", "*.new", "*.part")  # while a command is not done


def matches(name: str, patterns: Collection[str]) -> bool:
    """Whether a name is one of the patterns."""
    return any(fnmatch(name, pattern) for pattern in patterns)


def sign(folder: Path, first: str) -> None:
    """Write the SHA-256 of all files of a folder of results into its first one, and of what that says beside."""
    content = _document(folder / first)
    if content:
        others = (name for name in os.listdir(folder) if name != first and not matches(name, WORKING))
        written = {name: digest(folder / name) for name in sorted(others)}
        content["written"] = written | {first: _digest_of(content)}
        (folder / first).write_text(json_text(content, 2) + "\n", encoding="utf-8")


def foreign(folder: Path, first: str, names: Collection[str]) -> list[str]:
    """Return which files of a folder of results driftlab did not write, or not as they are; `first` has its mark."""
    content = _document(folder / first)
    known = content.pop("written", None)

    whole = isinstance(known, dict) and first in known

    def ours(name: str) -> bool:
        path = folder / name
        if name == first:
            return is_ours(path) and (not whole or known[first] == _digest_of(content))
        if isinstance(known, dict) and (whole or name in known):
            return known.get(name) == digest(path)
        # of a version before digests, or before those of all files
        return is_ours(path) or (known is None and "verdict" in content and not name.endswith((".html", ".h5")))

    return sorted(name for name in names if not ours(name))


def _digest_of(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def is_ours(path: Path) -> bool:
    """Whether driftlab wrote a file, by what it holds: each kind of file has its mark at a place of its own."""
    if path.is_symlink() or not path.is_file():
        return False
    try:
        if path.suffix == ".json":
            content = _document(path)
            result = isinstance(content.get("schema"), int) and isinstance(content.get("driftlab"), str)
            return result or (isinstance(content.get("driftlab_map"), int) and isinstance(content.get("record"), dict))
        if path.suffix == ".h5":
            with reading(path) as file:
                return "driftlab" in file.attrs
        with path.open("rb") as file:
            head = file.read(4096)
    except (OSError, UnreadableFile):
        return False
    mark = MARKS.get(path.suffix)
    return mark is not None and head.startswith(mark[0]) and mark[1] in head


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, empty where it is a link or cannot be read."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _document(path: Path) -> dict[str, Any]:
    """Return a file of JSON; nothing where it is none."""
    try:
        content = json.loads(read_whole(path, LARGEST))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def cannot_be_renamed(folder: Path) -> bool:
    """Whether a folder is where a file system (or part of one) is mounted, or the working directory."""
    if os.path.ismount(folder) or folder == Path.cwd():
        return True
    try:
        mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return False
    name = "".join(f"\\{ord(c):03o}" if c in " \t\n\\" else c for c in str(folder))
    return any(line.split()[4] == name for line in mounts)


def only_copy(folder: Path, recording: Path | None) -> str | None:
    """Return why the results in a folder cannot be computed again; None where they can, or there are none."""
    path = folder / "estimates.h5"
    if not path.is_file():
        return None
    try:
        with reading(path) as file:
            rows = len(file["t"]) if "t" in file else 0
            live, source = bool(attribute(path, file, "live")), str(attribute(path, file, "recording") or "")
    except UnreadableFile:
        return "has an estimates.h5 that cannot be read"
    if rows == 0 or (recording is not None and source == os.path.realpath(recording) and recording.exists()):
        return None
    if live:
        return "holds what a device measured (`driftlab live`)"
    if not source or Path(source).exists():
        return None
    if Path(source).name == "-":
        return "was computed from standard input"
    return f"was computed from {source}, which is not there any more"
