"""What may be replaced: the files that driftlab writes, and results that can be computed again."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from fnmatch import fnmatch
from pathlib import Path

from driftlab.files.hdf5_stream import reading
from fusion_core.budget import check_regular
from fusion_core.data_sets import attribute
from fusion_core.errors import UnreadableFile

FILES = {  # of each command; the first says that all are there
    "run": ("summary.json", "estimates.h5", "report.html"),
    "allan": ("summary.json", "allan.json", "allan.svg", "report.html"),
    "compare": ("summary.json", "report.html"),
    "plan": ("plan.json", "setpoints.csv", "report.html"),
    "explain": ("loop.json", "explained.*", "declared.*", "prediction.h5", "report.html"),
}
LOCK, BEFORE = "driftlab.lock", ".replaced"
WORKING = (LOCK, BEFORE, "checkpoint.npz", "*.new", "*.part")  # while a command is not done


def matches(name: str, patterns: Collection[str]) -> bool:
    """Whether a name is one of the patterns."""
    return any(fnmatch(name, pattern) for pattern in patterns)


def is_ours(mark: Path) -> bool:
    """Whether a file is one of driftlab's, which begin with the version of their layout."""
    try:
        check_regular(mark)
        with mark.open("rb") as file:
            return b'"schema"' in file.read(200)
    except OSError:
        return False


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
