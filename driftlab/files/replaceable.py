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


def foreign(folder: Path, names: Collection[str]) -> list[str]:
    """Return which files of a folder of results driftlab did not write, or, of configs and maps, not as they are."""
    first = FILES["explain"][0]
    mark = _document(folder / first)
    known = mark.get("written")

    def ours(name: str) -> bool:
        if name == first or name.endswith(".html") or not mark:
            return is_ours(folder / name)
        if not isinstance(known, dict):
            return "verdict" in mark  # of a version before digests
        return is_ours(folder / name) if name.endswith(".h5") else known.get(name) == digest(folder / name)

    return sorted(name for name in names if not ours(name))


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
    """Return the SHA-256 of a small file, empty where it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
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
