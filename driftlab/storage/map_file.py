"""Files of a map: its own, its page and its report, which are new or in the place of an earlier one."""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from driftlab.storage.folders import check_writable, is_ours, refusals
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.errors import ConfigError
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
    with refusals(f"page {path}", "make room, or name another place", usage=False):
        write_whole(Path(os.path.realpath(path)), html.encode())


def save(fitted: FittedMap, path: Path) -> None:
    """Write a map's file, in the place that a link leads to; raises MapError or Unwritable."""
    with refusals(f"map {path}", "make room, or name another place", usage=False):
        fitted.save(Path(os.path.realpath(path)))


def _check_folder(path: Path) -> None:
    folder = Path(os.path.realpath(path)).parent
    with refusals(str(path), "name a folder that can be"):
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)


def _is_a_map(path: Path) -> bool:
    if path.suffix == ".json" and is_ours(Path(os.path.realpath(path))):
        return True
    for kind, cls in registry().classes(ThermalMap).items():  # a third party's file looks as it likes
        with suppress(Exception):
            settings = cls.model_validate({"kind": kind, "path": str(path)})
            assert isinstance(settings, ThermalMap)
            settings.load()
            return True
    return False
