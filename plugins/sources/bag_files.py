"""The files of a bag: one `.bag`, `.mcap` or `.db3`, or a folder of them in their order."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fusion_core.budget import check_count, keep, no_room, unpacked_at_most
from fusion_core.contracts import foreign, head
from fusion_core.errors import UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources import bag_mcap, bag_ros1, bag_sqlite
from fusion_plugins.sources.bag_storage import Storage, zstd

FILES = 500  # that are open at a time
PARTS = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")


@contextmanager
def storages(path: Path, kind: str, faults: Faults) -> Iterator[list[Storage]]:
    """Open the files of a bag.

    Raises
    ------
    UnreadableFile
        If there is none, or one is of another kind or damaged.
    """
    folder = path.parent if path.name == "metadata.yaml" else path
    with ExitStack() as stack:
        paths = _parts(folder) if folder.is_dir() else [path]
        check_count(path, "files of a bag", len(paths), FILES)
        yield [_opened(part, kind, faults, stack) for part in paths]


def _parts(folder: Path) -> list[Path]:
    """Return the files of a folder, by the numbers in their names."""
    found = [part for part in folder.iterdir() if part.name.endswith(PARTS) and part.is_file()]
    if not found:
        raise UnreadableFile(f"{folder}: is a folder without a .db3 or .mcap file, a bag was expected; name a bag")
    return sorted(found, key=lambda part: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", part.name)])


def _opened(path: Path, kind: str, faults: Faults, stack: ExitStack) -> Storage:
    first = head(path)
    if path.suffix == ".zstd":
        path = _whole(path, stack)
        first = head(path)
    if first.startswith(bag_sqlite.SIGNATURE):
        return bag_sqlite.Sqlite(path, faults)
    if first.startswith(bag_ros1.SIGNATURE):
        return bag_ros1.Ros1(path, stack.enter_context(path.open("rb")), faults)
    if first.startswith(bag_mcap.SIGNATURE):
        return bag_mcap.Mcap(path, stack.enter_context(path.open("rb")), faults)
    if first.startswith(b"#ROSBAG V"):
        version = first.partition(b"\n")[0].decode("latin-1")
        raise UnreadableFile(
            f"{path}: is of version {version}, #ROSBAG V2.0 was expected; convert it with `rosbag fix`"
        )
    raise foreign(path, first, kind)


def _whole(path: Path, stack: ExitStack) -> Path:
    """Return a temporary file with what a compressed one holds, as far as it is whole."""
    try:
        unpacked = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="driftlab-"))) / path.stem
    except OSError as error:
        raise no_room(path, error) from None
    try:
        with zstd().open(path, "rb") as packed, unpacked.open("wb") as file:
            keep(path, packed, file, unpacked_at_most(path))
    except (OSError, EOFError, zstd().ZstdError) as error:
        raise UnreadableFile(f"{path}: is cut short or damaged ({error}); copy or record it again") from None
    return unpacked
