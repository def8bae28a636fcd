"""Recordings in a bucket or behind another URL (`s3://`, `gs://`, `https://`, `file://`), through fsspec.

Paths of this machine are left as they are, and nothing is loaded for them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fusion_core.errors import ConfigError, FusionError, UnreadableFile, check_installed, describe_error, quote

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_SPAN = re.compile(r"(?P<url>.+?)(?P<span>::[^:/]*:[^:/]*)?")
CHANGES = ("ETag", "etag", "md5Hash", "Content-MD5", "Digest", "LastModified", "Last-Modified", "mtime", "created")
"""Names in file systems' facts of the one that tells contents of one length apart; the first that is there counts."""


def is_url(name: str) -> bool:
    """Return True if a recording lies behind a URL: `URL` or `URL::START:STOP`."""
    return _URL.match(name) is not None


@contextmanager
def local(names: Iterable[str]) -> Iterator[dict[str, str]]:
    """Give recordings names that can be read here, until the end of the block.

    Parameters
    ----------
    names : iterable of str
        `PATH` or `URL`, each with `::START:STOP` behind it or without.

    Yields
    ------
    dict of str to str
        By name: itself for a path, a copy's (with its `::START:STOP`) for a URL. A URL is fetched once.

    Raises
    ------
    UnreadableFile
        If one cannot be fetched.
    ConfigError
        If fsspec, or the package for this kind of URL, is not installed.
    """
    wanted = list(dict.fromkeys(names))
    if not any(map(is_url, wanted)):
        yield {name: name for name in wanted}
        return
    with TemporaryDirectory(prefix="driftlab-") as folder:
        copies: dict[str, str] = {}
        placed = {}
        for name in wanted:
            url, span = _parts(name)
            if is_url(name) and url not in copies:
                copies[url] = str(_fetch(url, Path(folder, str(len(copies)))))
            placed[name] = copies[url] + span if is_url(name) else name
        yield placed


def look(url: str) -> tuple[int, str] | None:
    """Return the state of a URL's content without reading it: its length, and its tag or time of change.

    None where the server says no more than a length. Raises as `local`.
    """
    url, _ = _parts(url)
    system, name = system_of(url)
    info = _ask(url, system.info, name)
    tag = next((str(info[key]) for key in CHANGES if info.get(key)), None)
    return None if tag is None or info.get("size") is None else (int(info["size"]), tag)


def system_of(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the URL's name there; raises ConfigError."""
    check_installed(quote(url, 200), "fsspec", "URLs", "dask")
    from fsspec.core import url_to_fs

    try:
        system, name = url_to_fs(url)
    except (ImportError, ValueError) as error:  # no package for it; no such kind
        raise ConfigError(
            f"{quote(url, 200)}: cannot be reached ({describe_error(error)}); install what reads it"
        ) from None
    return system, name


def _fetch(url: str, folder: Path) -> Path:
    """Copy what is behind a URL into a folder, under its own name; a file of this machine stays where it is."""
    system, name = system_of(url)
    if system.protocol == ("file", "local"):
        return Path(name)
    info = _ask(url, system.info, name)
    last = name.rstrip("/").rpartition("/")[2]
    path = folder / (last.partition("?")[0] if url.startswith("http") else last)
    folder.mkdir()
    if info.get("type") == "directory":
        _ask(url, system.get, name, str(path), recursive=True)
        return path
    _ask(url, system.get_file, name, str(path))  # `get` would take a query for a pattern
    size = info.get("size")
    if size not in (None, os.path.getsize(path)):
        raise UnreadableFile(f"{url}: {os.path.getsize(path)} bytes came of {size}; fetch it again")
    return path


def _ask(url: str, method: Any, *args: Any, **options: Any) -> Any:
    """Ask a file system; errors of its library become those of the URL."""
    try:
        return method(*args, **options)
    except FusionError:
        raise
    except FileNotFoundError:
        raise UnreadableFile(f"{url}: is not there, or its server does not answer; name an object that is") from None
    except Exception as error:
        raise UnreadableFile(f"{url}: cannot be fetched ({describe_error(error)}); see to access and network") from None


def _parts(name: str) -> tuple[str, str]:
    """Return the URL, and `::START:STOP` where it is there; `::` before another URL is part of the first."""
    parts = _SPAN.fullmatch(name)
    assert parts is not None, "a recording has a name"
    return parts["url"], parts["span"] or ""
