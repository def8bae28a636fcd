"""Pages of units: of those that are asked for, and of those that stand out."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

from driftlab.files.replaceable import remove
from driftlab.fleets.doing import Doing
from driftlab.fleets.folder import NEW, FleetFolder
from driftlab.fleets.kept import record_of
from driftlab.fleets.manifest import Manifest
from driftlab.fleets.progress import Progress, Stage
from driftlab.fleets.unit import Task, work
from driftlab.fleets.words import MOST
from driftlab.fleets.workers import Lost, Workers
from fusion_core.errors import ConfigError

PAGE = "page"


def check_pages(manifest: Manifest, how: Doing) -> None:
    """Raise ConfigError where pages are asked for of units that there are not."""
    names = [entry.unit for entry in manifest.units]
    for pattern in how.pages:
        alone = Doing(how.config, how.versions, pages=[pattern])
        if not any(map(alone.wants_page, names)):
            raise ConfigError(f"--pages {pattern}: no unit is called so; name one of {names[0]} to {names[-1]}, or all")


def pages_missing(manifest: Manifest, folder: FleetFolder, how: Doing, known: Collection[str]) -> bool:
    """Whether a page is asked for that is not there, or that the report does not know of."""
    wanted = [entry.unit for entry in manifest.units if how.wants_page(entry.unit)]
    return any(unit not in known or not (folder.unit(unit) / PAGE).is_dir() for unit in wanted)


def make_pages(
    manifest: Manifest,
    folder: FleetFolder,
    how: Doing,
    odd: Mapping[str, Any],
    workers: Callable[[], Workers],
    progress: Progress,
) -> list[str]:
    """Make the pages that are asked for, and those of the first MOST units that stand out; return whose there are.

    Of a unit that has one already none is made.
    """
    stand_out = set(list(odd)[:MOST])
    wanted = [entry for entry in manifest.units if entry.unit in stand_out or how.wants_page(entry.unit)]
    missing = [entry for entry in wanted if not (folder.unit(entry.unit) / PAGE).is_dir()]
    stage = Stage("pages", total=len(missing))
    progress(stage)

    def tasks() -> Iterator[Task]:
        for entry in missing:
            record = record_of(folder.unit(entry.unit))
            if record is not None and record.state == "done":
                yield how.task(entry, page=True)

    todo = list(tasks())
    if todo:
        with workers() as working:
            for task, done in working.map(work, todo):
                if not isinstance(done, Lost):
                    _put_page(folder, task.unit, done.files)
                stage.done += 1
                progress(stage)
    return [entry.unit for entry in wanted if (folder.unit(entry.unit) / PAGE).is_dir()]


def _put_page(folder: FleetFolder, unit: str, files: Mapping[str, bytes]) -> None:
    """Put the page of a unit into its folder, whole or not at all."""
    pages = {name: content for name, content in files.items() if name.startswith(f"{PAGE}/")}
    place = folder.unit(unit)
    new = place.with_name(f".{unit}.{PAGE}{NEW}")
    remove(new)
    for name, content in pages.items():
        path = new / name.removeprefix(f"{PAGE}/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    if pages:
        os.rename(new, place / PAGE)
