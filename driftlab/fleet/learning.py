"""What the units of a fleet have in common, and the files that say it: family, table and report."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from driftlab import __version__
from driftlab.config import Config
from driftlab.fleet.doing import Count
from driftlab.fleet.folder import NEW, FleetFolder
from driftlab.fleet.kept import record_of
from driftlab.fleet.manifest import Manifest
from driftlab.fleet.progress import Progress, Stage
from driftlab.fleet.table import Table

TABLE = "units.parquet"


def written(folder: Path) -> bool:
    """Whether all that is written of a fleet as a whole is there."""
    return (folder / TABLE).is_file()


def learn(
    manifest: Manifest, folder: FleetFolder, found: Count, config: Config, known: Path | None, progress: Progress
) -> dict[str, Any]:
    """Fit the family of the units that are done, and write the fleet's files; return what it says, for `fleet.json`."""
    told: dict[str, Any] = {"units": len(found.done), "odd": {}, "lines": []}
    _write_table(manifest, folder, progress)
    return told


def _write_table(manifest: Manifest, folder: FleetFolder, progress: Progress) -> None:
    stage = Stage("tables", total=len(manifest.units))
    progress(stage)
    table = Table(folder.path / f".rows{NEW}", manifest.columns())
    try:
        for entry in manifest.units:
            record = record_of(folder.unit(entry.unit))
            assert record is not None
            table.add(entry, record, None)
            stage.done += 1
            progress(stage)
        new = folder.path / f".{TABLE}{NEW}"
        table.write(new, {"driftlab": __version__})
        os.replace(new, folder.path / TABLE)
    finally:
        table.close()
