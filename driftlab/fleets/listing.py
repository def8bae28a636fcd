"""Files by pattern and by name, here or in a bucket (`s3://`, `memory://`, `file://`, through fsspec)."""

from __future__ import annotations

import errno
import glob
from pathlib import Path

from driftlab.fleets.remote import is_url, system_of
from fusion_core.budget import PIECE, read_whole, size_of
from fusion_core.errors import ConfigError, told

MANIFEST = PIECE // 2  # bytes of a manifest: more than a million units


def matching(pattern: str) -> list[str]:
    """Return the files that a pattern finds, in the order of their names; raises ConfigError."""
    if not is_url(pattern):
        return sorted(glob.glob(pattern, recursive=True))
    system, path = system_of(pattern)
    try:
        return sorted(system.unstrip_protocol(found) for found in system.glob(path))
    except Exception as error:  # of any of its back ends
        raise ConfigError(f"--units {pattern}: cannot be listed ({told(error)}); check address and rights") from None


def read_text(path: str) -> str:
    """Return the content of a text file, here or in a bucket; raises ConfigError."""
    try:
        if not is_url(path):
            return read_whole(Path(path), MANIFEST).decode("utf-8-sig")
        system, name = system_of(path)
        with system.open(name, "rb") as file:
            data = bytes(file.read(MANIFEST + 1))
        if len(data) > MANIFEST:
            raise OSError(errno.EFBIG, f"it has more than {size_of(MANIFEST)}")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(f"--units {path}: is not UTF-8 text; save it as CSV in UTF-8") from None
    except OSError as error:
        raise ConfigError(
            f"--units {path}: cannot be read ({error.strerror or told(error)}); name a file that can be"
        ) from None
