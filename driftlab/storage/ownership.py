"""Ownership of files: each that driftlab wrote is known by its SHA-256, which one that was edited since has not.

A file that stands alone (a map, its page, a simulated recording) says which command wrote it, and its SHA-256, made
with zeros in that place; of one without a place for it, the bytes of a device, a file of JSON beside it does. The first
file of a folder has under `written` the SHA-256 of each that was written with it, and its own, made likewise.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

from driftlab import __version__
from driftlab.storage.system import PLAIN
from fusion_core.budget import COPIED, read_whole
from fusion_core.errors import ConfigError
from fusion_core.escaping import json_text

OWN = 64 * "0"  # in the place of a SHA-256 of the file itself
SEAL, ZEROS = re.compile(rb"driftlab ([a-z-]{1,20}) [!-~]{1,80}, sha256:([0-9a-f]{64})"), OWN.encode()
LONGEST = 200  # bytes of a seal, at least
LARGE, BLOCK = 1 << 24, 1 << 18  # bytes of a file whose digest is one of sums, and of a block
PART = 1 << 25  # bytes that a thread sums up
SUMS = "sums:"  # how such a digest begins
LARGEST = 1 << 28  # bytes of a file of JSON that may be ours


def seal_of(command: str) -> str:
    """Return the text by which a file is known, with zeros in the place of its SHA-256; `seal` writes that."""
    return f"driftlab {command} {__version__}, sha256:{OWN}"


def seal(path: Path) -> None:
    """Write the SHA-256 of a file into the place that it has for it; one without a place stays as it is."""
    place, _, _, found = _seal(path)
    if place is not None:
        with path.open("r+b") as file:
            file.seek(place)
            file.write(found)


def check_own(path: Path, command: str, subject: str, remedy: str) -> None:
    """Raise ConfigError where something else is at a path than what a command wrote there, as it wrote it."""
    if why := why_not_own(Path(os.path.realpath(path)), command):
        raise ConfigError(f"{subject}: {why}; move it away, or {remedy}")


def why_not_own(path: Path, command: str) -> str:
    """Return the reason why a path is not as a command wrote it; empty where it is, or nothing is there."""
    if not os.path.lexists(path):
        return ""
    regular = path.is_file() and not path.is_symlink()
    _, by, said, found = _seal(path) if regular else (None, "", b"", b"")
    note = beside(path)
    known = written(note) if by != command and regular and document(note) else {}
    if path.name in known and not why_not_own(note, command):
        by, ours = command, [is_as(path, digest) for digest in known.values()]
        said, found = (b"", b"") if any(ours) else (b"", b"another")
    if by != command:
        return f"exists, and nothing in it says that `driftlab {command}` wrote it"
    return "" if said == found else f"was changed since `driftlab {command}` wrote it"


def beside(path: Path) -> Path:
    """Return the file with the SHA-256 of one that has no place for it."""
    return path.with_name(f"{path.name}.json")


def put(new: Path, path: Path, command: str, subject: str) -> None:
    """Give a file its place, the one that a link leads to, for one of the same command that nobody changed meanwhile.

    Otherwise it is called `PATH.partial`, and ConfigError is raised.
    """
    place = Path(os.path.realpath(path))
    try:
        check_own(place, command, subject, "name another file")
    except ConfigError as error:
        kept = place.with_name(f"{place.name}.partial")
        if new != kept:
            os.replace(new, kept := free(kept))
        raise ConfigError(
            f"{error}; the new one is {kept if path.is_symlink() else path.with_name(kept.name)}"
        ) from None
    os.replace(new, place)


def free(path: Path, word: str = "before") -> Path:
    """Return a path, or one like it with a word and a number behind it, under which nothing is."""
    names = chain([path], (path.with_name(f"{path.name}.{word}-{k}") for k in count(1)))
    return next(name for name in names if not os.path.lexists(name))


def _seal(path: Path) -> tuple[int | None, str, bytes, bytes]:
    """Return the place of the SHA-256 in a file, the command by it, its value there, and that with zeros there."""
    sha256, place, by, said, data, passed = hashlib.sha256(), None, "", b"", b"", 0
    with path.open("rb") as file:
        while (piece := file.read(COPIED)) and (place is not None or passed < LARGEST):
            data += piece
            if place is None and (match := SEAL.search(data)):
                place, by, said = passed + match.start(2), match[1].decode(), match[2]
                data = data[: match.start(2)] + ZEROS + data[match.end(2) :]
            done = len(data) if place is not None else max(len(data) - LONGEST, 0)
            sha256.update(data[:done])
            data, passed = data[done:], passed + done
    sha256.update(data)
    return place, by, said, sha256.hexdigest().encode()


def sign(folder: Path, first: str, names: Collection[str], known: Mapping[str, str] | None = None) -> None:
    """Write the SHA-256 of files of a folder into its first one, with those that are known, and its own."""
    if content := document(folder / first):
        digests = {**(known or {}), **{name: digest(folder / name) for name in sorted(names)}}
        (folder / first).write_text(signed(content, first, digests), encoding="utf-8")


def signed(content: dict[str, Any], first: str, digests: Mapping[str, str]) -> str:
    """Return the text of the first file of a folder, with the SHA-256 of files and its own, made with zeros there."""
    rest = {key: value for key, value in content.items() if key != "written"}
    return with_own(json_text({**rest, "written": {**digests, first: OWN}}, 2, allow_nan=False) + "\n")


def with_own(text: str) -> str:
    """Return a text with its SHA-256 in the place of its last OWN."""
    before, _, after = text.rpartition(OWN)
    return before + hashlib.sha256(text.encode()).hexdigest() + after


def check_folder(subject: str, others: list[str]) -> None:
    """Raise ConfigError where a folder that is to be replaced holds files that driftlab did not write as they are."""
    if others:
        raise ConfigError(
            f"{subject}: holds {', '.join(others[:5])}, which driftlab did not write, or not so; move it away, or name "
            "another folder"
        )


def written(path: Path) -> dict[str, str]:
    """Return the SHA-256 of files by their names, as the first file of a folder has them; nothing where it has none."""
    known = document(path).get("written")
    return {name: str(said) for name, said in known.items()} if isinstance(known, dict) else {}


def foreign(folder: Path, first: str, names: Collection[str]) -> list[str]:
    """Return the files of a folder that driftlab did not write as they are."""
    known = written(folder / first)
    return sorted(name for name in names if not is_as(folder / name, known.get(name, ""), own=name == first))


def is_as(path: Path, said: str, *, own: bool = False) -> bool:
    """Return True if a file has the SHA-256 that was said of it; `own`: that it says itself."""
    return bool(said) and digest(path, said if own else "", said.startswith(SUMS)) == said


def digest(path: Path, own: str = "", sums: bool | None = None) -> str:
    """Return the SHA-256 of a file, with zeros where it says its own; empty where it is a link or cannot be read.

    Of a large file it is that of sums, which takes a third of the time; `sums` says whether, where that is known.
    """
    try:
        with open(os.open(path, os.O_RDONLY | PLAIN), "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if sums or (sums is None and size >= LARGE):
                return SUMS + _sums(path, size)
            if not own:
                return hashlib.file_digest(file, "sha256").hexdigest()
            before, _, after = file.read(LARGEST).rpartition(own.encode())
            return hashlib.sha256(before + ZEROS + after).hexdigest()
    except OSError:
        return ""


def _sums(path: Path, size: int) -> str:
    """Return the SHA-256 of the CRC-32 of each block of a file, and of the length of the file, two parts at a time."""
    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(partial(_sums_of_part, path), range(0, max(size, 1), PART)))
    sums, lengths = zip(*parts, strict=True)
    return hashlib.sha256(b"".join(sums) + sum(lengths).to_bytes(8, "little")).hexdigest()


def _sums_of_part(path: Path, start: int) -> tuple[bytes, int]:
    """Return the CRC-32 of each block of a part of a file, and the bytes that there are of it."""
    from fastcrc import crc32  # ten times as fast as zlib's

    sums, length, block = [], 0, memoryview(bytearray(BLOCK))
    with open(os.open(path, os.O_RDONLY | PLAIN), "rb") as file:
        file.seek(start)
        while length < PART and (count := file.readinto(block)):
            sums.append(crc32.iso_hdlc(block[:count]).to_bytes(4, "little"))
            length += count
    return b"".join(sums), length


def document(path: Path) -> dict[str, Any]:
    """Return a file of JSON; nothing where it is none."""
    try:
        content = json.loads(read_whole(path, LARGEST))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
