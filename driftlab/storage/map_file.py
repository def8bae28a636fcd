"""Where `fit-map` may write: a map's file or its page that is new, or in the place of an earlier one."""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from driftlab.storage.folders import FULL, check_writable, is_ours
from driftlab.storage.hdf5 import reason
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.errors import ConfigError, Unwritable
from fusion_core.host.registry import registry
from fusion_core.thermal.map_file import write_whole


def check_place(path: Path, read: Collection[Path]) -> None:
    """Make the folder of a map's file, and see that the file may be written.

    Raises
    ------
    ConfigError, Unwritable
        If it is something else than an earlier map, is one of the files that are read, or cannot be written.
    """
    if any(os.path.realpath(path) == os.path.realpath(other) for other in read):
        raise ConfigError(f"map {path}: is read here, and would be lost; name another file with --out")
    if path.exists() and not (path.is_file() and _is_a_map(path)):
        raise ConfigError(f"map {path}: exists and is not a map of driftlab; name another file with --out")
    _check_folder(path)


def check_report(stem: Path) -> None:
    """Make the folder of `STEM.json` and `STEM.svg`, and see that they may be written; raises as `check_place`."""
    for end in (".json", ".svg"):
        path = stem.with_name(stem.name + end)
        if path.exists() and not is_ours(path):
            raise ConfigError(f"--report: {path} exists and is not of an earlier selection; name another folder")
    _check_folder(stem)


def check_page(path: Path) -> None:
    """Make the folder of a page, and see that the page may be written; raises as `check_place`."""
    if path.exists() and not is_ours(Path(os.path.realpath(path))):
        raise ConfigError(f"page {path}: exists and is not a page of driftlab; name another folder with --report")
    _check_folder(path)


def write_page(path: Path, html: str) -> None:
    """Write a page whole or not at all, in the place that a link leads to; raises Unwritable."""
    try:
        write_whole(Path(os.path.realpath(path)), html.encode())
    except OSError as error:
        raise Unwritable(
            f"page {path}: cannot be written ({reason(error)}); make room, or name another place"
        ) from None


def save(fitted: FittedMap, path: Path) -> None:
    """Write a map's file, in the place that a link leads to; raises MapError or Unwritable."""
    try:
        fitted.save(Path(os.path.realpath(path)))
    except OSError as error:
        raise Unwritable(f"map {path}: cannot be written ({reason(error)}); make room, or name another place") from None


def _check_folder(path: Path) -> None:
    folder = Path(os.path.realpath(path)).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
    except OSError as error:
        kind = Unwritable if error.errno in FULL else ConfigError
        raise kind(f"{path}: cannot be written ({reason(error)}); name a folder that can be") from None


def _is_a_map(path: Path) -> bool:
    if path.suffix == ".json" and is_ours(Path(os.path.realpath(path))):
        return True
    for kind, found in registry().classes(ThermalMap).items():  # a third party's file looks as it likes
        with suppress(Exception):
            settings = found.model_validate({"kind": kind, "path": str(path)})
            assert isinstance(settings, ThermalMap)
            settings.load()
            return True
    return False
